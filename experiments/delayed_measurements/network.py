"""Real input: a vehicle's position through a weak 5G network. The channel is learnt, its stalls are met."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.bootstrap import Bootstrap
from experiments.delayed_measurements import figures
from experiments.delayed_measurements.network_data import (
    BLOCK,
    LEARN,
    NOISE_SEED,
    SIGMA,
    START,
    TRANSFER,
    D,
    Record,
    bursts,
    given,
    half,
    intervals,
    load,
    records,
    shuffled,
)
from experiments.planar import in_parallel
from experiments.report import Cell, Entry, Options, Table
from jaxfilt import tune

Params = dict[str, Any]

# What is learnt: the motion's and the sensor's noise of each, and the channel of the first two.
LEARNT = {"exact": "nothing", "posterior": "nothing", "kf_y0": "nothing", "kf_flag": "arrivals"}
CONTROL = "posterior, shuffled"  # learnt on the same delays in random order
# Where learning begins: nearly all packets are one sample late, as on a network that works.
BEGIN = np.log(np.array([0.01, 0.9, 0.03, 0.02, 0.02]) / 0.02)
FEW = 4  # blocks, below which there is no standard error
CLASSES = ("on time", *(f"{lag} late" for lag in range(1, D + 1)), "lost")
_ADAM = optax.adam(0.2)  # made once: an optimizer is compared by identity


# --- models and filters -----------------------------------------------------------------------------------------------


def _reverting(q: Array, omega: Array, u: Any, dt: Array) -> Array:
    """Transition over dt of ``x'' = -2 omega x' - omega^2 x + w`` (critically damped), for two axes."""
    del q, u
    one = jnp.ones_like(dt)
    block = jnp.stack([jnp.stack([one + omega * dt, dt]), jnp.stack([-(omega**2) * dt, one - omega * dt])])
    return jnp.kron(jnp.exp(-omega * dt) * block, jnp.eye(2))


def _stationary(q: Array, omega: Array) -> Array:
    """The covariance in which it settles, for the density q [m^2/s^3] of w."""
    return jnp.kron(jnp.diag(jnp.stack([q / (4 * omega**3), q / (4 * omega)])), jnp.eye(2))


def _reverting_noise(q: Array, omega: Array, u: Any, dt: Array) -> Array:
    F, P = _reverting(q, omega, u, dt), _stationary(q, omega)
    return P - F @ P @ F.T


def motion(params: Params) -> jf.models.LinearGaussian:
    """Nearly constant velocity; with a rate omega, drawn back to the origin, which makes it stable."""
    q, r = params["q"], params["r"]
    if "omega" not in params:
        P0 = np.diag([SIGMA**2, SIGMA**2, 25.0, 25.0])
        return jf.models.constant_velocity(dt=0.055, q=q, r=r, m0=np.zeros(4), P0=P0)
    noise = Partial(_reverting_noise, q, params["omega"])
    transition = Partial(_reverting, q, params["omega"])
    P0 = _stationary(q, params["omega"])
    return jf.models.linear_gaussian(transition, np.eye(2, 4), noise, r * jnp.eye(2), np.zeros(4), P0)


def channel(params: Params) -> Array:
    """Probabilities (D+2,) from their logits against "lost"."""
    return jax.nn.softmax(jnp.concatenate([params["logits"], jnp.zeros((1,))]))


def make(name: str, params: Params) -> jf.Filter:
    """A filter by name."""
    model = motion(params)
    if name in ("exact", "posterior"):
        return jf.delayed_kalman(model, channel(params), second_moment=name)
    if name == "kf_hold":
        return jf.hold_last(jf.kalman(model))
    return jf.kalman(jf.models.with_lags(model, D) if name == "kf_ts" else model)


def _adaptive(name: str, params: Params) -> jf.Filter:
    return jf.adaptive_delayed_kalman(motion(params), channel(params), window=5, second_moment=name)


# --- learning ---------------------------------------------------------------------------------------------------------


def space(name: str) -> Params:
    """What is learnt for a filter: q [m^2/s^3], r [m^2], and what else it knows."""
    found: Params = {"q": tune.positive(1.0, 1e-4, 1e5), "r": tune.positive(1.0, 1e-2, 1e5)}
    if name in ("exact", "posterior"):
        found["logits"] = tune.real(BEGIN, -8.0, 8.0)
    if name == "exact":
        found["omega"] = tune.positive(0.1, 1e-3, 1.0)
    return found


def loss(name: jf.Static, params: Params, data: dict[str, Array | None]) -> Array:
    """Innovation likelihood [nats per sample] of what the filter is given."""
    ys, mask, dt = data["ys"], data["mask"], data["dt"]
    assert ys is not None
    filt = make(name.value, params)
    return tune.innovation_nll(filt, ys, mask=mask, dt=dt, warmup=20, first_update_only=True)


def learn(name: str, record: Record, stop: int, steps: int) -> tune.TuneResult:
    """The parameters of a filter from the samples before ``stop``."""
    delays = record.delays[:stop]
    if name == CONTROL:
        name, delays = "posterior", np.random.default_rng(NOISE_SEED).permutation(delays)
    g = given(record.packets[:stop], delays, LEARNT[name])
    mask = None if g.mask is None else jnp.asarray(g.mask)
    data = {"ys": jnp.asarray(g.ys[None]), "mask": mask, "dt": jnp.asarray(intervals(record.t[:stop]))}
    objective = Partial(loss, jf.Static(name))
    return tune.gradient(
        objective, space(name), data, key=jax.random.key(0), optimizer=_ADAM, steps=steps, block=steps
    )  # fmt: skip


# --- estimates --------------------------------------------------------------------------------------------------------


class Estimator(NamedTuple):
    """A row of the table."""

    filt: jf.Filter | None  # None: the last value received
    told: str
    blind: bool = False  # gets no measurement at all


def estimators(learnt: dict[str, Params], counted: np.ndarray) -> dict[str, Estimator]:
    """All rows for which something was learnt; ``counted`` (D+2,) are the frequencies of the delays learnt on."""
    found = {"open": Estimator(make("kf_flag", learnt["kf_flag"]), "arrivals", True)}
    if "kf_y0" in learnt:
        found["kf_y0"] = Estimator(make("kf_y0", learnt["kf_y0"]), "nothing")
    found["hold"] = Estimator(None, "arrivals")
    found["kf_hold"] = Estimator(make("kf_hold", learnt["kf_flag"]), "arrivals")
    for name in ("exact", "posterior"):
        if name in learnt:
            found[f"nominal, {name}"] = Estimator(make(name, learnt[name]), "nothing")
            found[f"adaptive 5, {name}"] = Estimator(_adaptive(name, learnt[name]), "nothing")
    counts = jnp.asarray(np.maximum(counted, 1e-12))
    counts = {**learnt["kf_flag"], "logits": jnp.log(counts[:-1]) - jnp.log(counts[-1])}
    found["nominal, posterior, counted"] = Estimator(make("posterior", counts), "nothing")
    found["kf_flag"] = Estimator(make("kf_flag", learnt["kf_flag"]), "arrivals")
    found["kf_ts"] = Estimator(make("kf_ts", learnt["kf_flag"]), "stamps")
    found["kf_ts, all packets"] = Estimator(make("kf_ts", learnt["kf_flag"]), "packets")
    return found


@jax.jit
def _filtered(filt: jf.Filter, ys: Array, mask: Array | None, dt: Array) -> Array:
    def one(y, mask):
        return jf.filter(filt, y, mask=mask, dt=dt, first_update_only=True, outputs=_position)

    return jax.vmap(one, (0, None if mask is None else 0))(ys, mask)


def _position(state: Any, info: jf.Info) -> Array:
    del state
    return info.mean[:2]


def estimate(estimator: Estimator, record: Record, delays: np.ndarray) -> np.ndarray:
    """Positions (S, T, 2) at each sample, for delays (S, T)."""
    all_given = [given(record.packets, d, estimator.told) for d in delays]
    ys = np.stack([g.ys for g in all_given])
    masks = [g.mask for g in all_given if g.mask is not None]
    mask = np.stack(masks) if masks else None
    if estimator.filt is None:
        assert mask is not None
        newest = np.maximum.accumulate(np.where(mask[..., 0], np.arange(ys.shape[1]), -1), axis=1)
        held = np.take_along_axis(ys, np.maximum(newest, 0)[..., None], axis=1)
        return np.where(newest[..., None] >= 0, held, 0.0)
    if estimator.blind:
        mask = np.zeros(ys.shape, bool)
    return np.asarray(_filtered(estimator.filt, ys, mask, intervals(record.t)))


def connected(record: Record) -> np.ndarray:
    """(T,) whether a packet has arrived at this sample or in the D before it."""
    mask = given(record.packets, record.delays, "arrivals").mask
    assert mask is not None
    padded = np.concatenate([np.ones(D, bool), mask[:, 0]])
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, D + 1).any(axis=1))


# --- the experiment ---------------------------------------------------------------------------------------------------


class Outcome(NamedTuple):
    """All that tables and figures show."""

    records: dict[str, Record]
    learnt: dict[str, tune.TuneResult]
    counted: np.ndarray  # (D+2,) frequencies in what was learnt on
    squared: dict[str, dict[str, np.ndarray]]  # by recording and estimator (1 + shuffles, T) m^2


def compute(options: Options) -> Outcome:
    """Learns on the first half of one recording, and replays both, also with the order of the delays shuffled."""
    found = records()
    stop = half(len(load(LEARN)[0]))
    names = ("kf_flag",) if options.quick else (*LEARNT, CONTROL)
    steps = 40 if options.quick else 100
    results = in_parallel(lambda name: learn(name, found[LEARN], stop, steps), names)
    learnt = dict(zip(names, results, strict=True))
    counted = np.bincount(found[LEARN].delays[:stop], minlength=D + 2) / stop
    rows = estimators({name: result.params for name, result in learnt.items()}, counted)
    rng = np.random.default_rng(options.seed)
    squared = {}
    for name, record in found.items():
        delays = np.stack([record.delays, *(shuffled(record, rng) for _ in range(3 if options.quick else 10))])
        positions: Any = in_parallel(lambda row, r=record, d=delays: estimate(row, r, d), list(rows.values()))
        squared[name] = {
            row: np.sum((np.asarray(p) - record.position) ** 2, axis=-1) for row, p in zip(rows, positions, strict=True)
        }
    return Outcome(found, learnt, counted, squared)


def show(o: Outcome, options: Options) -> tuple[list[Table], list[Path], list[str]]:
    """Tables, figures and findings."""
    rng = np.random.default_rng(options.seed)
    tables = [learnt_table(o), burst_table(o), *(error_table(o, name, rng) for name in o.records)]
    directory = options.directory("delayed_measurements")
    record = o.records[LEARN]
    errors = {name: np.sqrt(squared[0]) for name, squared in o.squared[LEARN].items()}
    paths = [
        figures.burst_histogram(
            directory / "network_bursts.png", late_bursts(record), late_share(o), length(record)
        ),
        figures.network_course(
            directory / "network_course.png", record.t, errors, connected(record), record.scored
        ),
    ]  # fmt: skip
    return tables, paths, findings(o)


def length(record: Record) -> int:
    """Packets of the recording without its padding."""
    return int(np.flatnonzero(record.scored)[-1]) + 1


def late_bursts(record: Record) -> np.ndarray:
    """Lengths of runs of packets that are more than one sample late or lost."""
    return bursts(record.delays[: length(record)] > 1)


def late_share(o: Outcome) -> float:
    """The probability that a packet is more than one sample late or lost, learnt where packets are independent."""
    p = np.asarray(channel(o.learnt[CONTROL].params)) if CONTROL in o.learnt else o.counted
    return float(p[2:].sum())


def learnt_table(o: Outcome) -> Table:
    """What was learnt, beside the frequencies."""
    rows: list[list[Entry]] = []
    frequencies = {"counted, first half": o.counted}
    record = o.records[LEARN]
    second = record.delays[record.scored]
    frequencies["counted, second half"] = np.bincount(second, minlength=D + 2) / len(second)
    scored = o.records[TRANSFER].delays[o.records[TRANSFER].scored]
    frequencies[f"counted, {TRANSFER}"] = np.bincount(scored, minlength=D + 2) / len(scored)
    for name, p in frequencies.items():
        rows.append([name, "", "", "", *map(float, p), ""])
    for name, result in o.learnt.items():
        p = [float(x) for x in channel(result.params)] if "logits" in result.params else [""] * (D + 2)
        omega = float(result.params["omega"]) if "omega" in result.params else ""
        q, r = (float(result.params[x]) for x in "qr")
        rows.append([f"learnt, {name}", Cell(q), Cell(np.sqrt(r)), omega, *p, Cell(result.loss, digits=4)])
    header = ["", "q [m²/s³]", "sqrt(r) [m]", "omega [1/s]", *CLASSES, "loss [nats]"]
    note = (
        f"On the first half of {LEARN}, each by the innovation likelihood of what it is given, so losses compare only "
        "among those that are given the same. kf_hold, kf_ts and 'counted' take the noise of kf_flag. True noise of "
        f"the packets {SIGMA:g} m. 'exact': with the mean-reverting motion, since it needs a stable model; all others "
        "nearly constant velocity. Nothing is on time, because the samples are the instants of sending. Without time "
        "stamps a delay common to all packets cannot be told from a vehicle further back: learning begins where "
        "nearly all are one sample late. 'Shuffled': learnt on the same packets with the delays in random order."
    )
    return Table("network_learnt", "The channel and the noise, learnt", header, rows, note)


def burst_table(o: Outcome) -> Table:
    """Runs of late or lost packets, recorded and as the learnt independent channel has them."""
    rows: list[list[Entry]] = []
    for name, record in o.records.items():
        lengths = late_bursts(record)
        n = length(record)
        b = lengths.sum() / n
        rows.append([name, n, len(lengths), Cell(lengths.mean()), int(lengths.max()),
                     Cell(100 * lengths[lengths > D].sum() / n), Cell(100 * b)])  # fmt: skip
        rows.append([f"{name}, independent", n, Cell(n * b * (1 - b)), Cell(1 / (1 - b)), _longest(n, b),
                     Cell(100 * _beyond(b)), Cell(100 * b)])  # fmt: skip
    n, b = len(o.records[LEARN].t), late_share(o)
    rows.append(["learnt, independent", n, Cell(n * b * (1 - b)), Cell(1 / (1 - b)), _longest(n, b),
                 Cell(100 * _beyond(b)), Cell(100 * b)])  # fmt: skip
    header = ["", "packets", "bursts", "mean length", "longest", f"packets in bursts above {D} [%]",
              "late or lost [%]"]  # fmt: skip
    note = (
        "Bursts: runs of packets that are two or more samples late, or lost. 'Independent': what packets drawn one by "
        "one with the same share of such ones would give, expected values (the longest: the length that is met once)."
    )
    return Table("network_bursts", "Bursts of late and lost packets", header, rows, note)


def _longest(n: int, b: float) -> Entry:
    return Cell(np.log(1 / (n * (1 - b))) / np.log(b), digits=2)


def _beyond(b: float) -> float:
    """The share of packets in runs of more than D: sum over lengths l > D of l b^l (1-b)^2."""
    return b ** (D + 1) * (1 + D * (1 - b))


def _blocks(record: Record, values: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Totals and counts by block of time over the chosen samples of the scored part."""
    use = record.scored & chosen
    count = record.block[record.scored].max() + 1
    return (np.bincount(record.block[use], values[use], count), np.bincount(record.block[use], minlength=count))


def error_table(o: Outcome, name: str, rng: np.random.Generator) -> Table:
    """RMSE of the position at the current time, as recorded and with the delays shuffled."""
    record = o.records[name]
    every, link = np.ones(len(record.t), bool), connected(record)
    count = record.block[record.scored].max() + 1
    groups = [Bootstrap(_blocks(record, every, chosen)[1] > 0, rng) for chosen in (every, link, ~link)]
    rows: list[list[Entry]] = []
    for row, squared in o.squared[name].items():
        cells: list[Entry] = [
            _rmse(group, *_blocks(record, squared[0], chosen))
            for group, chosen in zip(groups, (every, link, ~link), strict=True)
        ]
        replay = np.sqrt(squared[1:, record.scored].mean(axis=1))
        cells.append(Cell(replay.mean(), replay.std(ddof=1) / np.sqrt(len(replay))))
        rows.append([row, *cells, Cell(np.sqrt(squared[0, record.scored].mean()) / replay.mean())])
    header = ["estimator", "RMSE [m]", "connected [m]", "stalled [m]", "delays shuffled [m]", "recorded / shuffled"]
    n, m = int(record.scored.sum()), int((record.scored & link).sum())
    where = "its second half" if name == LEARN else f"after the first {START:g} s, nothing learnt on it"
    note = (
        f"{name}, {where}: {n} samples scored, {m} of them connected (a packet has arrived at this sample or in the "
        f"{D} before it). Standard errors by bootstrap over {count} blocks of {BLOCK:g} s, so few that they are rough "
        f"themselves; none where fewer than {FEW} blocks hold such samples. Shuffled: the same delays in random order, "
        f"{len(replay)} times, mean and its standard error. Noise of the packets: seed {NOISE_SEED}."
    )
    return Table(f"network_{name}", f"Position at the current time, {name}", header, rows, note)


def _rmse(group: Bootstrap, total: np.ndarray, count: np.ndarray) -> Entry:
    if len(group.group) < FEW:
        return Cell(np.sqrt(total.sum() / count.sum()))
    return group.cell(total, count)


def findings(o: Outcome) -> list[str]:
    """What the tables say."""

    def rms(name, row, replay=False, chosen=None):
        record, squared = o.records[name], o.squared[name][row]
        use = record.scored if chosen is None else record.scored & chosen
        return float(np.sqrt(squared[0, use].mean())) if not replay else float(
            np.sqrt(squared[1:, use].mean(axis=1)).mean()
        )  # fmt: skip

    rows = list(o.squared[LEARN])
    delayed = [row for row in rows if row.startswith(("nominal", "adaptive"))]
    parts, shuffles, links = [], [], []
    for name in o.records:
        best = min(delayed, key=lambda row: rms(name, row))
        shown = ", ".join(f"{row} {rms(name, row):.3g} m" for row in ("kf_ts", "kf_flag", "hold"))
        parts.append(f"{name}: {shown}; best, as found here, of those told neither delay nor arrival: {best} "
                     f"{rms(name, best):.3g} m, open {rms(name, 'open'):.3g} m")  # fmt: skip
        link = connected(o.records[name])
        shown = ", ".join(f"{row} {rms(name, row, chosen=link):.3g} m" for row in ("kf_ts", "kf_flag", "hold", best))
        links.append(f"{name}: {shown}")
        shown = ", ".join(f"{row} {rms(name, row) / rms(name, row, True):.3g}" for row in ("kf_ts", "kf_flag", best))
        shuffles.append(f"{name}: {shown}")
    lengths, b = late_bursts(o.records[LEARN]), late_share(o)
    found = [
        "5G recordings, RMSE of a vehicle's position now: " + "; ".join(parts) + ". A receiver knows whether something "
        "has arrived, and that is worth more than any model of the channel.",
        f"While the link works (a packet within the last {D} samples): {'; '.join(links)}. In stalls every filter only "
        "extrapolates.",
        f"Losses are not independent: runs of late or lost packets on {LEARN} last {lengths.mean():.3g} packets on "
        f"average and up to {lengths.max()}; independent packets with the learnt probabilities would make "
        f"{1 / (1 - b):.3g}. RMSE recorded / with the delays shuffled: {'; '.join(shuffles)}.",
    ]
    if "nominal, exact" in rows:
        pairs = [
            f"{name}: {rms(name, 'nominal, exact'):.3g} and {rms(name, 'adaptive 5, exact'):.3g} m (exact), "
            f"{rms(name, 'nominal, posterior'):.3g} and {rms(name, 'adaptive 5, posterior'):.3g} m (posterior)"
            for name in o.records
        ]
        found.append(
            "Where the channel's model is as wrong as here, adapting helps the filters that are told nothing, nominal "
            f"against adaptive: {'; '.join(pairs)}. All of them stay behind holding the last value, which needs no "
            "more than the arrivals."
            if all(rms(name, "hold") < min(rms(name, row) for row in delayed) for name in o.records)
            else f"Filters that are told nothing, nominal against adaptive: {'; '.join(pairs)}."
        )
    if CONTROL in o.learnt:
        p, q = (np.asarray(channel(o.learnt[name].params)) for name in ("posterior", CONTROL))
        second = o.records[LEARN].delays[o.records[LEARN].scored]
        found.append(
            "The channel is not found from the recorded packets without time stamps: learning ends at "
            f"{p[-1]:.3f} lost and {p[1]:.2f} one sample late (most, {p[:-1].max():.2f}, "
            f"{CLASSES[int(p[:-1].argmax())]}), where {o.counted[-1]:.3f} and {o.counted[1]:.2f} are counted. "
            f"With the same delays in random order it ends at {q[-1]:.3f} and {q[1]:.2f}. "
            f"Nor does the channel last: in the second half {(second == D + 1).mean():.3f} are lost."
        )
    return found
