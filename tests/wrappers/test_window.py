"""Windows of real samples and the polynomials through them."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilt.wrappers.window import Fit, Window, advance, check_fit, empty, extrapolate, push, select


def filled(size, zs, masks=None, dts=None, after=1.0):
    """The window after the samples zs (T, m) and then ``after`` more steps, in NumPy."""
    zs = np.asarray(zs, float)
    T, m = zs.shape
    masks = np.ones((T, m), bool) if masks is None else np.asarray(masks)
    t = np.cumsum(np.ones(T) if dts is None else dts)
    window = Window(np.zeros((size, m)), np.zeros((size, m)), np.zeros((size, m), np.int32), np.zeros((size, m), bool))
    for i in range(m):
        for slot, k in enumerate(np.flatnonzero(masks[:, i])[::-1][:size]):
            window.values[slot, i], window.ages[slot, i] = zs[k, i], t[-1] + after - t[k]
            window.steps[slot, i], window.valid[slot, i] = T - 1 - k + int(after), True
    return jax.tree.map(jnp.asarray, window)


@partial(jax.jit, static_argnums=(1, 2, 3), static_argnames="origin")
def fitted(window, size, max_age, degree, forgetting=1.0, origin=0):
    """Compiled as one: op by op takes longer."""
    return extrapolate(window, select(window, size, max_age, origin), degree, forgetting)


def reference(t, z, now, degree, forgetting=1.0, age=None):
    """Value and leverage by the formula in powers of tau, for one channel."""
    degree = min(degree, len(t) - 1)
    span = t[-1] - t[0] if len(t) > 1 else 1.0
    Phi = np.vander((t - t[-1]) / span, degree + 1, increasing=True)
    phi = np.vander([(now - t[-1]) / span], degree + 1, increasing=True)[0]
    W = np.diag(forgetting ** (np.arange(len(t))[::-1] if age is None else age))
    inverse = np.linalg.inv(Phi.T @ W @ Phi)
    return phi @ inverse @ Phi.T @ W @ z, phi @ inverse @ Phi.T @ W @ W @ Phi @ inverse @ phi


@pytest.mark.parametrize(
    ("N", "p", "h", "leverage"),
    [(10, 1, 1, 7 / 15), (10, 1, 6, 1.4363636363636), (5, 1, 5, 5.1), (20, 2, 31, 149.614342675)],
)
def test_leverages_of_the_specification(N, p, h, leverage):
    fit = fitted(filled(N, np.zeros((N + 3, 1)), after=h), N, None, p)
    np.testing.assert_allclose(fit.leverage, [leverage], rtol=1e-10)
    if p == 1:
        np.testing.assert_allclose(fit.leverage, [1 / N + 12 * ((N - 1) / 2 + h) ** 2 / (N * (N**2 - 1))], rtol=1e-12)


def test_pushing_and_aging_give_the_last_real_samples():
    rng = np.random.default_rng(3)
    zs, masks, dts = rng.normal(size=(20, 2)), rng.random((20, 2)) > 0.4, rng.uniform(0.1, 2.0, 20)

    def body(window, x):
        z, mask, dt = x
        return push(advance(window, dt), jnp.where(mask, z, jnp.nan), mask), None

    window, _ = jax.jit(lambda *x: jax.lax.scan(body, empty(4, x[0][0]), x))(zs, masks, dts)
    expected = filled(4, zs, masks, dts, after=0)
    for name in Window._fields:
        np.testing.assert_allclose(getattr(window, name), getattr(expected, name), rtol=1e-13, err_msg=name)
    assert window.steps.dtype == jnp.int32
    aged = advance(window, None)
    np.testing.assert_allclose(aged.ages - window.ages, 1.0, rtol=1e-13)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("forgetting", [1.0, 0.8])
def test_fit_is_weighted_least_squares_with_irregular_intervals(degree, forgetting):
    rng = np.random.default_rng(degree)
    dts = rng.uniform(0.2, 2.0, 12)
    t, z = np.cumsum(dts), rng.normal(size=(12, 2))
    fit = fitted(filled(7, z, dts=dts, after=1.7), 7, None, degree, forgetting)
    for channel in range(2):
        value, leverage = reference(t[-7:], z[-7:, channel], t[-1] + 1.7, degree, forgetting)
        np.testing.assert_allclose([fit.value[channel], fit.leverage[channel]], [value, leverage], rtol=1e-9)


def test_forgetting_counts_steps_and_not_samples():
    """A sample lost inside the window leaves the later ones their age."""
    z, mask = np.arange(6.0)[:, None] ** 2, np.array([1, 1, 0, 0, 1, 1], bool)[:, None]
    fit = fitted(filled(4, z, mask), 4, None, 1, 0.7)
    k = np.flatnonzero(mask)
    np.testing.assert_allclose(
        [fit.value[0], fit.leverage[0]], reference(k.astype(float), z[k, 0], 6.0, 1, 0.7, age=5 - k), rtol=1e-12
    )


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4])
def test_fewer_samples_lower_the_degree(count):
    z = np.array([3.0, -1.0, 4.0, 1.5])[:count, None]
    fit = fitted(filled(8, np.append(z, [[0.0]], axis=0), (np.arange(count + 1) < count)[:, None]), 8, None, 2)
    assert fit.available == (count > 0)
    if count:
        value, leverage = reference(np.arange(float(count)), z[:, 0], count + 1.0, 2)
        np.testing.assert_allclose([fit.value[0], fit.leverage[0]], [value, leverage], rtol=1e-11)
    assert np.isfinite(fit.value).all()


def test_equal_times_lower_the_degree():
    fit = fitted(filled(3, np.array([[1.0], [2.0], [6.0]]), dts=np.zeros(3)), 3, None, 1)
    np.testing.assert_allclose([fit.value[0], fit.leverage[0]], [3.0, 1 / 3], rtol=1e-14)


def test_selection_by_number_age_and_origin():
    mask = np.array([1, 1, 0, 0, 0, 0, 1, 1, 1], bool)[:, None]
    window = filled(5, np.arange(9.0)[:, None], mask)  # ages 1, 2, 3, 8, 9

    def used(**options):
        return np.asarray(window.steps)[np.asarray(select(window, **options))].tolist()

    assert used(size=5, max_age=None) == [1, 2, 3, 8, 9]
    assert used(size=4, max_age=None) == [1, 2, 3, 8]
    assert used(size=5, max_age=6) == [1, 2, 3]
    assert used(size=2, max_age=None, origin=3) == [3, 8]
    assert used(size=2, max_age=4, origin=3) == [3]


@pytest.mark.parametrize("origin", [0, 2, 4])
def test_fit_as_of_an_earlier_origin_is_the_fit_made_then(origin):
    rng = np.random.default_rng(1)
    z, mask = rng.normal(size=(15, 1)), rng.random((15, 1)) > 0.3
    window = filled(6 + 4, z, mask, after=1)
    then = filled(6, z[: 16 - origin], mask[: 16 - origin], after=max(origin, 1))  # samples of age >= origin
    now = fitted(window, 6, 8, 2, origin=origin)
    expected = fitted(then, 6, 8, 2)
    np.testing.assert_allclose(now.value, expected.value, rtol=1e-12)
    np.testing.assert_allclose(now.leverage, expected.leverage, rtol=1e-12)


def test_float32_keeps_its_digits_after_a_long_run_and_far_from_the_origin():
    dt = jnp.asarray(0.1, jnp.float32)

    def body(k, window):
        window = advance(window, dt)
        y = 1e6 + 0.25 * (k % 4).astype(jnp.float32)
        return push(window, y[None], (k % 7 != 3)[None])

    window = jax.jit(lambda w: jax.lax.fori_loop(0, 200_004, body, w))(empty(12, jnp.zeros(1, jnp.float32)))
    fit = fitted(advance(window, dt), 12, None, 2)
    k = np.arange(200_004 - 40, 200_004)
    k = k[k % 7 != 3][-12:]
    value, leverage = reference(0.1 * k, 1e6 + 0.25 * (k % 4), 0.1 * 200_004, 2)
    assert fit.value.dtype == fit.leverage.dtype == jnp.float32
    assert abs(float(fit.value[0]) - value) <= 0.13  # 1e6 has a spacing of 0.0625
    np.testing.assert_allclose(fit.leverage, [leverage], rtol=1e-4)


def test_only_values_are_batched_when_runs_share_their_mask():
    """With out_axes=None vmap raises for whatever depends on the run."""
    mask = jnp.asarray(np.arange(9) % 4 != 2)[:, None]

    def run(ys):
        def body(window, x):
            y, present = x
            window = advance(window, None)
            fit = extrapolate(window, select(window, 4, 12), 1)
            return push(window, y, present), fit

        return jax.lax.scan(body, empty(4, ys[0]), (ys, mask))

    axes = (Window(0, None, None, None), Fit(0, None, None))
    window, fit = jax.vmap(run, out_axes=axes)(jnp.ones((3, 9, 1)))
    assert window.values.shape == (3, 4, 1)
    assert fit.leverage.shape == (9, 1)


@pytest.mark.parametrize("count", [0, 1, 6])
def test_gradients_are_finite_and_right(count):
    z = np.random.default_rng(2).normal(size=(7, 1))
    window = filled(8, z, (np.arange(7) < count)[:, None], after=0)

    def f(x):  # forgetting, interval to the present
        fit = fitted(advance(window, x[1]), 8, None, 2, x[0])
        return jnp.sum(jnp.where(fit.available, fit.value + fit.leverage, 0.0))

    at, h = jnp.array([0.9, 1.3]), 1e-6
    steps = h * jnp.eye(2)
    gradient = jax.jit(jax.grad(f))(at)
    numeric = jax.jit(jax.vmap(lambda e: (f(at + e) - f(at - e)) / (2 * h)))(steps)
    np.testing.assert_allclose(gradient, numeric, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ((0, 0, 1.0, None), "window"),
        ((2.0, 0, 1.0, None), "window"),
        ((3, 3, 1.0, None), "degree"),
        ((3, -1, 1.0, None), "degree"),
        ((3, 1, 0.0, None), "forgetting"),
        ((3, 1, 1.1, None), "forgetting"),
        ((3, 1, 1.0, 0), "max_age"),
    ],
)
def test_bad_options_are_refused_by_name(arguments, name):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        check_fit(*arguments)
