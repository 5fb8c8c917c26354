"""R4 as curves: the error of one update over delta and e, Joseph's and the array form, in both precisions."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.robustness.updates import EXPONENTS, SWEEP, sweep


def draw(path: Path) -> None:
    """Four panels: Dyer and McReynolds, Bierman; float32, float64."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(9, 6.5), sharey="col", constrained_layout=True)
    titles = {"dmcr": "Dyer and McReynolds, over δ", "bierman": "Bierman, over e"}
    for i, problem in enumerate(titles):
        for j, dtype in enumerate((np.float32, np.float64)):
            axis, found = axes[i, j], sweep(dtype, True)[problem]
            eps = float(np.finfo(dtype).eps)
            x = eps ** EXPONENTS[:SWEEP]
            for family, label, style in (("joseph", "Joseph form", "C1"), ("array", "array form", "C0")):
                errors = np.array([errors[:SWEEP] for errors, _ in found[family]])
                told = np.array([info.status[:SWEEP] != 0 for _, info in found[family]])
                at = errors.argmax(axis=0), np.arange(SWEEP)
                worst = np.maximum(errors[at], eps / 8)
                axis.loglog(x, worst, f"{style}-", label=f"{label}, worst filter")
                axis.loglog(x[told[at]], worst[told[at]], f"{style}x", label=f"{label}: SINGULAR told")
            axis.loglog(
                x, eps / x if problem == "dmcr" else np.full(SWEEP, eps), "k:", label="ε / δ" if i == 0 else "ε"
            )
            axis.invert_xaxis()
            axis.set_title(f"{titles[problem]}, {np.dtype(dtype).name}")
            axis.set_xlabel("δ" if problem == "dmcr" else "e")
            axis.set_ylabel("‖P − P*‖ / ‖P*‖")
            axis.grid(alpha=0.3)
            axis.legend(fontsize=7)
    figure.savefig(path, dpi=110)
    plt.close(figure)
