"""One committed trajectory for each registered filter: what a change of code changes, seen as a diff in review.

``python -m tests.robustness.trajectories`` writes them anew; the test beside says which filter changed, and where.
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np

FOLDER = Path(__file__).parent / "trajectories"


def path(name: str) -> Path:
    """Where a filter's trajectory is."""
    return FOLDER / f"{name}.csv"


def compute(name: str) -> dict[str, np.ndarray]:
    """Columns (T,) of the registry's example in float64: means, standard deviations, log-likelihood, status."""
    from tests import test_properties as properties

    out = properties.alone(name, jnp.float64, 0)
    columns = {f"mean_{i}": np.asarray(out.mean)[:, i] for i in range(out.mean.shape[1])}
    if out.cov is not None:
        std = np.sqrt(np.maximum(np.diagonal(np.asarray(out.cov), axis1=1, axis2=2), 0))
        columns |= {f"std_{i}": std[:, i] for i in range(std.shape[1])}
    if out.log_lik is not None:
        columns["log_lik"] = np.asarray(out.log_lik)
    return {**columns, "status": np.asarray(out.status, np.float64)}


def write(name: str) -> None:
    """Ten significant digits, one line for each step."""
    columns = compute(name)
    lines = [",".join(columns)]
    lines += [",".join(f"{x:.10g}" for x in row) for row in np.stack(list(columns.values()), axis=1)]
    FOLDER.mkdir(exist_ok=True)
    path(name).write_text("\n".join(lines) + "\n", encoding="utf-8")


def read(name: str) -> dict[str, np.ndarray]:
    """The committed columns."""
    head, *lines = path(name).read_text(encoding="utf-8").splitlines()
    rows = np.array([[float(x) for x in line.split(",")] for line in lines])
    return dict(zip(head.split(","), rows.T, strict=True))


def changes(old: dict[str, np.ndarray], new: dict[str, np.ndarray], tolerance: float = 1e-8) -> list[str]:
    """A line for each column that changed by more than ``tolerance`` of its largest value, with the first such step."""
    lines = [f"{key}: only {'committed' if key in old else 'computed'}" for key in sorted(old.keys() ^ new.keys())]
    for key in old.keys() & new.keys():
        a, b = old[key], new[key]
        if a.shape != b.shape:
            lines.append(f"{key}: {len(a)} steps committed, {len(b)} computed")
            continue
        far = ~(np.abs(a - b) <= tolerance * max(float(np.abs(a).max()), 1e-12))
        if far.any():
            k = int(np.argmax(far))
            lines.append(
                f"{key}: from step {k} on ({a[k]:.10g} committed, {b[k]:.10g} now), {far.sum()} of {len(a)} steps"
            )
    return lines


def main() -> None:
    """Writes all trajectories anew, and removes those of filters that are gone."""
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    from tests.registry import REGISTRY

    for name in sorted(REGISTRY):
        write(name)
    for file in FOLDER.glob("*.csv"):
        if file.stem not in REGISTRY:
            file.unlink()


if __name__ == "__main__":
    main()
