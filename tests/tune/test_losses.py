from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt import core, tune

F = np.array([[1.0, 0.7], [-0.1, 0.9]])
H = np.array([[1.0, 0.2], [0.0, 1.5]])
Q = np.array([[0.3, 0.1], [0.1, 0.4]])
R = np.array([[1.0, 0.3], [0.3, 2.0]])
M0 = np.array([0.5, -1.0])
P0 = np.array([[2.0, 0.3], [0.3, 1.0]])
B, T = 5, 14
KEY = jax.random.key(4)


def make(scale=1.0):
    F_, H_, R_, m0, P0_ = (jnp.asarray(x) for x in (F, H, R, M0, P0))
    return jf.kalman(jf.models.linear_gaussian(F_, H_, jnp.asarray(Q) * scale, R_, m0, P0_))


def candidates(loss, scales):
    return jax.jit(jax.vmap(lambda scale: loss(make(scale))))(jnp.array(scales))


def simulate(seed, runs, steps):
    rng = np.random.default_rng(seed)
    x = M0 + rng.normal(size=(runs, 2)) @ np.linalg.cholesky(P0).T
    xs, ys = [], []
    for _ in range(steps):
        x = x @ F.T + rng.normal(size=(runs, 2)) @ np.linalg.cholesky(Q).T
        xs.append(x)
        ys.append(x @ H.T + rng.normal(size=(runs, 2)) @ np.linalg.cholesky(R).T)
    return jnp.asarray(np.stack(xs, axis=1)), jnp.asarray(np.stack(ys, axis=1))


TRUTH, YS = simulate(0, B, T)


def random_mask(shape):
    mask = jax.random.bernoulli(jax.random.key(9), 0.6, shape)
    return mask.at[..., 3, :].set(False)


def test_innovation_nll_is_the_mean_over_samples_of_the_gaussian_form():
    out = jax.vmap(lambda y: jf.filter(make(), y))(YS)
    log_det = jnp.linalg.slogdet(out.innovation_cov)[1]
    expected = 0.5 * (out.nis + log_det + 2 * np.log(2 * np.pi))
    np.testing.assert_allclose(tune.innovation_nll(make(), YS), expected.mean(), rtol=1e-12)
    np.testing.assert_allclose(tune.innovation_nll(make(), YS, warmup=4), expected[:, 4:].mean(), rtol=1e-12)


@pytest.mark.parametrize("shape", [(T,), (T, 2), (B, T, 2)])
def test_masks_may_be_shared_or_one_per_run(shape):
    mask = random_mask((*shape, 2))[..., 0] if shape == (T,) else random_mask(shape)
    full = jnp.broadcast_to(mask[:, None] if mask.ndim == 1 else mask, YS.shape)
    total, count = 0.0, 0
    for y, m in zip(YS, full, strict=True):
        total -= jf.filter(make(), y, mask=m).log_lik.sum()
        count += int(m.any(axis=-1).sum())
    np.testing.assert_allclose(tune.innovation_nll(make(), YS, mask=mask), total / count, rtol=1e-12)
    innovations = jax.vmap(lambda y, m: jf.filter(make(), y, mask=m).innovation)(YS, full)
    expected = (innovations**2).sum() / count
    np.testing.assert_allclose(tune.prediction_mse(make(), YS, mask=mask), expected, rtol=1e-12)


def test_a_shared_mask_keeps_the_covariances_shared():
    shared = random_mask((T, 2))
    per_run = jnp.broadcast_to(shared, YS.shape)

    def largest(mask):
        jaxpr = jax.make_jaxpr(lambda ys: tune.innovation_nll(make(), ys, mask=mask))(YS)
        return str(jaxpr).count(f"f64[{B},2,2]")

    assert largest(shared) == 0 < largest(per_run)


def test_options_reach_the_filter():
    m0, P0 = jnp.array([0.0, 10.0]), jnp.diag(jnp.array([100.0, 25.0]))
    filt = jf.kalman(jf.models.constant_velocity(dt=1.0, q=0.1, r=4.0, m0=m0, P0=P0))
    ys, dt = YS[..., :1], 0.5 + jax.random.uniform(KEY, (B, T))
    for given in (dt, dt[0]):
        per_run = jnp.broadcast_to(given.reshape(-1, T), (B, T))
        out = [jf.filter(filt, y, dt=d, first_update_only=True).log_lik for y, d in zip(ys, per_run, strict=True)]
        actual = tune.innovation_nll(filt, ys, dt=given, first_update_only=True)
        np.testing.assert_allclose(actual, -np.mean(out), rtol=1e-12)


def test_rmse_over_components_and_windows():
    error = np.asarray(jax.vmap(lambda y: jf.filter(make(), y).mean)(YS) - TRUTH)
    expected = np.sqrt((error**2).sum(axis=-1).mean())
    np.testing.assert_allclose(tune.rmse(make(), YS, TRUTH), expected, rtol=1e-12)
    expected = np.sqrt((error[:, 5:9, 1] ** 2).mean())
    by_slice = tune.rmse(make(), YS, TRUTH, components=[1], window=slice(5, 9))
    by_weights = tune.rmse(make(), YS, TRUTH, components=slice(1, 2), window=(jnp.arange(T) >= 5) & (jnp.arange(T) < 9))
    np.testing.assert_allclose([by_slice, by_weights], expected, rtol=1e-12)
    np.testing.assert_allclose(
        tune.rmse(make(), YS, TRUTH[..., :1], components=(0,)), np.sqrt((error[..., 0] ** 2).mean()), rtol=1e-12
    )
    window = jax.random.bernoulli(KEY, 0.5, (B, T))
    expected = np.sqrt((error**2).sum(axis=-1)[np.asarray(window)].mean())
    np.testing.assert_allclose(tune.rmse(make(), YS, TRUTH, window=window), expected, rtol=1e-12)


def test_consistency_is_near_zero_for_the_true_model_and_not_for_a_wrong_one():
    truth, ys = simulate(1, 400, T)
    out = jax.vmap(lambda y: jf.filter(make(), y))(ys)
    error = np.asarray(out.mean - truth)
    nees = np.einsum("bti,btij,btj->bt", error, np.linalg.inv(out.cov), error)
    expected = abs(np.log(nees.mean() / 2))
    np.testing.assert_allclose(tune.consistency(make(), ys, truth), expected, rtol=1e-8)
    assert expected < 0.05
    coasting = {"mask": jnp.arange(T) < 6, "window": slice(6, None)}  # where the process noise matters
    wrong = candidates(lambda filt: tune.consistency(filt, ys, truth, **coasting), [0.1, 1.0, 10.0])
    assert wrong[0] > 0.3
    assert wrong[1] < 0.1
    assert wrong[2] > 0.3
    one = np.abs(np.log((error[..., 1] ** 2 / np.asarray(out.cov[..., 1, 1]))[:, 3:].mean()))
    actual = tune.consistency(make(), ys, truth, components=(1,), window=slice(3, None))
    np.testing.assert_allclose(actual, one, rtol=1e-8)


def hidden_scores(y, gap, real):
    """Predictive log densities at horizons 1, 2, ... from the last posterior before the gap, by hand."""
    start = int(np.argmax(gap))
    length = int(gap.sum())
    out = jf.filter(make(), y, mask=jnp.asarray(real & (np.arange(T) < start)[:, None]))
    m, P = np.asarray(out.mean[start - 1]), np.asarray(out.cov[start - 1])
    scores = []
    for k in range(start, start + length + 1):
        m, P = F @ m, F @ P @ F.T + Q
        rows = real[k]
        if rows.any():
            nu, S = (np.asarray(y[k]) - H @ m)[rows], (H @ P @ H.T + R)[np.ix_(rows, rows)]
            quadratic = nu @ np.linalg.solve(S, nu)
            scores.append(-0.5 * (quadratic + np.linalg.slogdet(S)[1] + rows.sum() * np.log(2 * np.pi)))
    return scores


@pytest.mark.parametrize("masked", [False, True])
def test_masked_nll_scores_hidden_samples_by_the_prediction_from_before_the_gap(masked):
    mask = np.asarray(random_mask(YS.shape)) if masked else np.ones(YS.shape, bool)
    given = jnp.asarray(mask) if masked else None
    scores = []
    for i in range(B):
        key = jax.random.fold_in(jax.random.fold_in(KEY, i), 0)
        gap = np.asarray(tune.random_gap(key, T, length=(2, 6)))
        scores += hidden_scores(YS[i], gap, mask[i])
    actual = tune.masked_nll(make(), YS, KEY, length=(2, 6), mask=given)
    np.testing.assert_allclose(actual, -np.mean(scores), rtol=1e-11)
    as_nan = jnp.where(jnp.asarray(mask), YS, jnp.nan)
    np.testing.assert_array_equal(tune.masked_nll(make(), as_nan, KEY, length=(2, 6), mask=given), actual)


def test_masked_nll_prefers_the_true_process_noise():
    _, ys = simulate(2, 300, T)
    losses = candidates(lambda filt: tune.masked_nll(filt, ys, KEY, length=(3, 6)), [0.3, 1.0, 3.0])
    assert losses[1] < min(losses[0], losses[2])


def test_random_gaps_have_every_length_and_start_that_was_asked_for():
    keys = jax.random.split(KEY, 2000)
    gaps = np.asarray(jax.vmap(lambda k: tune.random_gap(k, 8, length=(2, 4), warmup=2))(keys))
    starts, lengths = gaps.argmax(axis=1), gaps.sum(axis=1)
    assert set(lengths) == {2, 3, 4}
    assert not gaps[:, -1].any()
    for n in (2, 3, 4):
        assert set(starts[lengths == n]) == set(range(2, 8 - n))
    assert (np.abs(np.diff(gaps.astype(int), axis=1)).sum(axis=1) == 2).all()


class _Inner(NamedTuple):
    inner: jf.Filter


def _hold_update(p, s, inp):
    """Fills a missing sample with the last real one, as strategies for lost measurements do."""
    missing = ~inp.mask.any()
    y = jnp.where(missing, s.memory, inp.y)
    inner, info = p.inner.update(s.inner, inp._replace(y=y, mask=inp.mask | missing))
    return core.Wrapped(inner, y), info


def _hold_init(p, inp):
    return core.Wrapped(p.inner.init(inp), jnp.zeros_like(inp.y))


def gap_of(i):
    gap = np.asarray(tune.random_gap(jax.random.fold_in(jax.random.fold_in(KEY, i), 0), T, length=(2, 6)))
    return int(gap.argmax()), int(gap.argmax() + gap.sum())


def log_density(nu, S):
    return -0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(S)[1] + len(nu) * np.log(2 * np.pi))


def test_masked_nll_lets_wrappers_fill_the_gap_and_scores_the_real_sample_by_what_they_report():
    filt = jf.wrap(_Inner(make()), init=_hold_init, update=_hold_update)
    scores = []
    for i in range(B):
        start, stop = gap_of(i)
        filled = YS[i].at[start:stop].set(YS[i, start - 1])
        out = jf.filter(make(), filled, outputs=jf.everything)
        for k in range(start, stop + 1):
            m, P = (out if k < stop else out.prediction)[:2]
            scores.append(log_density(YS[i, k] - H @ m[k], H @ P[k] @ H.T + R))
    np.testing.assert_allclose(tune.masked_nll(filt, YS, KEY, length=(2, 6)), -np.mean(scores), rtol=1e-11)


def _report_update(p, s, inp):
    """Coasts, but reports a measurement of its own."""
    inner, info = p.inner.update(s.inner, inp)
    return core.Wrapped(inner), info._replace(extra={"reported": jnp.full_like(inp.y, 0.7)})


def test_masked_nll_scores_a_reported_measurement_inside_the_gap_only():
    filt = jf.wrap(_Inner(make()), update=_report_update)
    scores = []
    for i in range(B):
        start, stop = gap_of(i)
        inside = (np.arange(T) >= start) & (np.arange(T) < stop)
        mask = jnp.asarray(np.broadcast_to(~inside[:, None], (T, 2)))
        m, P = jf.filter(make(), YS[i], mask=mask, outputs=jf.everything).prediction[:2]
        for k in range(start, stop + 1):
            guess = np.full(2, 0.7) if k < stop else H @ m[k]
            scores.append(log_density(np.asarray(YS[i, k]) - guess, H @ P[k] @ H.T + R))
    np.testing.assert_allclose(tune.masked_nll(filt, YS, KEY, length=(2, 6)), -np.mean(scores), rtol=1e-11)


def test_masked_nll_of_a_filter_without_with_moments_is_that_of_its_prediction():
    plain = tune.masked_nll(make(), YS, KEY, length=(2, 6))
    bare = make()._replace(with_moments=None)
    np.testing.assert_allclose(tune.masked_nll(bare, YS, KEY, length=(2, 6)), plain, rtol=1e-12)


def _refuse_all(p, s, inp):
    inner, dry = p.inner.update(s.inner, inp)
    _, info = p.inner.update(s.inner, inp._replace(mask=jnp.zeros(inp.y.shape, bool)))
    status = core.flag(core.present(inp).any(), jf.Status.GATED)
    # The state still takes the sample, so that only the score differs from the plain filter's.
    return core.Wrapped(inner), info._replace(innovation=dry.innovation, status=info.status | status)


def test_refused_samples_are_not_a_free_lunch():
    filt = jf.wrap(_Inner(make()), update=_refuse_all)
    mask = random_mask(YS.shape)
    plain = tune.masked_nll(make(), YS, KEY, length=(2, 6), mask=mask)
    np.testing.assert_allclose(tune.masked_nll(filt, YS, KEY, length=(2, 6), mask=mask), plain, rtol=1e-12)
    assert tune.innovation_nll(filt, YS) == np.inf


def test_an_unmasked_nan_is_left_out_of_the_mean():
    ys = YS.at[2, 5, 0].set(jnp.nan)
    out = jax.vmap(lambda y: jf.filter(make(), y))(ys)
    keep = np.ones((B, T), bool)
    keep[2, 5] = False
    np.testing.assert_allclose(tune.innovation_nll(make(), ys), -np.asarray(out.log_lik)[keep].mean(), rtol=1e-12)
    assert np.isfinite(tune.masked_nll(make(), ys, KEY, length=(2, 6)))


def test_nothing_to_score_is_infinite_not_nan():
    nothing = jnp.zeros((T,), bool)
    assert tune.innovation_nll(make(), YS, mask=nothing) == np.inf
    assert tune.prediction_mse(make(), YS, mask=nothing) == np.inf
    assert tune.rmse(make(), YS, TRUTH, window=nothing) == np.inf
    assert tune.masked_nll(make(), YS, KEY, length=(2, 3), mask=nothing) == np.inf


LOSSES = {
    "innovation_nll": lambda s: tune.innovation_nll(make(s), YS, mask=random_mask(YS.shape)),
    "prediction_mse": lambda s: tune.prediction_mse(make(s), YS),
    "rmse": lambda s: tune.rmse(make(s), YS, TRUTH),
    "consistency": lambda s: tune.consistency(make(s), YS, TRUTH),
    "masked_nll": lambda s: tune.masked_nll(make(s), YS, KEY, length=(2, 6)),
}


@pytest.mark.parametrize("name", LOSSES)
def test_gradients_agree_with_central_differences(name):
    h = 1e-5
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(LOSSES[name])))(0.3 + jnp.array([-h, 0.0, h]))
    np.testing.assert_allclose(slopes[1], (values[2] - values[0]) / (2 * h), rtol=1e-6)


def test_vmap_over_candidates_equals_a_loop():
    scales = jnp.array([0.3, 1.0, 2.0])
    loss = jax.jit(LOSSES["masked_nll"])
    np.testing.assert_allclose(jax.vmap(loss)(scales), jnp.stack([loss(s) for s in scales]), rtol=1e-11)


def test_bad_arguments_are_named():
    cases = {
        "ys": lambda: tune.innovation_nll(make(), YS[0]),
        "mask": lambda: tune.innovation_nll(make(), YS, mask=jnp.ones((B, T), bool)),
        "components": lambda: tune.rmse(make(), YS, TRUTH, components=(2,)),
        "window": lambda: tune.rmse(make(), YS, TRUTH, window=jnp.ones(T + 1, bool)),
        "length": lambda: tune.masked_nll(make(), YS, KEY, length=(3, 2)),
        "warmup": lambda: tune.masked_nll(make(), YS, KEY, length=(2, T)),
    }
    for name, call in cases.items():
        with pytest.raises(ValueError, match=f"^{name}: "):
            call()
    with pytest.raises(TypeError, match=r"^window: "):
        tune.rmse(make(), YS, TRUTH, window=jnp.ones(T))


def _without_moments(p, s, inp):
    s, info = p.inner.update(s.inner, inp)
    nothing = {"cov": None, "innovation_cov": None, "nis": None, "log_lik": None}
    return core.Wrapped(s), info._replace(**nothing)


def test_filters_without_what_a_loss_needs_are_refused():
    filt = jf.wrap(_Inner(make()), update=_without_moments)
    for call in (
        lambda: tune.innovation_nll(filt, YS),
        lambda: tune.consistency(filt, YS, TRUTH),
        lambda: tune.masked_nll(filt, YS, KEY, length=(2, 3)),
    ):
        with pytest.raises(ValueError, match=r"^filt: "):
            call()
    assert np.isfinite(tune.prediction_mse(filt, YS))
