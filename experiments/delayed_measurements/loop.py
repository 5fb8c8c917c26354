"""The loop closed on the estimate: a linear regulation problem, plant and estimator stepped together.

A surrogate for the paper's figures 4 and 7, whose profiles are not printed. The plant is that of :mod:`plant` without
its feedback: with ``g = h'' + u_c`` and ``s = (h''' + u_c') / K + u_c`` the loop's equation becomes ::

    h'' = g - u_c,    g' = K (s - u_c),    s' = w / K

where the command enters undifferentiated. It is computed from the estimate at each sample and held until the next.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxfilt as jf
from experiments.delayed_measurements import plant
from experiments.delayed_measurements.scenarios import ALPHAS, LAST
from experiments.planar import in_parallel
from experiments.report import Cell, Entry, Table
from jaxfilt.core import StepInput

TRUTH = "true state"
AUTONOMOUS = "kf_ts, autonomous model"
MODES = ("zero_mean", "exact", "posterior")


class Case(NamedTuple):
    """Who computes the command."""

    told: str  # nothing, arrivals, stamps; without a filter: truth, raw
    filt: jf.Filter | None = None  # None: the derivative by differences
    autonomous: bool = False  # takes the loop with its feedback for its model, as the paper does, and not the command


class Loop(NamedTuple):
    """Runs of one loop, (B, T)."""

    h: Array  # m
    estimate: Array  # m
    command: Array  # m/s^2


def open_plant() -> tuple[np.ndarray, np.ndarray]:
    """A (T, 4, 4) and B (T, 4, 2) for the state [h, h', g, s] and the inputs [u_c, w]."""
    g, _ = plant.gains(plant.DT * np.arange(plant.T))
    Ac, Bc = np.zeros((plant.T, 4, 4)), np.zeros((plant.T, 4, 2))
    Ac[:, 0, 1] = Ac[:, 1, 2] = 1.0
    Ac[:, 2, 3] = g.k
    Bc[:, 1, 0], Bc[:, 2, 0], Bc[:, 3, 1] = -1.0, -g.k, 1 / g.k
    return plant.zero_order_hold(Ac, Bc)


def to_open() -> np.ndarray:
    """(4, 4) [h, h', g, s] from [h, h', h'', h'''] at the start, where the loop was closed on the truth until then."""
    g, slope = plant.gains(np.zeros(()))
    u = np.array([g.p, g.d, 0.0, 0.0])
    du = np.array([slope.p + g.i, g.p + slope.d, g.d, 0.0])
    identity = np.eye(4)
    return np.stack([identity[0], identity[1], identity[2] + u, (identity[3] + du) / g.k + u])


def inputs() -> dict[str, Any]:
    """What varies with time, entry k for the interval that ends at k: the plant, and the loop with its feedback.

    Over the interval before the first sample nothing changes, so that the prior is at that sample.
    """
    A, B = open_plant()
    closed, closed_B = plant.discrete()

    def moved(x, first):
        return np.concatenate([np.broadcast_to(first, x.shape[1:])[None], x[:-1]])

    def noise(b):
        return moved(plant.QW * b[:, :, None] * b[:, None, :], 0.0)

    zero = np.zeros((plant.T, 4))
    return {
        "A": moved(A, np.eye(4)),
        "command": moved(B[:, :, 0], 0.0),
        "noise": moved(B[:, :, 1], 0.0),
        "Q": noise(B[:, :, 1]),
        "autonomous": {"F": moved(closed, np.eye(4)), "Q": noise(closed_B), "input": zero},
        "weights": plant.command_weights(),
    }


def open_model() -> jf.models.LinearGaussian:
    """The open plant as a filter's model; the command is a known input."""
    M, loop = to_open(), plant.model()
    P0 = M @ np.asarray(loop.P0) @ M.T
    return loop._replace(m0=jnp.asarray(M @ np.asarray(loop.m0)), P0=jnp.asarray(0.5 * (P0 + P0.T)))


def cases(assumed: tuple[float, ...]) -> dict[str, Case]:
    """The loops that are compared."""
    model, p = open_model(), jf.models.delay_probabilities(np.array(assumed))
    found = {TRUTH: Case("truth"), "raw y": Case("raw")}
    for mode in MODES:
        found[f"nominal, {mode}"] = Case("nothing", jf.delayed_kalman(model, p, second_moment=mode))
        adaptive = jf.adaptive_delayed_kalman(model, p, window=5, second_moment=mode)
        found[f"adaptive 5, {mode}"] = Case("nothing", adaptive)
    found["kf_flag"] = Case("arrivals", jf.kalman(model))
    found["kf_ts"] = Case("stamps", jf.kalman(jf.models.with_lags(model, plant.D)))
    loop = plant.model()
    adaptive = jf.adaptive_delayed_kalman(loop, p, window=5, second_moment="zero_mean")
    found["adaptive 5, zero_mean, autonomous model"] = Case("nothing", adaptive, True)
    found[AUTONOMOUS] = Case("stamps", jf.kalman(jf.models.with_lags(loop, plant.D)), True)
    return found


def simulate(chosen: dict[str, Case], true: tuple[float, ...], runs: int, seed: int) -> dict[str, Loop]:
    """All loops with the same noise and delays."""
    M = to_open()
    start = jnp.asarray(np.column_stack([M @ np.array(plant.M0), M * np.sqrt(plant.P0)]))
    shared = jax.tree.map(jnp.asarray, inputs()), start, jf.models.delay_probabilities(np.array(true))
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(seed), jnp.arange(runs))

    def run(case):
        return jax.block_until_ready(_runs(case.filt, *shared, keys, case.told, case.autonomous))

    return dict(zip(chosen, in_parallel(run, list(chosen.values())), strict=True))


@partial(jax.jit, static_argnames=("told", "autonomous"))
def _runs(filt, u, start, p, keys, told, autonomous):
    return jax.vmap(lambda key: _run(filt, u, start, p, key, told, autonomous))(keys)


def _run(filt, u, start, p, key, told, autonomous):
    keys = jax.random.split(key, 4)
    x = start[:, 0] + start[:, 1:] @ jax.random.normal(keys[0], (4,), start.dtype)
    w = np.sqrt(plant.QW) * jax.random.normal(keys[1], (plant.T,), start.dtype)
    v = np.sqrt(plant.R) * jax.random.normal(keys[2], (plant.T,), start.dtype)
    delays = jf.simulate.draw_delays(p, (plant.T,), keys[3])
    # What arrives when does not depend on what it holds.
    lag = jf.simulate.deliver(jnp.zeros((plant.T, 1), start.dtype), delays, plant.D).lag[:, 0]
    zero = jnp.zeros((), start.dtype)

    def filter_input(now, y, lag, command):
        belief = {"F": now["A"], "Q": now["Q"], "input": now["command"] * command}
        belief = now["autonomous"] if autonomous else belief
        if told == "stamps":
            one = jf.lag_inputs(y[None, None], lag[None], plant.D)
            return StepInput(one["ys"][0], one["mask"][0], u=belief)
        return StepInput(y[None], (lag >= 0)[None] if told == "arrivals" else None, u=belief)

    def step(carry, entry):
        x, state, integral, command, sent, before = carry
        now, w, v, lag = entry
        x = now["A"] @ x + now["command"] * command + now["noise"] * w
        sent = jnp.concatenate([(x[0] + v)[None], sent[:-1]])
        y = jnp.where(lag >= 0, sent[jnp.maximum(lag, 0)], zero)
        if filt is not None:
            state, info = jf.step(filt, state, filter_input(now, y, lag, command))
            h, rate = info.mean[0], info.mean[1]
        elif told == "truth":
            h, rate = x[0], x[1]
        else:
            h, rate = y, (y - before) / plant.DT
        integral = integral + now["weights"][2] * h
        command = now["weights"][0] * h + now["weights"][1] * rate + integral
        return (x, state, integral, command, sent, y), Loop(x[0], h, command)

    state = None
    if filt is not None:
        first = jax.tree.map(lambda a: a[0], u)
        state = filt.init(filter_input(first, zero, jnp.int32(-1), zero))
    carry = (x, state, zero, zero, jnp.zeros((plant.D + 1,), start.dtype), zero)
    return jax.lax.scan(step, carry, (u, w, v, lag))[1]


def mean_squares(loops: dict[str, Loop]) -> dict[str, dict[str, np.ndarray]]:
    """Per loop and run: of h, of h at the end, of the estimate's error, and of the command's deviation."""
    ideal = np.asarray(loops[TRUTH].command)
    return {
        name: {
            "h": np.mean(np.square(loop.h), axis=1),
            "end": np.mean(np.square(loop.h[:, -LAST:]), axis=1),
            "estimate": np.mean(np.square(loop.estimate - loop.h), axis=1),
            "command": np.mean(np.square(loop.command - ideal), axis=1),
        }
        for name, loop in loops.items()
    }


def table(results: dict[str, dict[str, Loop]]) -> Table:
    """RMS of the loops in both directions of the assumed probabilities."""
    scores = {direction: mean_squares(loops) for direction, loops in results.items()}
    parts = {"h": "h [m]", "end": "h at the end [m]", "command": "command [m/s²]"}
    rows: list[list[Entry]] = []
    for name in next(iter(scores.values())):
        row: list[Entry] = [name]
        for own in scores.values():
            row += [Cell.of(jf.metrics.root_mean(own[name][part])) for part in parts]
        rows.append(row)
    header = ["command from", *(f"{title}, {direction}" for direction in scores for title in parts.values())]
    loops = next(iter(results.values()))
    note = (
        f"RMS over the run, over its last {LAST} samples, and of the command's deviation from that of the loop closed "
        "on the true state with the same noise. 'autonomous model': the filter takes the loop's own equation for its "
        "model, as the paper does, and does not know the command; all others know it."
    )
    title = "The loop closed on the estimate (surrogate for the paper's figures 4 and 7)"
    return Table("loop", title, header, rows, note, len(loops[TRUTH].h))


def findings(results: dict[str, dict[str, Loop]]) -> list[str]:
    """What the table says."""
    parts = []
    rms = {
        direction: {name: str(Cell.of(jf.metrics.root_mean(own["h"]))) for name, own in mean_squares(loops).items()}
        for direction, loops in results.items()
    }
    for direction, own in rms.items():
        pairs = [f"{mode} {own[f'nominal, {mode}']} m and {own[f'adaptive 5, {mode}']} m" for mode in MODES]
        parts.append(
            f"{direction}: true state {own[TRUTH]} m, kf_ts {own['kf_ts']} m, kf_flag {own['kf_flag']} m, "
            f"raw y {own['raw y']} m; nominal and adaptive (window 5) {', '.join(pairs)}"
        )
    return [
        "Loop closed on the estimate, RMS of h: " + "; ".join(parts) + ". The plant without its feedback is a chain of "
        "integrators, so a filter that stops listening, as the adaptive one does, lets it drift, in some "
        "runs far.",
        "With the paper's model, the autonomous loop that does not know its own command, no filter holds the loop, not "
        f"even with time stamps (RMS of h {' and '.join(f'{own[AUTONOMOUS]} m' for own in rms.values())}): that "
        "model holds only for a command that follows the true state without error and without being held over a "
        "sample.",
    ]


def run(runs: int, seed: int) -> dict[str, dict[str, Loop]]:
    """Both directions."""
    return {direction: simulate(cases(assumed), true, runs, seed) for direction, (true, assumed) in ALPHAS.items()}
