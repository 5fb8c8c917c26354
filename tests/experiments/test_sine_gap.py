"""G3, a sine lost for 41 samples: the bands of the specification, section 5.8 item 19, and the published tables."""

from __future__ import annotations

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from experiments.__main__ import ROOT
from experiments.lost_target import sine_gap
from experiments.report import Report, compare

pytestmark = pytest.mark.xdist_group("sine_gap")  # one process, so that its tests share what they compute

SMALL = ("EKF coast", "UKF coast")  # one compiled program for all default tests
COAST, HOLD, MEAN = "EKF coast", "EKF hold", "EKF mean 5"
FIT, POLYNOMIAL = "EKF fit sinusoid N50", "EKF fit N20 p2"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_bands(seed):
    result = sine_gap.simulate(0.1, 2000, seed)

    def lost(name):
        return float(result.mean(name, "lost").value)

    assert lost(HOLD) >= 0.95
    assert lost(MEAN) >= 0.95
    assert lost(POLYNOMIAL) >= 0.85
    assert lost(COAST) <= 0.06
    assert lost("EKF2 coast") <= 0.75 * lost(COAST)
    assert lost("UKF coast") <= 0.75 * lost(COAST)
    assert 1.02 <= float(result.ratio((FIT, "gap"), (COAST, "gap"), root=True).value) <= 1.18


@pytest.mark.slow
def test_without_a_gap_no_strategy_does_anything():
    result = sine_gap.simulate(0.1, 100, 0, gap=False)
    for name in result.scores:
        if name.startswith("EKF ") and name != COAST:
            for part, values in result.scores[name].items():
                np.testing.assert_allclose(values, result.scores[COAST][part], rtol=1e-12, atol=1e-15)


@functools.cache
def small(r: float, gap: bool = True) -> jf.MonteCarloResult:
    return sine_gap.simulate(r, 400, 1, gap=gap, names=SMALL)


@functools.cache
def published() -> dict:
    everything = json.loads((ROOT / "lost_target" / "published.json").read_text(encoding="utf-8"))
    chosen = {*SMALL, *(name.replace(" coast", ", no gap") for name in SMALL)}
    for name, table in everything["tables"].items():
        if name.startswith("g3-"):
            table["rows"] = [row for row in table["rows"] if row[0] in chosen]
    return everything


def test_published_tables_agree_with_a_small_run():
    """Another seed and 400 runs of two filters; the comparison fails for a table of the other noise."""
    tables = {r: sine_gap.table(r, small(r), small(r, False)) for r in sine_gap.NOISE}
    assert compare(published(), Report("lost_target", "", list(tables.values()))) == []
    tables[0.1].rows = tables[1.0].rows
    for row, other in zip(tables[0.1].rows, sine_gap.table(0.1, small(0.1), small(0.1, False)).rows, strict=True):
        row[1] = other[1]  # the prototype's figures are part of a row's name
    assert compare(published(), Report("lost_target", "", [tables[0.1]])) != []


def test_no_run_has_an_unexpected_status():
    for words in small(0.1).status.values():
        assert set(words.tolist()) == {int(jf.Status.MISSED)}
    for words in small(0.1, False).status.values():
        assert not words.any()


@jax.jit
def phases(filt, ys, mask):
    def one(y):
        return jf.filter(filt, y, mask=mask, outputs=sine_gap.reported, first_update_only=True)

    return jax.vmap(one)(ys)


def prototype_runs(r):
    """The truth (N, T) and the measurements (N, T, 1) of the specification's prototype, by its random numbers."""
    rng = np.random.default_rng(0)
    w = rng.standard_normal((sine_gap.T - 1, 2000, 2)) @ np.linalg.cholesky(sine_gap.process_noise()).T
    v = rng.standard_normal((sine_gap.T, 2000))
    states = [np.tile(sine_gap.START, (2000, 1))]
    for noise in w:
        states.append(states[-1] @ np.array([[1.0, sine_gap.DT], [0.0, 1.0]]).T + noise)
    phase = np.stack(states, axis=1)[..., 0]
    return phase, (np.sin(phase) + np.sqrt(r) * v.T)[..., None]


@pytest.mark.parametrize("r", sine_gap.NOISE)
@pytest.mark.parametrize("name", ["EKF, no gap", *SMALL])
def test_with_the_prototypes_random_numbers_its_figures_come_out(name, r):
    """To its rounding: three decimals, and a tenth of a per cent of runs lost."""
    truth, ys = prototype_runs(r)
    gap = "no gap" not in name
    mask = jf.simulate.gap_mask(sine_gap.T, (sine_gap.FIRST, sine_gap.LAST)) if gap else np.ones(sine_gap.T, bool)
    out = phases(sine_gap.filters(r)[name.replace(", no gap", " coast")], jnp.asarray(ys), jnp.asarray(mask))
    squared = (np.sin(np.asarray(out.phase)) - np.sin(truth)) ** 2
    tail = sine_gap.TAIL
    spans = (
        slice(sine_gap.FIRST, sine_gap.LAST + 1),
        slice(sine_gap.LAST + 1, sine_gap.LAST + 1 + tail),
        slice(-tail, None),
    )
    found = [np.sqrt(squared[:, span].mean()) for span in spans]
    lost = 100 * np.mean(np.abs(np.asarray(out.phase)[:, -1] - truth[:, -1]) > np.pi / 2)
    *rmse, share = (float(text) for text in sine_gap.PROTOTYPE[r][name].split(" / "))
    np.testing.assert_allclose(found, rmse, atol=0.0006)
    assert abs(lost - share) <= 0.0501


def test_no_estimate_has_seen_a_lost_value():
    """Whatever stands behind the mask, the estimates are the same to the last bit; without the mask they are not."""
    _, ys = prototype_runs(0.1)
    mask = jf.simulate.gap_mask(sine_gap.T, (sine_gap.FIRST, sine_gap.LAST))
    garbage = np.where(mask[:, None], ys, 1e3)
    filt = sine_gap.filters(0.1)[COAST]
    runs = [np.asarray(phases(filt, jnp.asarray(y), jnp.asarray(mask)).phase) for y in (ys, garbage)]
    np.testing.assert_array_equal(*runs)
    seen = phases(filt, jnp.asarray(garbage), jnp.ones(sine_gap.T, bool))
    assert (np.asarray(seen.phase) != runs[0]).any()


def test_a_run_is_scored_as_if_alone():
    """One run of the batch, filtered by itself, has the score that the batch gave it."""
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(1), 5), 0)
    factor = jnp.asarray(np.linalg.cholesky(sine_gap.process_noise()))
    truth, ys = sine_gap.draw(factor, jnp.asarray(0.1), key)
    mask = jf.simulate.gap_mask(sine_gap.T, (sine_gap.FIRST, sine_gap.LAST))
    out = jax.tree.map(
        lambda x: x[0], phases(sine_gap.filters(0.1)[COAST], jnp.tile(ys, (2000, 1, 1)), jnp.asarray(mask))
    )
    alone = sine_gap.score(truth, ys, out)
    for part in ("gap", "after", "end", "lost", "nees"):
        np.testing.assert_allclose(small(0.1).scores[COAST][part][5], float(alone[part]), rtol=1e-9)


def test_a_slipped_cycle_counts_as_lost():
    """sin(theta) is right, the phase is not."""
    truth = jnp.zeros((sine_gap.T, 2))
    variance, status = jnp.ones(sine_gap.T), jnp.zeros(sine_gap.T, jnp.int32)
    slipped, held = (
        sine_gap.score(
            truth, jnp.zeros((sine_gap.T, 1)), sine_gap.Reported(jnp.full(sine_gap.T, angle), variance, status)
        )
        for angle in (2 * np.pi, 1.5)
    )
    assert float(slipped["lost"]) == 1.0
    assert float(held["lost"]) == 0.0
    assert float(slipped["gap"]) < 1e-20
