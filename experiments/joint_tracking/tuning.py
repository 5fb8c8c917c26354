"""The IMM bank's parameters by gradient and by GA: one loss, box and budget; then in the particle filter.

The bank is smooth in all of them; what it finds is handed to the particle filter, which has the same parameters.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.joint_tracking import system
from experiments.joint_tracking.runs import POSITION, VELOCITY, evaluate, root_mean, share
from experiments.joint_tracking.system import DEMO, Config, Data
from experiments.report import Cell, Entry, Table
from jaxfilt import tune

Params = dict[str, Any]
TUNED = ("accel", "omega", "sigma_w", "dwell", "gamma")


def space() -> dict[str, Any]:
    """The hand-set values, each free by a factor of 10 either way."""
    return {name: tune.positive(np.array(getattr(DEMO, name)), np.array(getattr(DEMO, name)) / 10,
                                np.array(getattr(DEMO, name)) * 10) for name in TUNED}  # fmt: skip


def config(params: Params) -> Config:
    """The configuration with tuned values."""
    return DEMO._replace(**{name: params[name] for name in TUNED})


def _reported(state, info):
    del state
    return info.mean, info.extra["log_probabilities"]


def losses(params: Params, data: tuple[Data, Data]) -> Array:
    """(2,) position RMSE from 2 s on in units of 10 m, and mean cross-entropy of the class [nats]; both paths alike."""
    c = config(params)
    found = []
    for label, part in enumerate(data):
        mean, log_p = jax.vmap(
            lambda first, ys: jf.filter(system.imm_bank(c, first), ys, outputs=_reported)
        )(part.first, part.ys)  # fmt: skip
        square = jnp.sum((mean - part.truth[None])[:, 20:, POSITION] ** 2, axis=2)
        found.append((jnp.mean(square), -jnp.mean(log_p[:, 20:, label])))
    (a, p), (b, q) = found
    return jnp.stack([jnp.sqrt((a + b) / 2) / 10.0, (p + q) / 2])


def loss(params: Params, data: tuple[Data, Data]) -> Array:
    """Their sum."""
    return losses(params, data).sum()


def learn(key: Array, runs: int, steps: int) -> dict[str, tune.TuneResult]:
    """Both tuners with ``2 * steps`` evaluations on the same runs."""
    data_key, search_key = jax.random.split(key)
    data = tuple(system.simulate(DEMO, c, runs, data_key) for c in (0, 1))
    common = space(), data
    by_gradient = tune.gradient(
        Partial(loss), *common, key=search_key, steps=steps, starts=2, spread=0.3, block=max(1, steps // 10)
    )
    genetic = tune.genetic(Partial(loss), *common, key=search_key, population=10, generations=2 * steps // 10)
    return {"gradient": by_gradient, "genetic": genetic}


def table(results: dict[str, tune.TuneResult], runs: int, key: Array) -> Table:
    """What was found, what it cost, and scores on fresh runs of the bank and of the particle filter."""
    params: dict[str, Params] = {"by hand": {name: getattr(DEMO, name) for name in TUNED}}
    params |= {name: result.params for name, result in results.items()}
    makes = {"IMM bank": Partial(system.imm_bank), "single filter": Partial(system.single, jf.Static((5000,)), 0.5)}
    rows: list[list[Entry]] = []
    for name, p in params.items():
        values = {
            k: np.round(np.asarray(v, float), 4 - int(np.log10(np.max(np.abs(np.asarray(v))) + 1)))
            for k, v in p.items()
        }
        shown = "; ".join(f"{k} {np.array2string(v, separator=', ')}" for k, v in values.items())
        result = results.get(name)
        cost: list[Entry] = ["-", "-", "-"]
        if result is not None:
            cost = [Cell(result.loss), result.evaluations, Cell(result.wall_time, digits=2)]
        for filt, make in makes.items():
            arrays = {k: jnp.asarray(v, float) for k, v in p.items()}
            outs = [evaluate(make, config(arrays), c, runs, key) for c in (0, 1)]
            scores = [root_mean(out.rmse(part)) for part in (POSITION, VELOCITY) for out in outs]
            entropy = np.concatenate([-out.log_p[:, 20:, out.label].mean(axis=1) for out in outs])
            nats = Cell(float(entropy.mean()), float(entropy.std(ddof=1) / np.sqrt(len(entropy))))
            rows.append([f"{name}, {filt}", *scores, nats, *(share(out.right) for out in outs), *cost, shown])
            shown = "as above"
    header = ["parameters, filter", "position RMSE, class 1 [m]", "position RMSE, class 2 [m]",
              "velocity RMSE, class 1 [m/s]", "velocity RMSE, class 2 [m/s]", "class cross-entropy [nats]",
              "class 1 right", "class 2 right", "training loss", "evaluations", "time [s]", "values"]  # fmt: skip
    note = ("Loss: position RMSE / 10 m + cross-entropy of the class, of the IMM bank from 2 s on; scores on fresh "
            "runs. One evaluation of the gradient is a value and a gradient; time without compilation.")  # fmt: skip
    return Table("tuning", "Tuning", header, rows, note, runs)
