"""Logarithm, sine, cosine and arc tangent: errors against extended precision, special values, derivatives, use."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt.linalg import elementary

pytestmark = pytest.mark.skipif(
    jax.default_backend() != "cpu" or np.finfo(np.longdouble).nmant < 63, reason="other programs, or none to compare to"
)

N = 200_000
BOTH = pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["f32", "f64"])
# XLA compiles as its users have it: which operations it contracts decides the last bits.
OPTIONS = {"xla_backend_optimization_level": 2, "xla_cpu_use_fusion_emitters": True}


def compiled(function, *args):
    out = jax.jit(function).lower(*args).compile(OPTIONS)(*args)
    return jax.tree.map(np.asarray, out)


def ulps(got, true):
    """The largest error in units of the last place of the true value, which has extended precision."""
    assert true.dtype == np.longdouble
    least = np.finfo(got.dtype).tiny
    unit = np.spacing(np.maximum(abs(true).astype(got.dtype), least)).astype(np.longdouble)
    return float((abs(got - true) / unit).max())


def extended(*xs):
    return [x.astype(np.longdouble) for x in xs]


def rng():
    return np.random.default_rng(1)


LOGARITHMS = {
    "all": lambda: rng().integers(1, 0x7FEFFFFFFFFFFFFF, N).view(np.float64),
    "subnormal": lambda: rng().integers(1, 1 << 52, N).view(np.float64),
    "near 1": lambda: 1 + rng().uniform(-0.3, 0.45, N),
    "nearest to 1": lambda: 1 + rng().uniform(-1, 1, N) * 2.0 ** -rng().integers(1, 53, N),
    "powers of 2": lambda: np.ldexp(1.0, np.arange(-1074, 1024)),
    "smallest": lambda: np.arange(1, 1000).view(np.float64),
}


@pytest.mark.parametrize("points", LOGARITHMS)
def test_logarithm(points):
    x = LOGARITHMS[points]()
    assert ulps(compiled(elementary.log, x), np.log(*extended(x))) < 1


def angles(dtype):
    """Points by the bound on the error (ulp) that holds there."""
    near, far = (1e3, 2**13) if dtype == np.float32 else (1e5, 2**30)
    g, quarters = rng(), int(near / 1.6)
    within = [
        g.uniform(-4, 4, N), g.uniform(-near, near, N), g.uniform(-1, 1, N) * 2.0 ** -g.integers(0, 100, N),
        np.arange(-quarters, quarters) * (np.pi / 2), np.arange(-quarters, quarters) * (np.pi / 4),
        g.uniform(-far, far, N), np.arange(-40, 40) * 0.1,
    ]  # fmt: skip
    multiples = g.integers(int(-far / 1.6), int(far / 1.6), N) * (np.pi / 2)
    return (np.concatenate(within).astype(dtype), 1), (multiples.astype(dtype), 2)


@BOTH
def test_sine_and_cosine(dtype):
    for x, bound in angles(dtype):
        s, c = compiled(elementary.sincos, x)
        assert s.dtype == c.dtype == dtype
        assert ulps(s, np.sin(*extended(x))) < bound
        assert ulps(c, np.cos(*extended(x))) < bound


@BOTH
def test_sine_and_cosine_of_numbers_too_large_are_those_of_a_neighbour(dtype):
    x = (rng().uniform(-1, 1, N) * 2.0 ** rng().integers(14, 120, N)).astype(dtype)
    s, c = compiled(elementary.sincos, x)
    spacing = np.spacing(abs(x)).astype(np.longdouble)
    assert (abs(s - np.sin(*extended(x))) / spacing).max() < 4
    assert (abs(c - np.cos(*extended(x))) / spacing).max() < 4
    np.testing.assert_allclose(s.astype(float) ** 2 + c.astype(float) ** 2, 1, atol=10 * np.finfo(dtype).eps)


@BOTH
def test_angle_of_a_point(dtype):
    g = rng()
    scale = 2.0 ** g.integers(-50, 50, N)
    a = g.uniform(-np.pi, np.pi, N)
    half = 0.5 * (1 + g.uniform(-1, 1, N) * 2.0 ** -g.integers(1, 50, N))
    points = [
        (g.uniform(-1, 1, N), g.uniform(-1, 1, N)), (np.sin(a) * scale, np.cos(a) * scale), (half * scale, scale),
        (scale, -half * scale), (g.uniform(-1, 1, N) * scale, g.uniform(-1, 1, N)),
        tuple(g.uniform(-1, 1, (2, N)) * float(np.finfo(dtype).max)),
    ]  # fmt: skip
    y, x = (np.concatenate(column).astype(dtype) for column in zip(*points, strict=True))
    got = compiled(elementary.arctan2, y, x)
    assert got.dtype == dtype
    assert ulps(got, np.arctan2(*extended(y, x))) < 2


def same(got, want):
    """Equal to a relative 1e-7 or 4e-16, zeros with their signs."""
    np.testing.assert_allclose(got, want, rtol=2 * np.finfo(want.dtype).eps, atol=0)
    np.testing.assert_array_equal(np.signbit(got[got == 0]), np.signbit(want[got == 0]))


@BOTH
def test_special_values(dtype):
    large = np.finfo(dtype).max
    values = np.array([0, -0.0, 1, -1, np.inf, -np.inf, np.nan, large, -large, np.finfo(dtype).tiny], dtype)
    y, x = (v.ravel() for v in np.meshgrid(values, values))
    with np.errstate(all="ignore"):
        tiny = abs(y / x) < np.finfo(dtype).tiny  # XLA's quotient is 0
        want = np.where(tiny & (x > 0), np.copysign(0, y), np.arctan2(y, x)).astype(dtype)
        same(compiled(elementary.arctan2, y, x), want)
        same(compiled(elementary.log, values), np.log(values))
        few = values[abs(values) != large]
        for got, true in zip(compiled(elementary.sincos, few), (np.sin(few), np.cos(few)), strict=True):
            same(got, true)
    assert np.all(abs(np.array(compiled(elementary.sincos, values[7:9]))) <= 1)


def along(function, n):
    """The function's first two derivatives along all its arguments at once, by each mode."""

    def line(*xs):
        return lambda t: function(*(x + (i + 1) * t for i, x in enumerate(xs)))

    def forward(f):
        return lambda t: jax.jvp(f, (t,), (jnp.ones_like(t),))[1]

    def values(*xs):
        f, t = line(*xs), jnp.zeros((), xs[0].dtype)
        return [forward(f)(t), jax.grad(f)(t), forward(forward(f))(t), forward(jax.grad(f))(t), jax.grad(forward(f))(t)]

    return jax.vmap(values)


@BOTH
@pytest.mark.parametrize("name", ["log", "sin", "cos", "arctan2"])
def test_derivatives_are_those_of_jax(name, dtype):
    g = rng()
    args = [abs(g.normal(size=50)).astype(dtype)] if name == "log" else [3 * g.normal(size=50).astype(dtype)]
    args += [g.normal(size=50).astype(dtype)] if name == "arctan2" else []
    got = compiled(along(getattr(elementary, name), len(args)), *args)
    want = compiled(along(getattr(jnp, name), len(args)), *args)
    for a, b in zip(got, want, strict=True):
        np.testing.assert_allclose(a, b, rtol=50 * np.finfo(dtype).eps, atol=50 * np.finfo(dtype).eps)


def test_derivatives_at_special_points_are_those_of_jax():
    points = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [-1.0, 0.0], [np.inf, 1.0], [1.0, np.inf]])
    for argnum in (0, 1):
        got, want = (compiled(jax.vmap(jax.grad(f, argnum)), *points.T) for f in (elementary.arctan2, jnp.arctan2))
        np.testing.assert_array_equal(got, want)
    zero = np.zeros(1)
    got, want = (compiled(jax.vmap(jax.grad(f)), zero) for f in (elementary.log, jnp.log))
    np.testing.assert_array_equal(got, want)
    one = jnp.ones(())
    assert jax.jit(jax.grad(lambda t: elementary.arctan2(one, one) * t))(one) == elementary.arctan2(one, one)


def test_types_and_shapes_are_as_in_jax():
    assert elementary.sin(jnp.zeros((2, 3))).shape == (2, 3)
    assert elementary.arctan2(jnp.ones((2, 1)), jnp.ones((1, 3))).shape == (2, 3)
    assert elementary.arctan2(1.0, jnp.float32(2.0)).dtype == jnp.float32
    assert elementary.log(jnp.float32(2.0)) == jnp.log(jnp.float32(2.0))
    half = jnp.ones(2, jnp.bfloat16)
    np.testing.assert_array_equal(elementary.cos(half), jnp.cos(half))


M0 = np.array([1000.0, 500.0, 10.0, 5.0, 0.02])


def tracker(m0):
    dtype = m0.dtype
    P0 = jnp.diag(jnp.array([100.0, 100.0, 10.0, 10.0, 0.01], dtype))
    turn = jf.models.coordinated_turn(dt=1.0, q_omega=1e-5, q=0.1, r=1.0, m0=m0, P0=P0)
    R = jnp.diag(jnp.array([25.0, 1e-4], dtype))
    return jf.extended(jf.models.with_sensor(turn, jf.models.sensors.range_bearing(R)))


def series(dtype=jnp.float64):
    t = np.arange(12.0)
    x, y = 1000 + 10 * t, 500 + 5 * t
    noise = rng().normal(size=(12, 2)) * [5, 0.01]
    return jnp.asarray(np.stack([np.hypot(x, y), np.arctan2(y, x)], -1) + noise, dtype)


def primitives(jaxpr):
    for eqn in jaxpr.eqns:
        yield eqn.primitive.name, eqn.outvars[0].aval
        for value in eqn.params.values():
            for inner in value if isinstance(value, tuple | list) else (value,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from primitives(inner)


@BOTH
def test_a_range_bearing_filter_uses_them(dtype):
    def seen(form):
        run = jax.make_jaxpr(lambda filt, ys: jf.filter(filt, ys, form=form).log_lik)
        return {
            name
            for name, aval in primitives(run(tracker(jnp.asarray(M0, dtype)), series(dtype)).jaxpr)
            if aval.shape == ()
        }

    slow = {"sin", "cos", "atan2"} | ({"log"} if dtype == np.float64 else set())
    assert not seen("scalar") & slow
    assert seen("dense") >= {"sin", "cos", "atan2"}


def test_the_scalar_form_equals_the_dense_one():
    ys = series()

    def loss(m0, form):
        out = jf.filter(tracker(m0), ys, form=form)
        return out.log_lik.sum(), out

    value = jax.jit(jax.value_and_grad(loss, has_aux=True), static_argnums=1)
    (_, got), dgot = value(jnp.asarray(M0), "scalar")
    (_, want), dwant = value(jnp.asarray(M0), "dense")
    for a, b in ((got.mean, want.mean), (got.cov, want.cov), (got.log_lik, want.log_lik), (dgot, dwant)):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * max(1.0, float(abs(b).max())))
