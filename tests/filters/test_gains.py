"""The gain rules against Lyapunov and Riccati solutions, least squares and each other (float64 unless said)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from jaxfilt.filters import gains

DT = 0.7


def matrices(dt, *gain):
    """F (n, n) and K (n,) of one axis."""
    n = len(gain)
    F = np.array([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]])[:n, :n]
    return F, np.array([float(g) / dt**i for i, g in enumerate(gain)])


def closed_loop(dt, *gain):
    F, K = matrices(dt, *gain)
    return (np.eye(len(gain)) - np.outer(K, np.eye(len(gain))[0])) @ F


def lyapunov(dt, *gain):
    _, K = matrices(dt, *gain)
    return solve_discrete_lyapunov(closed_loop(dt, *gain), np.outer(K, K))


def riccati_gain(F, Q, r):
    H = np.eye(len(F))[:1]
    P = solve_discrete_are(F.T, H.T, Q, np.array([[r]]))
    return (P @ H.T / (H @ P @ H.T + r))[:, 0]


def random_stable(order, count=100, seed=0):
    rng = np.random.default_rng(seed)
    return [tuple(map(float, gains.from_unconstrained(*rng.normal(0, 1.5, order + 1)))) for _ in range(count)]


@pytest.mark.parametrize("order", [1, 2])
def test_steady_covariance_solves_the_lyapunov_equation(order):
    for gain in random_stable(order):
        expected = lyapunov(DT, *gain)
        got = np.asarray(gains.steady_covariance(*gain, dt=DT, r=1.0))
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(got / scale, expected / scale, rtol=0, atol=1e-10)
        np.testing.assert_allclose(gains.variance_reduction(*gain, dt=DT), np.diag(expected), rtol=1e-10)


def test_steady_covariance_scales_with_the_noise():
    C = gains.steady_covariance(0.5, 0.2, 0.05, dt=DT, r=1.0)
    np.testing.assert_allclose(gains.steady_covariance(0.5, 0.2, 0.05, dt=DT, r=9.0), 9 * C, rtol=1e-15)


def test_benedict_bordner_has_its_own_variance_formulas():
    for alpha in np.linspace(0.05, 1.1, 22):
        position, velocity = gains.variance_reduction(*gains.benedict_bordner(alpha), dt=DT)
        d = alpha**2 - 8 * alpha + 8
        np.testing.assert_allclose(position, alpha * (6 - 5 * alpha) / d, rtol=1e-10)
        np.testing.assert_allclose(velocity, 2 / DT**2 * alpha**3 / (2 - alpha) / d, rtol=1e-10)


def test_fading_memory_has_its_own_covariance_formulas():
    for xi in np.linspace(0, 0.97, 20):
        C = gains.steady_covariance(*gains.fading_memory(xi), dt=DT)
        ratio = (1 - xi) / (1 + xi) ** 3
        np.testing.assert_allclose(C[0, 0], ratio * (1 + 4 * xi + 5 * xi**2), rtol=1e-10)
        np.testing.assert_allclose(C[0, 1], ratio * (1 + 2 * xi - 3 * xi**2) / DT, rtol=1e-10)  # E4
        np.testing.assert_allclose(C[1, 1], 2 * ratio * (1 - xi) ** 2 / DT**2, rtol=1e-10)


def test_conventions_of_gamma_agree_with_the_published_example():
    # Erratum E6: at alpha, beta, gamma = .5, .2, .05 the formula gives .4857, as Lyapunov with kappa = gamma; .7143
    # with kappa = 2 gamma.
    for convention, expected in (("kappa", 0.4857), ("double", 0.7143)):
        kappa = gains.to_kappa(0.05, convention)
        assert abs(gains.variance_reduction(0.5, 0.2, kappa, dt=1.0)[0] - expected) < 5e-5
        assert abs(lyapunov(1.0, 0.5, 0.2, kappa)[0, 0] - expected) < 5e-5
    assert gains.to_kappa(0.05, "kalata") == 0.025
    for convention in ("kappa", "double", "kalata"):
        assert gains.from_kappa(gains.to_kappa(0.3, convention), convention) == 0.3


def test_stable_is_spectral_radius_below_one():
    checked = stable = 0
    for alpha in np.arange(-0.215, 2.3, 0.1):
        for beta in np.arange(-0.213, 4.3, 0.1):
            radius = np.abs(np.linalg.eigvals(closed_loop(1.0, alpha, beta))).max()
            assert bool(gains.is_stable(alpha, beta)) == (radius < 1)
            for kappa in (-0.1, 0.013, 0.11, 0.53, 1.7, 3.1):
                radius = np.abs(np.linalg.eigvals(closed_loop(1.0, alpha, beta, kappa))).max()
                assert bool(gains.is_stable(alpha, beta, kappa)) == (radius < 1)
                checked, stable = checked + 1, stable + (radius < 1)
    assert 0.05 < stable / checked < 0.95


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("xi", [0.0, 0.3, 0.7, 0.95])
def test_fading_memory_puts_all_poles_at_xi(order, xi):
    poles = np.linalg.eigvals(closed_loop(DT, *gains.fading_memory(xi, order=order)))
    np.testing.assert_allclose(poles, xi, rtol=0, atol=1e-5)  # a multiple root is that ill-conditioned


@pytest.mark.parametrize("order", [1, 2])
def test_growing_memory_is_the_running_least_squares_fit(order):
    z = np.random.default_rng(0).normal(size=20).cumsum()
    x = np.zeros(order + 1)
    for k in range(1, 21):
        gain = gains.growing_memory(k, order=order)
        F, K = matrices(DT, *gain)
        x = F @ x
        x = x + K * (z[k - 1] - x[0])
        fit = np.polynomial.Polynomial.fit(np.arange(k) * DT, z[:k], min(order, k - 1), domain=[-1, 1])
        expected = [fit.deriv(i)((k - 1) * DT) if i else fit((k - 1) * DT) for i in range(order + 1)]
        np.testing.assert_allclose(x, expected, rtol=0, atol=1e-10 * max(1, np.abs(expected).max()))


def test_growing_memory_takes_integers_floats_and_arrays():
    for k in (np.arange(1, 6), jnp.arange(1, 6), jnp.arange(1.0, 6.0), np.arange(1.0, 6.0)):
        alpha, beta = gains.growing_memory(k)
        np.testing.assert_allclose(alpha, [1, 1, 5 / 6, 0.7, 0.6], rtol=1e-15)
        np.testing.assert_allclose(beta, [0, 1, 0.5, 0.3, 0.2], rtol=1e-15)
    assert gains.growing_memory(jnp.float32(3))[0].dtype == jnp.float32


def test_cohen_is_benedict_bordner_to_three_digits():
    alpha, beta = gains.cohen()
    assert abs(gains.benedict_bordner(alpha)[1] - beta) < 5e-4


INDICES = [0.05, 0.3, 1.0, 3.0]


@pytest.mark.parametrize("index", [*INDICES, 1e-3, 30.0])
@pytest.mark.parametrize("noise", ["piecewise", "velocity", "continuous"])
def test_kalata_is_the_steady_kalman_gain(noise, index):
    r = 4.0
    F = np.array([[1, DT], [0, 1]])
    power = {"piecewise": 4, "velocity": 2, "continuous": 3}[noise]
    q = index**2 * r / DT**power
    g = np.array([DT**2 / 2, DT])
    Q = {
        "piecewise": q * np.outer(g, g),
        "velocity": np.diag([0, q]),
        "continuous": q * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]]),
    }[noise]
    np.testing.assert_allclose(gains.tracking_index(q, r, dt=DT, noise=noise), index, rtol=1e-14)
    alpha, beta = gains.kalata(index, noise=noise)
    tolerance = 1e-10 if index in INDICES else 1e-8  # the Riccati solver's own accuracy, at the outer indices
    np.testing.assert_allclose([alpha, beta / DT], riccati_gain(F, Q, r), rtol=tolerance)
    np.testing.assert_allclose(beta**2 / (1 - alpha), index**2, rtol=1e-10)
    if noise == "velocity":
        np.testing.assert_allclose(beta, gains.benedict_bordner(alpha)[1], rtol=1e-12)


@pytest.mark.parametrize("index", INDICES)
def test_kalata_of_order_two_is_the_steady_kalman_gain(index):
    r = 4.0
    F, _ = matrices(DT, 0, 0, 0)
    g = np.array([DT**2 / 2, DT, 1])
    Q = (index / DT**2) ** 2 * r * np.outer(g, g)
    alpha, beta, kappa = gains.kalata(index, order=2)
    np.testing.assert_allclose([alpha, beta / DT, kappa / DT**2], riccati_gain(F, Q, r), rtol=1e-10)
    np.testing.assert_allclose(kappa**2 / (1 - alpha), index**2, rtol=1e-10)
    np.testing.assert_allclose(kappa, beta**2 / (2 * alpha), rtol=1e-12)
    np.testing.assert_allclose(2 * beta, alpha * (alpha + beta + kappa / 2), rtol=1e-12)  # (2-50)


def test_kalata_reproduces_the_stated_digits():
    np.testing.assert_allclose(gains.kalata(0.3), [0.53691069, 0.20415200], rtol=0, atol=5e-9)
    np.testing.assert_allclose(gains.kalata(0.3, order=2), [0.73776277, 0.47611030, 0.15362731], rtol=0, atol=5e-9)
    s = (4 + 0.3 - np.sqrt(8 * 0.3 + 0.3**2)) / 4  # the formula as published
    np.testing.assert_allclose(gains.kalata(0.3), [1 - s**2, 2 * (1 + s**2) - 4 * s], rtol=1e-13)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("noise", ["piecewise", "velocity", "continuous"])
def test_kalata_is_accurate_over_twelve_decades_in_both_precisions(order, noise):
    if order == 2 and noise != "piecewise":
        with pytest.raises(ValueError, match="noise"):
            gains.kalata(1.0, order=2, noise=noise)
        return
    index = np.logspace(-6, 6, 49)
    exact = gains.kalata(index, order=order, noise=noise)
    single = gains.kalata(index.astype(np.float32), order=order, noise=noise)
    for a, b in zip(exact, single, strict=True):
        assert b.dtype == jnp.float32
        np.testing.assert_allclose(b, a, rtol=3e-6)
    inner = slice(0, 33)  # further up, 1 - alpha rounds to 0
    np.testing.assert_allclose((exact[-1] / np.sqrt(1 - exact[0]))[inner], index[inner], rtol=1e-8)
    assert (np.diff(exact[0]) >= 0).all()


def test_simpson_satisfies_its_relation_and_contains_benedict_bordner():
    alpha, beta, kappa = gains.simpson(0.5, 0.2)
    np.testing.assert_allclose(2 * beta - alpha * (alpha + beta + kappa / 2), 0, atol=1e-15)
    assert abs(gains.simpson(*gains.benedict_bordner(0.5))[2]) < 1e-15


@pytest.mark.parametrize("order", [1, 2])
def test_steady_lag_is_the_fixed_point_of_the_error(order):
    rate = 3.0
    for gain in random_stable(order, 20, seed=1):
        F, K = matrices(DT, *gain)
        drive = rate * np.array([DT ** (order + 1 - i) / [1, 1, 2, 6][order + 1 - i] for i in range(order + 1)])
        A = closed_loop(DT, *gain)
        e = np.linalg.solve(np.eye(order + 1) - A, drive - K * drive[0])
        predicted = (F @ e + drive)[0]
        got = gains.steady_lag(*gain, dt=DT, rate=rate)
        np.testing.assert_allclose(got, [e[0], predicted, *e[1:]], rtol=1e-8, atol=1e-8 * np.abs(e).max())


@pytest.mark.parametrize("order", [1, 2])
def test_unconstrained_gains_are_always_stable_and_invert(order):
    rng = np.random.default_rng(2)
    for x in rng.normal(0, 3, (50, order + 1)):
        gain = gains.from_unconstrained(*x)
        assert bool(gains.is_stable(*gain))
        np.testing.assert_allclose(gains.to_unconstrained(*gain), x, rtol=1e-6, atol=1e-6)
    for gain in random_stable(order, 20):
        np.testing.assert_allclose(gains.from_unconstrained(*gains.to_unconstrained(*gain)), gain, rtol=1e-10)


RULES = {
    "benedict_bordner": (gains.benedict_bordner, [0.4]),
    "simpson": (gains.simpson, [0.5, 0.2]),
    "fading_memory": (gains.fading_memory, [0.6]),
    "fading_memory order 2": (lambda x: gains.fading_memory(x, order=2), [0.6]),
    "growing_memory": (gains.growing_memory, [4.0]),
    "growing_memory order 2": (lambda k: gains.growing_memory(k, order=2), [4.0]),
    "kalata": (gains.kalata, [0.3]),
    "kalata velocity": (lambda x: gains.kalata(x, noise="velocity"), [0.3]),
    "kalata continuous": (lambda x: gains.kalata(x, noise="continuous"), [0.3]),
    "kalata order 2": (lambda x: gains.kalata(x, order=2), [0.3]),
    "kalata order 2, one real root at the seam": (lambda x: gains.kalata(x, order=2), [12 * 3.0**0.5]),
    "tracking_index": (lambda q, r, dt: gains.tracking_index(q, r, dt=dt), [0.1, 25.0, 0.7]),
    "variance_reduction": (lambda a, b, dt: gains.variance_reduction(a, b, dt=dt), [0.5, 0.2, 0.7]),
    "variance_reduction order 2": (lambda a, b, k, dt: gains.variance_reduction(a, b, k, dt=dt), [0.5, 0.2, 0.05, 0.7]),
    "steady_covariance": (lambda a, b, k, dt: gains.steady_covariance(a, b, k, dt=dt, r=2.0), [0.5, 0.2, 0.05, 0.7]),
    "steady_lag": (lambda a, b, dt: gains.steady_lag(a, b, dt=dt), [0.5, 0.2, 0.7]),
    "from_unconstrained": (gains.from_unconstrained, [0.3, -1.0, -2.0]),
    "to_unconstrained": (gains.to_unconstrained, [0.9, 0.7, 0.5]),
}


@pytest.mark.parametrize("name", RULES)
def test_rules_trace_batch_and_differentiate(name):
    rule, at = RULES[name]
    at = [jnp.asarray(x) for x in at]
    eager = rule(*at)
    x, unravel = ravel_pytree(at)
    flat = jax.jit(lambda x: ravel_pytree(rule(*unravel(x)))[0])
    np.testing.assert_allclose(flat(x), ravel_pytree(eager)[0], rtol=1e-13)
    h = 1e-5
    nearby = jnp.concatenate([x[None, :] + h * jnp.eye(x.size), x[None, :] - h * jnp.eye(x.size)])
    plus, minus = jnp.split(jax.jit(jax.vmap(flat))(nearby), 2)
    central = ((plus - minus) / (2 * h)).T
    forward, reverse = jax.jit(lambda x: (jax.jacfwd(flat)(x), jax.jacrev(flat)(x)))(x)
    np.testing.assert_allclose(forward, central, rtol=1e-6, atol=1e-8 * np.abs(central).max())
    np.testing.assert_allclose(reverse, forward, rtol=1e-10, atol=1e-12 * np.abs(central).max())


@pytest.mark.parametrize("name", RULES)
def test_rules_keep_float32_and_python_scalars_weak(name):
    rule, at = RULES[name]
    exact = jax.tree.leaves(rule(*at))
    for a, b in zip(exact, jax.tree.leaves(rule(*[jnp.float32(x) for x in at])), strict=True):
        assert b.dtype == jnp.float32
        np.testing.assert_allclose(b, a, rtol=2e-5, atol=2e-6)
    for x in exact:
        if name != "steady_covariance":
            assert (jnp.float32(1) * x).dtype == jnp.float32


BAD = {
    "xi = 1": (lambda: gains.fading_memory(1.0), "xi"),
    "xi < 0": (lambda: gains.fading_memory(-0.1), "xi"),
    "xi one of many": (lambda: gains.fading_memory(np.array([0.5, 1.2])), "xi"),
    "xi NaN": (lambda: gains.fading_memory(np.nan), "xi"),
    "index = 0": (lambda: gains.kalata(0.0), "index"),
    "index < 0": (lambda: gains.kalata(-1.0), "index"),
    "index infinite": (lambda: gains.kalata(np.inf), "index"),
    "unknown noise": (lambda: gains.kalata(1.0, noise="white"), "noise"),
    "unknown order": (lambda: gains.kalata(1.0, order=3), "order"),
    "k = 0": (lambda: gains.growing_memory(0), "k"),
    "growing order": (lambda: gains.growing_memory(3, order=0), "order"),
    "benedict-bordner alpha": (lambda: gains.benedict_bordner(1.2), "alpha"),
    "simpson alpha": (lambda: gains.simpson(0.0, 0.2), "alpha"),
    "tracking index q": (lambda: gains.tracking_index(-0.1, 1.0, dt=1.0), "q"),
    "tracking index r": (lambda: gains.tracking_index(0.1, 0.0, dt=1.0), "r"),
    "tracking index dt": (lambda: gains.tracking_index(0.1, 1.0, dt=0.0), "dt"),
    "tracking index noise": (lambda: gains.tracking_index(0.1, 1.0, dt=1.0, noise="x"), "noise"),
    "variance of unstable gains": (lambda: gains.variance_reduction(0.5, 3.1, dt=1.0), "alpha, beta"),
    "variance of unstable kappa": (lambda: gains.variance_reduction(0.5, 0.2, 0.2, dt=1.0), "alpha, beta, kappa"),
    "variance dt": (lambda: gains.variance_reduction(0.5, 0.2, dt=-1.0), "dt"),
    "covariance r": (lambda: gains.steady_covariance(0.5, 0.2, dt=1.0, r=-1.0), "r"),
    "lag dt": (lambda: gains.steady_lag(0.5, 0.2, dt=0.0), "dt"),
    "lag beta": (lambda: gains.steady_lag(0.5, 0.0, dt=1.0), "alpha, beta"),
    "convention": (lambda: gains.to_kappa(0.1, "simpson"), "convention"),
    "unconstrained": (lambda: gains.to_unconstrained(0.5, 3.5), "alpha, beta"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_arguments_are_named(name):
    call, argument = BAD[name]
    with pytest.raises(ValueError, match=f"^{argument}: "):
        call()


def test_nothing_raises_under_a_transformation():
    def rules(x):
        return (
            gains.fading_memory(x), gains.kalata(x), gains.kalata(x, order=2), gains.growing_memory(x),
            gains.benedict_bordner(x), gains.variance_reduction(x, 3 * x, dt=x), gains.steady_lag(x, x, dt=1.0),
            gains.is_stable(x, x),
        )  # fmt: skip

    out = jax.jit(rules)(jnp.asarray(-1.0))
    assert not bool(out[-1])
    with pytest.raises(ValueError, match=r"^index: "):  # concrete values are refused there too
        jax.jit(lambda x: x * gains.kalata(np.asarray(-1.0))[0])(1.0)
