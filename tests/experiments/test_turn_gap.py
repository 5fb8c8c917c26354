"""G4, a turn under IMM with gaps: the bands of the specification, section 5.8 item 20, and the published tables."""

from __future__ import annotations

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from experiments.__main__ import ROOT
from experiments.lost_target import turn_gap
from experiments.lost_target.turn_gap import COASTS, GAPS, LETTERED, NOISE, path, simulate
from experiments.report import Report, compare

pytestmark = pytest.mark.xdist_group("turn_gap")  # one process, so that its tests share what they compute

ZERO, OWN = COASTS
N10, N5 = "fit N10 p1, zero", "fit N5 p1, zero"
FITS = tuple(f"{name}, {mixing}" for mixing, names in turn_gap.MIXINGS.items() for name in names if "fit" in name)
LOW, HIGH = NOISE


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_bands(seed):
    results = {(r, gap): simulate(r, GAPS[gap], 500, seed) for r in NOISE for gap in LETTERED}

    def ratio(r, gap, a, b):
        return float(results[r, gap].ratio((a, "gap"), (b, "gap"), root=True).value)

    assert ratio(LOW, "C onset + 5", N5, ZERO) < 0.92
    for gap in ("A straight", "D turn", "E turn", "F exit", "H turn 2"):
        better = turn_gap.better_coast(results[LOW, gap])
        assert all(ratio(LOW, gap, fit, better) > 1 for fit in FITS), gap
    for coast in COASTS:
        assert all(ratio(LOW, "B onset", fit, coast) >= 0.98 for fit in FITS)
    for gap in ("D turn", "E turn"):
        assert ratio(HIGH, gap, OWN, ZERO) <= 0.65
    for (_, gap), result in results.items():  # the window of the prototype: 10 samples in A, else 5
        assert float(result.mean(N10 if gap == "A straight" else N5, "nees").value) >= 5, gap


@functools.cache
def small(r: float, gap: str) -> jf.MonteCarloResult:
    """Both coasts and one fit: a program for each mixing, which serves all gaps and both variances."""
    return simulate(r, GAPS[gap], 100, 1, (*COASTS, N5))


@functools.cache
def published() -> dict:
    everything = json.loads((ROOT / "lost_target" / "published.json").read_text(encoding="utf-8"))
    for name, table in everything["tables"].items():
        if name.startswith("g4-"):
            keep = [
                i
                for i, column in enumerate(table["header"])
                if column in ("R", "figures", *COASTS, N5) or "gap" in column
            ]
            table["header"] = [table["header"][i] for i in keep]
            table["rows"] = [[row[i] for i in keep] for row in table["rows"]]
    return everything


def deviations(results):
    """Of a re-run's tables from those parts of the published ones that have the same gaps."""
    tables = [turn_gap.table(results, r, part) for r in NOISE for part in ("gap", "after")]
    tables += [turn_gap.own_table(results), turn_gap.nees_table(results)]
    return [line for line in compare(published(), Report("lost_target", "", tables)) if "not in the re-run" not in line]


def test_published_tables_agree_with_a_small_run():
    """Another seed and 100 runs; the comparison fails when two gaps change places."""
    results = {(r, gap): small(r, gap) for r in NOISE for gap in ("A straight", "E turn")}
    assert deviations(results) == []
    swapped = {(r, gap): small(r, "E turn" if gap == "A straight" else "A straight") for r, gap in results}
    assert len(deviations(swapped)) > 10


def test_no_run_has_an_unexpected_status():
    for name, words in small(LOW, "E turn").status.items():
        pseudo = jf.Status.PSEUDO if "fit" in name else jf.Status(0)
        assert set(words.tolist()) == {int(jf.Status.MISSED | pseudo)}


@jax.jit
def positions(filt, ys, mask):
    return jax.vmap(lambda y: jf.filter(filt, y, mask=mask, outputs=turn_gap.reported))(ys)


def prototype_runs(r):
    """The measurements (400, T, 2) of the specification's prototype, by its random numbers."""
    noise = np.random.default_rng(0).standard_normal((turn_gap.T, 400, 2)).transpose(1, 0, 2)
    return path()[:, :2] + np.sqrt(r) * noise


@pytest.mark.parametrize("name", [pytest.param(ZERO, marks=pytest.mark.slow), OWN])
def test_with_the_prototypes_random_numbers_its_figures_come_out(name):
    """To its rounding: three decimals."""
    column = turn_gap.COLUMNS.index(name)
    found, expected = [], []
    for r in NOISE:
        for gap, texts in turn_gap.PROTOTYPE[r].items():
            if texts[column] != "-":
                first, last = GAPS[gap]
                mask = jf.simulate.gap_mask(turn_gap.T, GAPS[gap])
                out = positions(turn_gap.filters(r)[name], jnp.asarray(prototype_runs(r)), jnp.asarray(mask))
                squared = np.sum((np.asarray(out.position) - path()[:, :2]) ** 2, axis=-1)
                found.append(np.sqrt(squared[:, first : last + 1].mean()))
                expected.append(float(texts[column]))
    assert len(found) == 12
    np.testing.assert_allclose(found, expected, atol=0.0009)


def test_no_estimate_has_seen_a_lost_sample():
    """Whatever stands behind the mask, the estimates are the same to the last bit; without the mask they are not."""
    ys, mask = prototype_runs(LOW), jf.simulate.gap_mask(turn_gap.T, GAPS["E turn"])
    garbage = np.where(mask[:, None], ys, 1e3)
    filt = turn_gap.filters(LOW)[OWN]
    runs = [np.asarray(positions(filt, jnp.asarray(y), jnp.asarray(mask)).position) for y in (ys, garbage)]
    np.testing.assert_array_equal(*runs)
    assert (np.asarray(positions(filt, jnp.asarray(garbage), jnp.ones(turn_gap.T, bool)).position) != runs[0]).any()


def test_the_scores_are_those_of_the_run_alone():
    """One run of the batch, filtered by itself, scored in NumPy."""
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(1), 5), 0)
    first, last = GAPS["E turn"]
    ys = turn_gap.draw(jnp.asarray(path()), key, r=jnp.asarray(HIGH)).ys
    mask = jf.simulate.gap_mask(turn_gap.T, (first, last))
    out = positions(turn_gap.filters(HIGH)[OWN], jnp.tile(ys, (400, 1, 1)), jnp.asarray(mask))
    error = np.asarray(out.position)[0] - path()[:, :2]
    squared = np.sum(error**2, axis=1)
    scores = {name: values[5] for name, values in small(HIGH, "E turn").scores[OWN].items()}
    np.testing.assert_allclose(scores["gap"], squared[first : last + 1].mean(), rtol=1e-9)
    np.testing.assert_allclose(scores["after"], squared[last + 1 : last + 11].mean(), rtol=1e-9)
    nees = error[last] @ np.linalg.solve(np.asarray(out.cov)[0, last], error[last]) / 2
    np.testing.assert_allclose(scores["nees"], nees, rtol=1e-9)


def test_each_gap_has_the_same_runs():
    """Before any of the gaps the estimates are the same: strategies and gaps are compared on common noise."""
    a, b = (small(LOW, gap).scores[OWN]["course"][:, :25] for gap in ("A straight", "E turn"))
    np.testing.assert_array_equal(a, b)
