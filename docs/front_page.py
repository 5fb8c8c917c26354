"""The front page's picture: runs the README's code and draws what it computed, for light and for dark pages."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

DOCS = Path(__file__).parent
BLUE, ORANGE = "#3f6fd8", "#ff7043"


def draw(names, style):
    """Errors of filter and smoother, and the log-likelihood over q."""
    out, smoothed, ys, mask = (names[name] for name in ("out", "smoothed", "ys", "mask"))
    truth = 10.0 * np.arange(len(ys))
    with plt.style.context(style):
        figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 3.2), width_ratios=(2, 1), layout="constrained")
        seen = np.asarray(mask).reshape(len(ys), -1).all(axis=1)
        lost = np.flatnonzero(~seen)
        left.axvspan(lost[0] - 0.5, lost[-1] + 0.5, color="gray", alpha=0.2, lw=0)
        left.plot(np.flatnonzero(seen), (np.asarray(ys)[:, 0] - truth)[seen], ".", color="gray", label="measured")
        for result, color, label in ((out, BLUE, "filter"), (smoothed, ORANGE, "smoother")):
            error = np.asarray(result.mean)[:, 0] - truth
            band = 2 * np.sqrt(np.asarray(result.cov)[:, 0, 0])
            left.fill_between(np.arange(len(ys)), error - band, error + band, color=color, alpha=0.25, lw=0)
            left.plot(error, color=color, label=f"{label}, ±2σ")
        left.set(xlabel="sample", ylabel="error of the position [m]", xlim=(-0.5, len(ys) - 0.5))
        left.legend(loc="upper right", ncols=3, fontsize="small")
        qs = jnp.logspace(-4, 1, 60)
        curve = jax.vmap(lambda q: names["jf"].filter(names["filt"](q), ys, mask=mask).log_lik.sum())(qs)
        right.semilogx(qs, curve, color=BLUE)
        right.plot([0.01, 0.1, 1.0], names["batch"], "o", color=ORANGE, label="batch")
        at = jnp.array([0.02, 0.5])  # on a logarithmic axis the tangent has the slope q dl/dq, and slope is of -l
        tangent = names["batch"][1] - 0.1 * names["slope"] * jnp.log(at / 0.1)
        right.plot(at, tangent, color=ORANGE, label="slope at q = 0.1")
        right.set(xlabel="q [m²/s³]", ylabel="log-likelihood [nat]")
        right.legend(fontsize="small")
    return figure


def main():
    """Writes both pictures into ``docs/images``."""
    readme = (DOCS.parent / "README.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
    names: dict = {}
    exec(code, names)
    (DOCS / "images").mkdir(exist_ok=True)
    for name, style in (("light", "default"), ("dark", "dark_background")):
        figure = draw(names, style)
        figure.savefig(DOCS / "images" / f"front_{name}.png", dpi=150, transparent=True)


if __name__ == "__main__":
    main()
