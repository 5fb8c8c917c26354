"""The bank: Bayes' rule over hypotheses, grouping, scores, what it refuses."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxfilt as jf
from tests.examples import GAP, LINEAR
from tests.registry import REGISTRY, params, series

MODELS = [jf.models.linear_gaussian(**{**LINEAR, "Q": s * LINEAR["Q"]}) for s in (0.5, 1.0, 3.0)]
YS = series(REGISTRY["bank"], jnp.float64)


def test_probabilities_are_bayes_rule_over_the_filters_likelihoods():
    prior = np.array([0.2, 0.5, 0.3])
    out = jf.filter(jf.bank([jf.kalman(m) for m in MODELS], prior=prior), YS, **GAP)
    single = [jf.filter(jf.kalman(m), YS, **GAP) for m in MODELS]
    log_joint = np.log(prior) + np.cumsum([np.asarray(o.log_lik) for o in single], axis=1).T
    evidence = np.logaddexp.reduce(log_joint, axis=1)
    np.testing.assert_allclose(out.extra["log_probabilities"], log_joint - evidence[:, None], rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.cumsum(out.log_lik), evidence, rtol=1e-10)
    p = np.exp(log_joint - evidence[:, None])
    means = np.stack([np.asarray(o.mean) for o in single])
    mean = np.einsum("tj,jti->ti", p, means)
    np.testing.assert_allclose(out.mean, mean, rtol=1e-10, atol=1e-12)
    apart = means - mean
    covs = np.stack([np.asarray(o.cov) for o in single]) + apart[..., :, None] * apart[..., None, :]
    np.testing.assert_allclose(out.cov, np.einsum("tj,jtab->tab", p, covs), rtol=1e-10, atol=1e-12)


def test_equal_hypotheses_keep_their_prior_and_a_bank_of_one_is_its_filter():
    filt = jf.kalman(MODELS[0])
    out = jf.filter(jf.bank([filt, filt], prior=(0.3, 0.7)), YS, **GAP)
    np.testing.assert_allclose(np.exp(out.extra["log_probabilities"]), [[0.3, 0.7]] * len(YS), rtol=1e-12)
    alone, one = jf.filter(filt, YS, **GAP), jf.filter(jf.bank([filt]), YS, **GAP)
    for name in ("mean", "cov", "log_lik", "nis", "innovation_cov"):
        np.testing.assert_allclose(getattr(one, name), getattr(alone, name), rtol=1e-10, atol=1e-12)


def test_a_mixed_bank_is_grouped_without_changing_the_order():
    """Filters 0 and 2 run as one batch, filter 1 by itself."""
    example = REGISTRY["bank"]
    out = jf.filter(example.make(params(example, jnp.float64)), YS, **GAP)
    for j, scale in ((0, 1.0), (1, 1.0), (2, 4.0)):
        model = jf.models.linear_gaussian(**{**LINEAR, "Q": scale * LINEAR["Q"]})
        alone = jf.filter(jf.kalman(model), YS, **GAP)
        np.testing.assert_allclose(out.extra["means"][:, j], alone.mean, rtol=1e-9, atol=1e-11)


def test_members_draw_their_own_random_numbers():
    filt = jf.particle(MODELS[0], 20)
    out = jf.filter(jf.bank([filt, filt]), YS, key=jax.random.key(0))
    assert (out.extra["means"][:, 0] != out.extra["means"][:, 1]).all()


def _score(weight, x, j):
    del x
    return weight * j.astype(weight.dtype)


def test_a_score_counts_in_steps_with_a_measurement_only():
    filt = jf.kalman(MODELS[0])
    score = Partial(_score, jnp.asarray(0.1))
    out = jf.filter(jf.bank([filt, filt], score=score), YS, **GAP)
    log_p = np.asarray(out.extra["log_probabilities"])
    seen = np.asarray(GAP["mask"]).any(axis=1)
    np.testing.assert_allclose(log_p[:, 1] - log_p[:, 0], np.multiply(0.1, np.cumsum(seen)), rtol=1e-10)


def test_the_smoother_of_a_bank_with_one_likely_hypothesis_is_that_filters():
    bank = jf.bank([jf.kalman(MODELS[0]), jf.kalman(MODELS[2])], prior=(1.0, 0.0))
    smoothed, alone = jf.smooth(bank, YS), jf.smooth(jf.kalman(MODELS[0]), YS)
    np.testing.assert_allclose(smoothed.mean, alone.mean, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(smoothed.cov, alone.cov, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize(
    ("filters", "options", "error", "match"),
    [
        ([], {}, TypeError, "one or more"),
        ([3], {}, TypeError, "Filter"),
        ([jf.kalman(MODELS[0])] * 2, {"prior": (0.5, 0.6)}, ValueError, "sum to 1"),
        ([jf.kalman(MODELS[0])] * 2, {"prior": (1.5, -0.5)}, ValueError, "prior"),
        ([jf.kalman(MODELS[0])] * 2, {"prior": (1.0,)}, ValueError, "shape"),
    ],
)
def test_refused(filters, options, error, match):
    with pytest.raises(error, match=match):
        jf.bank(filters, **options)
