"""Two linear-Gaussian classes, where a bank of Kalman filters is the exact answer: posterior, evidence and gradient."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxfilt as jf
from experiments.joint_tracking.system import as_printed
from experiments.report import Cell, Entry, Table

SIGMA_W = (0.5, 2.0)  # m/s^2 by class
SIGMA_Z = 10.0  # m
T, SETS = 40, 3
FLOORS = (0.1, 0.5, 1.0)
GRADIENT_STEPS = 25
AWAY = 0.8  # of the true sigma_z, where slopes are taken: at the maximum they are 0, and no error is relative to them


def model(sigma_w: Any, sigma_z: Any = SIGMA_Z) -> jf.models.LinearGaussian:
    """Constant velocity at 1 s with white acceleration, position measured."""
    m0, P0 = np.array([0.0, 0.0, 10.0, 5.0]), np.diag([100.0, 100.0, 4.0, 4.0])
    return jf.models.constant_velocity(dt=1.0, q=sigma_w**2, r=sigma_z**2, m0=m0, P0=P0, noise="piecewise")


def joint(count: int, floor: Any, **options: Any) -> jf.Filter:
    """The single filter over state and class."""
    return jf.joint_particle([[model(s)] for s in SIGMA_W], [[1.0]], count, floor=floor, noise_rank=2, **options)


def data_sets(key: Array) -> Array:
    """(2 SETS, T, 2) measurements: of each class the first three series whose class the exact posterior decides.

    That is to 1 %. Where it does not, the particles' posterior scatters by several percent from run to run.
    """
    keys = jax.random.split(key, (2, 12))
    chosen = []
    for c, s in enumerate(SIGMA_W):
        ys = _series(s, keys[c])
        wrong = 1 - np.exp(np.asarray(exact(ys)[0])) if c else np.exp(np.asarray(exact(ys)[0]))
        chosen.append(ys[np.flatnonzero(wrong < 0.01)[:SETS]])
    return jnp.concatenate(chosen)


@jax.jit
def _series(sigma_w: Any, keys: Array) -> Array:
    return jax.vmap(lambda k: jf.simulate.simulate(model(sigma_w), T, k)[1])(keys)


def _end(state, info):
    del state
    return info.extra["log_probabilities"][1], info.log_lik


@jax.jit
def exact(ys: Array) -> tuple[Array, Array]:
    """log p(class 2) at the end and log evidence of series (sets, T, 2), by Kalman filters."""
    filt = jf.bank([jf.kalman(model(s)) for s in SIGMA_W])
    log_p, log_lik = jax.vmap(lambda y: jf.filter(filt, y, outputs=_end))(ys)
    return log_p[:, -1], log_lik.sum(axis=1)


@partial(jax.jit, static_argnames=("runs", "chunk"))
def many(filt: jf.Filter, ys: Array, key: Array, runs: int, chunk: int) -> tuple[Array, Array]:
    """As :func:`exact`, (sets, runs), by a filter that draws."""
    sets = len(ys)
    keys = jax.random.split(key, sets * runs)
    which = jnp.repeat(jnp.arange(sets), runs)

    def one(x):
        log_p, log_lik = jf.filter(filt, ys[x[0]], key=x[1], outputs=_end)
        return log_p[-1], log_lik.sum()

    found = jax.lax.map(one, (which, keys), batch_size=chunk)
    return jax.tree.map(lambda x: x.reshape(sets, runs), found)


def study(key: Array, runs: int, evidence_runs: int, floors: tuple[float, ...] = FLOORS) -> dict[str, np.ndarray]:
    """Posterior of class 2, evidence over the exact one, and the printed recursion's posterior, by series."""
    data_key, key = jax.random.split(key)
    ys = data_sets(data_key)
    log_p, log_z = exact(ys)
    keys = jax.random.split(key, 2 + len(floors))
    found = {"exact": jnp.exp(log_p), "sound": jnp.exp(many(joint(5000, 0.1), ys, keys[0], runs, 12)[0])}
    printed = as_printed(joint(5000, 0.1, threshold=1.0))
    found["printed"] = jnp.exp(many(printed, ys, keys[1], runs, 12)[0])
    for floor, k in zip(floors, keys[2:], strict=True):
        _, log_zs = many(joint(500, floor), ys, k, evidence_runs, 100)
        found[f"Z {floor}"] = jnp.exp(log_zs - log_z[:, None])
    return {name: np.asarray(x) for name, x in found.items()}


def table(found: dict[str, np.ndarray], runs: int, evidence_runs: int) -> Table:
    """By series: the exact posterior and what the filters make of it."""
    rows: list[list[Entry]] = []
    floors = [name for name in found if name.startswith("Z")]
    for i in range(2 * SETS):
        ratios = [found[name][i] for name in floors]
        cells: list[Entry] = [Cell(float(x.mean()), float(x.std(ddof=1) / np.sqrt(len(x)))) for x in ratios]
        sound = found["sound"][i]
        wrong = (found["printed"][i] > 0.5) == (i < SETS)
        q = (wrong.sum() + 1) / (runs + 2)
        rows.append([
            f"class {1 + i // SETS}, series {1 + i % SETS}", Cell(float(found["exact"][i])),
            Cell(float(sound.mean()), float(sound.std(ddof=1) / np.sqrt(runs))), *cells,
            Cell(float(wrong.mean()), float(np.sqrt(q * (1 - q) / runs))),
        ])  # fmt: skip
    header = ["truth", "exact p(class 2)", "single filter, mean p(class 2)"]
    header += [*(f"evidence over exact, floor {name[2:]}" for name in floors), "printed recursion: wrong class"]
    note = (f"Linear-Gaussian test; posterior with 5000 particles, floor 0.1, {runs} runs of each; evidence with "
            f"500 particles, {evidence_runs} runs.")  # fmt: skip
    return Table("exact", "Against the exact class posterior", header, rows, note)


# ------------------------------------------------------------------------------------------------------------ gradient


def _total(kind: jf.Static, theta: Array, ys: Array, key: Array | None, count: jf.Static) -> Array:
    m = model(jnp.exp(theta[0]), jnp.exp(theta[1]))
    if kind.value == "exact":
        return jf.filter(jf.kalman(m), ys).log_lik.sum()
    filt = jf.multi_mode_particle(
        [m], [[1.0]], count.value, resampling="multinomial", threshold=1.0, score_gradient=kind.value == "score"
    )
    return jf.filter(filt, ys, key=key).log_lik.sum()


@partial(jax.jit, static_argnames=("kind", "count", "chunk"))
def slopes(kind: str, ys: Array, keys: Array, count: int, chunk: int = 4) -> Array:
    """(runs, 2) slope of log Z in log sigma_w and log sigma_z; kind "exact", "score" or "draws"."""
    theta = jnp.log(jnp.array([SIGMA_W[0], AWAY * SIGMA_Z]))

    def one(key):
        return jax.grad(_total, argnums=1)(jf.Static(kind), theta, ys, key, jf.Static(count))

    return jax.lax.map(one, keys, batch_size=chunk)


def gradients(key: Array, count: int, runs: int) -> dict[str, np.ndarray]:
    """Slopes of one series of 25 steps, exact and by particles with and without the score of the choices.

    The series is the same for every key. On one whose slope is small the same absolute error is a larger share: on that
    of seed 1 in place of 0 (13.5) 2000 particles are 7 % off with the score, 12 % without.
    """
    ys = jf.simulate.simulate(model(SIGMA_W[0]), GRADIENT_STEPS, jax.random.fold_in(jax.random.key(0), 0))[1]
    keys = jax.random.split(jax.random.fold_in(key, 1), runs)
    kinds = {"exact": keys[:1], "score": keys, "draws": keys}
    return {kind: np.asarray(slopes(kind, ys, k, count, min(4, len(k)))) for kind, k in kinds.items()}


def gradient_table(found: dict[str, np.ndarray], count: int) -> Table:
    """Slope and how far it is off in units of the exact one."""
    names = {"exact": "Kalman filter", "score": "particles, score of the choices", "draws": "particles, draws only"}
    rows: list[list[Entry]] = []
    for kind, x in found.items():
        n = len(x)
        se = x.std(axis=0, ddof=1) / np.sqrt(n) if n > 1 else [None, None]
        cells: list[Entry] = [Cell(float(m), s) for m, s in zip(x.mean(axis=0), se, strict=True)]
        off = abs(float(x[:, 1].mean() / found["exact"][0, 1]) - 1)
        rows.append([names[kind], *cells, f"{100 * off:.1f} %"])
    header = ["", "d log Z / d log sigma_w", "d log Z / d log sigma_z", "second off by"]
    note = (f"One class, {GRADIENT_STEPS} steps, multinomial resampling in every step, {count} particles; "
            f"taken at {AWAY} of the true sigma_z.")  # fmt: skip
    return Table("gradient", "Slope of the log evidence", header, rows, note, len(found["score"]))
