"""Gradients through particle filters: the criterion of the specification, section 9, and the published table."""

from __future__ import annotations

import json

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.__main__ import ROOT
from experiments.particle_gradients import run as gradients
from experiments.particle_gradients.run import Case
from experiments.report import Report, compare

pytestmark = pytest.mark.xdist_group("particle_gradients")


def relative_bias(name, count, runs, seed):
    _, slope = gradients.exact(jnp.log(jnp.array(gradients.ASSUMED)), gradients.series())
    found = gradients.sample(Case(name, "multinomial", count), runs, seed).gradient[:, 1]
    return (found.mean() - float(slope[1])) / abs(float(slope[1]))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_score_is_consistent_and_naive_is_not(seed):
    assert abs(relative_bias("score", 2000, 48, seed)) <= 0.05
    assert abs(relative_bias("full score", 2000, 48, seed)) <= 0.05
    assert abs(relative_bias("naive", 2000, 48, seed)) > 0.2


def test_published_table_agrees_with_a_small_run():
    """Another seed, 100 particles; the criterion's two schemes."""
    cases = [Case(name, "multinomial", 100) for name in ("naive", "score")]
    published = json.loads((ROOT / "particle_gradients" / "published.json").read_text(encoding="utf-8"))
    table = published["tables"]["gradients"]
    table["rows"] = [row for row in table["rows"] if row[:3] in [list(map(str, case)) for case in cases]]
    for row in table["rows"]:
        row[3] = "100"  # the number of runs is part of the label
    samples = gradients.simulate(cases, 100, 1)
    assert compare(published, Report("particle_gradients", "", [gradients.table(samples)])) == []
    naive, score = (samples[case].gradient[:, 1].mean() for case in cases)
    assert naive != score


def test_the_exact_gradient_is_that_of_differences():
    theta, ys, h = jnp.log(jnp.array(gradients.ASSUMED)), gradients.series(), 1e-4
    _, slope = gradients.exact(theta, ys)
    for i in range(2):
        shift = h * jnp.eye(2)[i]
        up, down = (float(gradients.exact(theta + s, ys)[0]) for s in (shift, -shift))
        np.testing.assert_allclose(slope[i], (up - down) / (2 * h), rtol=1e-5)
