"""The interacting multiple model estimator: exact limits, a naive reference, what it survives, its gradients."""

from __future__ import annotations

import itertools
import typing

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt.core import Wrapped
from tests.reference import random_model

PI = np.array([[0.9, 0.1], [0.2, 0.8]])
MU0 = np.array([0.7, 0.3])
T = 15
both = pytest.mark.parametrize("mixing", ["own", "zero"])


def models(sizes, m=2, seed=0):
    """Random (F, H, Q, R, m0, P0), one per size."""
    rng = np.random.default_rng(seed)
    return [random_model(rng, n, m) for n in sizes]


def single(p, dtype=jnp.float64):
    return jf.kalman(jf.models.linear_gaussian(*(jnp.asarray(x, dtype) for x in p)))


def build(params, transition, *, dtype=jnp.float64, **options):
    if "mu0" in options:
        options["mu0"] = jnp.asarray(options["mu0"], dtype)
    return jf.imm([single(p, dtype) for p in params], jnp.asarray(transition, dtype), **options)


def data(m=2, seed=1, dtype=jnp.float64):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(T, m)).cumsum(axis=0), dtype)


def kalman_step(p, mean, cov, y) -> tuple[typing.Any, ...]:
    F, H, Q, R = p[:4]
    mean, cov = F @ mean, F @ cov @ F.T + Q
    if y is None:
        return mean, cov, mean, cov, 0.0
    S, nu = H @ cov @ H.T + R, y - H @ mean
    K = cov @ H.T @ np.linalg.inv(S)
    log_lik = -0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(2 * np.pi * S)[1])
    return mean, cov, mean + K @ nu, cov - K @ S @ K.T, log_lik


def reference(params, Pi, mu, index, mixing, ys, missed=()) -> typing.Any:
    """Textbook IMM, component by component, in the probability domain: means, covs, mu, log-likelihoods, S."""
    r, N = len(params), 1 + max(max(i) for i in index)
    x, P = [p[4] for p in params], [p[5] for p in params]
    mu = np.array(mu)
    out = []
    for k, y in enumerate(np.asarray(ys)):
        c = Pi.T @ mu
        starts = []
        for j in range(r):
            n = len(index[j])
            seen = []  # what model j is told of each model: mean, covariance, and whether it has each component
            for i in range(r):
                xi, Pi_, has = np.zeros(n), np.zeros((n, n)), np.zeros(n, bool)
                for a, b in itertools.product(range(n), range(n)):
                    in_a, in_b = index[j][a] in index[i], index[j][b] in index[i]
                    if in_a:
                        has[a] = True
                        xi[a] = x[i][index[i].index(index[j][a])]
                    elif mixing == "own":
                        xi[a] = x[j][a]
                    if in_a and in_b:
                        Pi_[a, b] = P[i][index[i].index(index[j][a]), index[i].index(index[j][b])]
                    elif not in_a and not in_b and mixing == "own":
                        Pi_[a, b] = P[j][a, b]
                seen.append((Pi[i, j] * mu[i] / c[j], xi, Pi_, has))
            m0 = sum(w * xi for w, xi, _, _ in seen)
            P0 = np.zeros((n, n))
            for w, xi, Pi_, has in seen:
                d = xi - m0 if mixing == "own" else np.where(has, xi - m0, 0)
                P0 = P0 + w * (Pi_ + np.outer(d, d))
            starts.append((m0, P0))
        steps = [kalman_step(p, m, C, None if k in missed else y) for p, (m, C) in zip(params, starts, strict=True)]
        likelihood = np.exp([s[4] for s in steps])
        mu = c * likelihood / (c @ likelihood)
        x, P = [s[2] for s in steps], [s[3] for s in steps]
        lifts = [np.eye(N)[:, list(i)] for i in index]

        def mixture(weights, means, covs):
            mean = sum(w * v for w, v in zip(weights, means, strict=True))
            parts = zip(weights, means, covs, strict=True)
            return mean, sum(w * (C + np.outer(v - mean, v - mean)) for w, v, C in parts)

        mean, cov = mixture(mu, [L @ v for L, v in zip(lifts, x, strict=True)],
                            [L @ C @ L.T for L, C in zip(lifts, P, strict=True)])  # fmt: skip
        Hs = [p[1] for p in params]
        yhat, S = mixture(c, [H @ s[0] for H, s in zip(Hs, steps, strict=True)],
                          [H @ s[1] @ H.T + p[3] for H, s, p in zip(Hs, steps, params, strict=True)])  # fmt: skip
        out.append((mean, cov, mu, 0.0 if k in missed else np.log(c @ likelihood), y - yhat, S))
    return [np.array(column) for column in zip(*out, strict=True)]


CASES = {
    "nested": ((2, 3), None, ((0, 1), (0, 1, 2))),
    "permuted": ((3, 2), ((2, 0, 1), (1, 3)), ((2, 0, 1), (1, 3))),
    "three": ((2, 3, 3), ((0, 1), (0, 1, 2), (1, 0, 3)), ((0, 1), (0, 1, 2), (1, 0, 3))),
}


@both
@pytest.mark.parametrize("case", CASES)
def test_equals_the_textbook(case, mixing):
    sizes, index, full = CASES[case]
    r = len(sizes)
    Pi = np.array([[0.8, 0.15, 0.05], [0.1, 0.7, 0.2], [0.3, 0.0, 0.7]])[:r, :r]
    Pi = Pi / Pi.sum(axis=1, keepdims=True)
    mu0 = np.array([0.5, 0.2, 0.3])[:r] / np.sum([0.5, 0.2, 0.3][:r])
    params, ys = models(sizes), data()
    mask = np.ones((T, 2), bool)
    mask[[4, 9]] = False
    out = jf.filter(build(params, Pi, mu0=mu0, index=index, mixing=mixing), ys, mask=mask)
    mean, cov, mu, log_lik, nu, S = reference(params, Pi, mu0, full, mixing, ys, missed=(4, 9))
    here = mask[:, 0]
    nis = np.array([v @ np.linalg.solve(C, v) for v, C in zip(nu, S, strict=True)])
    for got, want in (
        (out.mean, mean),
        (out.cov, cov),
        (out.extra["mode_probabilities"], mu),
        (out.log_lik, log_lik),
        (out.innovation[here], nu[here]),
        (out.innovation_cov[here], S[here]),
        (out.nis[here], nis[here]),
    ):
        np.testing.assert_allclose(got, want, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("dtype", "tol"), [(jnp.float32, 1e-6), (jnp.float64, 1e-10)], ids=["f32", "f64"])
def test_identical_models_are_one_filter(dtype, tol):
    params, ys = models([3]) * 2, data(dtype=dtype)
    out = jf.filter(build(params, PI, mu0=MU0, dtype=dtype), ys)
    one = jf.filter(single(params[0], dtype), ys)
    for name in ("mean", "cov", "innovation", "innovation_cov", "noise_cov", "nis", "log_lik"):
        got, want = np.asarray(getattr(out, name)), np.asarray(getattr(one, name))
        np.testing.assert_allclose(got, want, rtol=0, atol=tol * np.abs(want).max(), err_msg=name)
    np.testing.assert_allclose(out.extra["mode_probabilities"][0], MU0 @ PI, rtol=1e-6)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
@pytest.mark.parametrize("j", [0, 1])
def test_a_mode_that_is_never_left_is_its_filter(j, dtype):
    """Also where the other models fit far better: what is impossible stays so, whatever the data say."""
    params = models([3, 3])
    loud = [(*p[:3], p[3] * 1e4, *p[4:]) for p in params]
    ys = 300 * data(dtype=dtype)  # log-likelihood ratios of 1e4 and more against mode j
    params = [params[i] if i == j else loud[i] for i in range(2)]
    out = jf.filter(build(params, np.eye(2), mu0=np.eye(2)[j], dtype=dtype), ys)
    one = jf.filter(single(params[j], dtype), ys)
    tol = 1e-6 if dtype == jnp.float32 else 1e-10
    for got, want in ((out.mean, one.mean), (out.log_lik, one.log_lik)):
        np.testing.assert_allclose(got, want, rtol=0, atol=tol * np.abs(want).max())
    assert (np.asarray(out.extra["mode_probabilities"]) == np.eye(2)[j]).all()


def test_square_root_filters_give_the_same():
    """Moments go in and out of any filter: of the factors here."""
    params, ys = models([2, 3]), data()
    sqrt = [jf.sqrt_kalman(jf.models.linear_gaussian(*p)) for p in params]
    out, same = jf.filter(jf.imm(sqrt, PI, mu0=MU0), ys), jf.filter(build(params, PI, mu0=MU0), ys)
    for a, b in zip(jax.tree.leaves(out), jax.tree.leaves(same), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10)


def test_mixing_zero_is_own_where_components_agree():
    params, ys = models([3, 3]), data()
    runs = [jf.filter(build(params, PI, mu0=MU0, mixing=mixing), ys) for mixing in ("own", "zero")]
    for a, b in zip(*map(jax.tree.leaves, runs), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)


def test_missed_sample_predicts_the_probabilities():
    params, ys = models([2, 3]), data()
    mask = np.arange(T) % 3 != 1
    mu = np.asarray(jf.filter(build(params, PI, mu0=MU0), ys, mask=mask).extra["mode_probabilities"])
    for k in np.flatnonzero(~mask):
        np.testing.assert_allclose(mu[k], mu[k - 1] @ PI, rtol=1e-12)
    out = jf.filter(build(params, PI, mu0=MU0, missed="freeze"), ys, mask=mask, outputs=jf.everything)
    mu = np.asarray(out.extra["mode_probabilities"])
    for k in np.flatnonzero(~mask):
        np.testing.assert_allclose(mu[k], mu[k - 1], rtol=1e-12)


def test_frozen_models_do_not_mix():
    """In a gap each filter coasts from where it stood: the mixture of two filters that are run apart."""
    params, ys = models([2, 3]), data()
    mask = np.zeros(T, bool)
    mu0 = np.array([0.25, 0.75])
    out = jf.filter(build(params, PI, mu0=mu0, missed="freeze"), ys, mask=mask)
    alone = [jf.filter(single(p), ys, mask=mask).mean for p in params]
    np.testing.assert_allclose(out.mean[:, :2], 0.25 * alone[0] + 0.75 * alone[1][:, :2], rtol=1e-12)


def test_is_exact_for_one_step_and_close_to_all_mode_sequences_after():
    """The first step is exact; afterwards one Gaussian stands for many, so the enumeration is only near."""
    (a, b), ys = models([3, 3]), data()[:3]
    b = (*a[:3], 3 * a[3], *a[4:])
    Pi = np.tile([0.3, 0.7], (2, 1))
    out = jf.filter(build([a, b], Pi, mu0=MU0), ys)
    means, log_weights = [], []
    for sequence in itertools.product(range(2), repeat=3):
        mean, cov, total, trace = a[4], a[5], 0.0, []
        for k, mode in enumerate(sequence):
            _, _, mean, cov, log_lik = kalman_step((a, b)[mode], mean, cov, np.asarray(ys[k]))
            total += log_lik + np.log(Pi[0, mode])
            trace.append((mean, total))
        means.append([m for m, _ in trace])
        log_weights.append([w for _, w in trace])
    weights = np.exp(log_weights)  # (8, 3): of the sequence up to k, each counted 2^(2-k) times
    exact = np.einsum("sk,skn->kn", weights, means) / weights.sum(axis=0)[:, None]
    evidence = np.log(weights.sum(axis=0) / [4, 2, 1])
    np.testing.assert_allclose(out.mean[0], exact[0], rtol=1e-10)
    np.testing.assert_allclose(out.log_lik[0], evidence[0], rtol=1e-10)
    np.testing.assert_allclose(np.cumsum(out.log_lik), evidence, rtol=0.02)  # afterwards one Gaussian stands for many
    np.testing.assert_allclose(out.mean, exact, rtol=0, atol=0.05 * np.abs(exact).max())


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
def test_underflowing_likelihoods(dtype):
    """One model's, all models', and all beyond the range of numbers."""
    rng = np.random.default_rng(0)
    a, b = random_model(rng, 2, 2, scale=1e-8), random_model(rng, 3, 2, scale=1e-6)
    filt = build([a, b], PI, mu0=MU0, dtype=dtype)
    ys = 1e-4 * data(dtype=dtype)
    for k, value in ((3, 1.0), (6, 1e3), (9, 1e-2 * float(jnp.finfo(dtype).max) ** 0.5)):
        ys = ys.at[k].set(value)

    def early(y):
        out = jf.filter(filt, y)
        return out.mean[:8].sum(), out

    (_, out), gradient = jax.jit(jax.value_and_grad(early, has_aux=True))(ys)
    assert np.isfinite(gradient).all()
    mu = np.asarray(out.extra["mode_probabilities"])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((out.mean, out.cov, out.log_lik, mu)))
    # Probabilities are kept as logarithms: what they sum to is off by eps times nats, of which there are many here.
    np.testing.assert_allclose(mu.sum(axis=1), 1, rtol=5e-6 if dtype == jnp.float32 else 1e-6)
    assert mu[3, 0] == 0
    np.testing.assert_allclose(mu[9], mu[8] @ PI, rtol=1e-5)
    bad = (np.asarray(out.status) & int(jf.Status.NONFINITE)) != 0
    assert bad[9]
    assert bad.sum() == 1


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
def test_long_runs_with_a_dead_mode(dtype):
    """1e4 steps in which a mode's probability goes to 0 for good: all finite, probabilities sum to 1, gradients too."""
    (a,) = models([2])
    steps = 10_000
    ys = jnp.asarray(np.random.default_rng(0).normal(size=(steps, 2)), dtype)
    transition = jnp.asarray(np.eye(2), dtype)

    def run(scale):
        motion = [jnp.asarray(x, dtype) for x in a]
        wrong = [*motion[:3], scale * motion[3], *motion[4:]]
        out = jf.filter(jf.imm([single(p, dtype) for p in (motion, wrong)], transition), ys)
        return out.log_lik.mean(), out

    (_, out), gradient = jax.jit(jax.value_and_grad(run, has_aux=True))(jnp.asarray(1e4, dtype))
    mu = np.asarray(out.extra["mode_probabilities"])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((out, gradient)))
    np.testing.assert_allclose(mu.sum(axis=1), 1, rtol=1e-6)
    assert mu[-1, 1] == 0
    assert (out.status == 0).all()


STENCIL = np.array([0.0, 1.0, -1.0, 2.0, -2.0])


def difference(at, h):
    """The derivative from values at h STENCIL, of fourth order."""
    return (8 * (at[1] - at[2]) - (at[3] - at[4])) / (12 * h)


def motion(q, axes=1):
    """CV and CA along the first axis."""
    m0, P0 = np.eye(3)[1].repeat(axes) * (np.arange(3 * axes) == axes), np.diag(np.repeat([0.1, 0.1, 1.0], axes))
    cv = jf.models.constant_velocity(dt=0.1, q=q[0], r=0.05, m0=m0[: 2 * axes], P0=P0[: 2 * axes, : 2 * axes])
    return cv, jf.models.constant_acceleration(dt=0.1, q=q[1], r=0.05, m0=m0, P0=P0)


def arc(steps=60, seed=0, dtype=jnp.float64):
    """A straight leg, then a turn at 1 rad/s; positions (T, 2), and measurements with r = 0.05."""
    angle = np.cumsum(0.1 * (np.arange(steps) >= steps // 2))
    path = 0.1 * np.cumsum(np.stack([np.cos(angle), np.sin(angle)], axis=1), axis=0)
    noise = np.sqrt(0.05) * np.random.default_rng(seed).normal(size=(steps, 2))
    return path, jnp.asarray(path + noise, dtype)


def test_gradients_of_transition_and_noise():
    _, ys = arc(30)

    def nll(v):
        rows = jnp.stack([jax.nn.softmax(jnp.stack([v[0], jnp.zeros_like(v[0])])), jnp.stack([v[1], v[2]])])
        cv, ca = motion(jnp.exp(v[3:5]))
        filt = jf.imm((jf.kalman(cv), jf.kalman(ca)), rows, mu0=jnp.stack([v[5], 1 - v[5]]))
        return -jf.filter(filt, ys[:, 1:]).log_lik.sum()

    v, h = jnp.array([2.0, 0.1, 0.9, -4.0, -1.0, 0.6]), 1e-5
    gradient = jax.jit(jax.grad(nll))(v)
    points = v[None, None, :] + h * STENCIL[:, None, None] * np.eye(6)[None]
    numeric = difference(jax.jit(jax.vmap(nll))(points.reshape(-1, 6)).reshape(5, 6), h)
    np.testing.assert_allclose(gradient, numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max())
    assert (np.abs(gradient) > 1e-6).all()


def test_gradients_are_finite_with_impossible_transitions():
    _, ys = arc(30)
    cv, ca = motion((0.01, 0.3))
    filters = (jf.kalman(cv), jf.kalman(ca))

    def nll(transition, mu0):
        return -jf.filter(jf.imm(filters, transition, mu0=mu0), ys[:, 1:]).log_lik.sum()

    grad = jax.jit(jax.grad(nll, (0, 1)))
    for transition in (np.eye(2), np.array([[1.0, 0.0], [0.1, 0.9]]), np.array([[0.0, 1.0], [1.0, 0.0]])):
        for mu0 in (MU0, np.array([1.0, 0.0])):
            leaves = grad(jnp.asarray(transition), jnp.asarray(mu0))
            assert all(np.isfinite(leaf).all() for leaf in leaves)


TOGETHER = ((0, 1, 2, 3), (0, 1, 2, 3, 4, 5), (0, 1, 2, 3, 6))


def turning(v, mixing="own"):
    """CV, CA and CT together; v: log noises of the three and the logit of staying."""
    cv, ca = motion(jnp.exp(v[:2]), axes=2)
    m0, P0 = np.array([0.0, 0, 1, 0, 0]), np.diag([0.1, 0.1, 0.1, 0.1, 1.0])
    ct = jf.models.coordinated_turn(dt=0.1, q_omega=jnp.exp(v[2]), r=0.05, m0=m0, P0=P0)
    stay = jax.nn.sigmoid(v[3])
    transition = jnp.where(np.eye(3, dtype=bool), stay, (1 - stay) / 2)
    filters = (jf.kalman(cv), jf.kalman(ca), jf.extended(ct))
    return jf.imm(filters, transition, index=TOGETHER, mixing=mixing)


POINT = jnp.array([-4.0, -1.0, -2.0, 2.0])


def test_velocity_acceleration_and_turn_together():
    path, ys = arc()
    out = jf.filter(turning(POINT), ys, outputs=jf.everything)
    assert out.mean.shape == (60, 7)
    assert out.extra["mode_probabilities"].shape == (60, 3)
    assert out.mean[50:, 6].mean() > 0.2  # it has found the turn
    assert (out.status == 0).all()
    rmse = [float(np.sqrt(((m[:, :2] - path) ** 2).mean())) for m in (ys, out.mean, jf.rts(out).mean)]
    assert rmse[2] < 0.8 * rmse[1] < 0.8 * 0.8 * rmse[0]


def test_gradient_of_velocity_acceleration_and_turn_together():
    """In a direction that changes all noises and the transitions."""
    _, ys = arc()
    direction = jnp.array([1.0, -0.5, 0.7, 0.4])

    def nll(s):
        return -jf.filter(turning(POINT + s * direction), ys).log_lik.sum()

    h = 1e-5
    both_at = jax.jit(jax.vmap(lambda s: jax.jvp(nll, (s,), (jnp.ones(()),))))  # reverse mode compiles for long
    values, slopes = both_at(jnp.asarray(h * STENCIL))
    np.testing.assert_allclose(slopes[0], difference(values, h), rtol=1e-6)


def known_turns(omega):
    """Straight on, and turns at a known rate to the left and to the right."""
    m0, P0 = np.array([0.0, 0, 1, 0]), np.diag([0.1, 0.1, 0.1, 0.1])
    rates = (jnp.zeros_like(omega), omega, -omega)
    filters = [jf.kalman(jf.models.known_turn(dt=0.1, omega=w, q=0.01, r=0.05, m0=m0, P0=P0)) for w in rates]
    return jf.imm(filters, np.where(np.eye(3), 0.96, 0.02))


def test_turn_rates_are_tunable():
    """The likelihood's slope in the rate is right, at rate 0 too, and its minimum is near the rate of the data."""
    _, ys = arc(120)

    def nll(omega):
        return -jf.filter(known_turns(omega), ys).log_lik.sum()

    h = 1e-4
    near = (jnp.array([0.0, 0.5, 1.2])[:, None] + h * STENCIL[None, :]).ravel()
    rates = jnp.linspace(0.2, 2.0, 37)
    both_at = jax.jit(jax.vmap(lambda w: jax.jvp(nll, (w,), (jnp.ones(()),))))
    values, slopes = both_at(jnp.concatenate([near, rates]))
    for i in range(0, 15, 5):
        np.testing.assert_allclose(slopes[i], difference(values[i : i + 5], h), rtol=1e-6, atol=1e-6)
    assert abs(float(rates[jnp.argmin(values[15:])]) - 1.0) <= 0.15  # the data turn at 1 rad/s


def test_smoothing_reduces_the_error():
    """Of the mixture, over several runs; of equal models it is the smoother of their filter."""
    quiet, loud = (motion((q, 1.0), axes=2)[0] for q in (0.01, 1.0))
    pairs = [arc(seed=seed) for seed in range(20)]
    path, ys = pairs[0][0], jnp.stack([y for _, y in pairs])
    run = jax.jit(jax.vmap(_filter_and_smooth, (None, 0)))
    mean, smoothed = run(jf.imm((jf.kalman(quiet), jf.kalman(loud)), PI), ys)
    errors = [float(((m[:, :, :2] - path[None]) ** 2).mean()) for m in (mean, smoothed.mean)]
    assert errors[1] < 0.6 * errors[0]
    assert np.linalg.eigvalsh(smoothed.cov).min() > -1e-9

    _, mixed = run(jf.imm((jf.kalman(loud), jf.kalman(loud)), PI), ys)
    alone = jf.smooth(jf.kalman(loud), ys[0])
    np.testing.assert_allclose(mixed.mean[0], alone.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(mixed.cov[0], alone.cov, rtol=0, atol=1e-9)


def _filter_and_smooth(filt, y):
    out = jf.filter(filt, y, outputs=jf.everything)
    return out.mean, jf.rts(out)


def test_cross_covariance_is_the_mixtures():
    """Against draws of mode and state before and after a prediction, where the second model has a component more."""
    params = models([2, 3], seed=3)
    filt = build(params, PI, mu0=MU0)
    inp = jf.StepInput(jnp.zeros(2))
    state = jax.jit(filt.init)(inp)
    assert filt.moments is not None
    _, prior = jax.jit(filt.moments)(state)
    _, prediction = jax.jit(filt.predict)(state, inp)
    rng = np.random.default_rng(0)
    n = 200_000
    first = rng.random(n) > MU0[0]
    second = rng.random(n) > PI[first.astype(int), 0]
    small, large = (rng.multivariate_normal(p[4], p[5], n) for p in params)
    before = np.where(first[:, None], large, np.pad(small, ((0, 0), (0, 1))))
    # What the small model lacks, the large one takes from its own moments.
    own = rng.normal(params[1][4][2], np.sqrt(params[1][5][2, 2]), n)
    start = np.where((second & ~first)[:, None] & (np.arange(3) == 2), own[:, None], before)
    noise = [rng.multivariate_normal(np.zeros(len(p[4])), p[2], n) for p in params]
    after = np.where(
        second[:, None],
        start @ params[1][0].T + noise[1],
        np.pad(start[:, :2] @ params[0][0].T + noise[0], ((0, 0), (0, 1))),
    )
    joint = np.cov(np.concatenate([before, after], axis=1).T)
    size = np.abs(joint).max()
    np.testing.assert_allclose(prior, joint[:3, :3], rtol=0, atol=0.01 * size)
    np.testing.assert_allclose(prediction.cov, joint[3:, 3:], rtol=0, atol=0.01 * size)
    np.testing.assert_allclose(prediction.cross, joint[:3, 3:], rtol=0, atol=0.01 * size)


def test_bad_arguments_are_named():
    a, b, c = map(single, models([2, 3, 3]))
    two = (a, b)

    def refused(match, error: type[Exception] = ValueError, **changes: typing.Any):
        options = {"filters": two, "transition": PI, **changes}
        with pytest.raises(error, match=match):
            jf.imm(**options)

    refused(r"transition: expected rows of probabilities", transition=[[0.9, 0.2], [0.1, 0.9]])
    refused(r"transition: expected rows of probabilities", transition=[[1.1, -0.1], [0.1, 0.9]])
    refused(r"transition: expected rows of probabilities", transition=[[jnp.nan, 0.1], [0.1, 0.9]])
    refused(r"transition: expected shape \(2, 2\)", transition=np.eye(3))
    refused(r"transition: expected a float array", TypeError, transition=np.eye(2, dtype=int))
    refused(r"mu0: expected probabilities", mu0=[0.5, 0.6])
    refused(r"mu0: expected probabilities", mu0=[1.5, -0.5])
    refused(r"mu0: expected shape \(2,\)", mu0=[1.0])
    refused(r"index: expected positions for 2", index=((0, 1),))
    refused(r"index\[1\]: expected different positions", index=((0, 1), (0, 1, 1)))
    refused(r"index\[0\]: expected different positions", index=((0, -1), (0, 1, 2)))
    refused(r"index: no filter has the positions \[3\]", index=((0, 1), (0, 2, 4)))
    refused(r'mixing: expected "own" or "zero"', mixing="none")
    refused(r'missed: expected "mix" or "freeze"', missed="stop")
    refused("filters: expected a tuple", TypeError, filters=a)
    refused("filters: expected a tuple", TypeError, filters=())
    refused(r"filters\[1\]: has no with_moments", filters=(a, jf.imm((b, c), PI)))
    bare = a._replace(moments=None, with_moments=None)
    refused(r"filters\[0\]: has no moments and no with_moments", filters=(bare, b))
    ys = data()
    with pytest.raises(ValueError, match=r"index\[1\]: expected 3 positions"):
        jf.filter(jf.imm(two, PI, index=((0, 1), (0, 2))), ys)
    with pytest.raises(TypeError, match="transition: is float32, but the filters are float64"):
        jf.filter(jf.imm(two, PI.astype(np.float32)), ys)


def test_unclear_sizes_need_an_index():
    ys = data()
    for sizes, clear in (((4, 5), True), ((2, 3, 4), True), ((4, 6), True), ((5, 6), False), ((4, 5, 6), False)):
        filt = build(models(sizes), np.full((len(sizes),) * 2, 1 / len(sizes)))
        first = jf.StepInput(ys[0])
        if clear:
            filt.init(first)
        else:
            with pytest.raises(ValueError, match="index: it is not clear which components"):
                filt.init(first)


def test_a_filter_without_likelihood_is_refused():
    a, b = map(single, models([2, 2]))
    silent = jf.wrap(Wrapped(b), update=_silent)
    with pytest.raises(ValueError, match=r"filters\[1\]: reports no log_lik"):
        jf.filter(jf.imm((a, silent), PI), data())


def _silent(p, s, inp):
    inner, info = p.inner.update(s.inner, inp)
    return s._replace(inner=inner), info._replace(log_lik=None)


def test_plain_numbers_take_the_filters_type():
    ys = data(dtype=jnp.float32)
    filters = [single(p, jnp.float32) for p in models([2, 3])]
    out = jf.filter(jf.imm(filters, [[1, 0], [0.1, 0.9]], mu0=(0.5, 0.5)), ys)
    assert out.mean.dtype == out.extra["mode_probabilities"].dtype == jnp.float32


def _noisy_predict(p, s, inp):
    inner, prediction = p.inner.predict(s.inner, inp)
    draw = jax.random.normal(jax.random.fold_in(inp.key, 0), (), inp.y.dtype)
    return s._replace(inner=inner, memory=draw), prediction


def _noisy_init(p, inp):
    return Wrapped(p.inner.init(inp), jnp.zeros((), inp.y.dtype))


def test_filters_draw_apart():
    """Each filter has its own random key, and memories of wrappers outlive the mixing."""
    inner = single(models([2])[0])
    noisy = jf.wrap(Wrapped(inner), init=_noisy_init, predict=_noisy_predict)
    draws = jf.filter(jf.imm((noisy, noisy), PI), data(), key=jax.random.key(0), outputs=_memories)
    assert len(np.unique(np.stack(draws))) == 2 * T


def _memories(state, info):
    del info
    return [s.memory for s in state.states]
