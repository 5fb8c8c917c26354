"""Properties that every filter of the registry must have, in float32 and float64."""

from __future__ import annotations

import functools
import itertools
import typing

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxfilt as jf
from jaxfilt.core import _filter
from tests.registry import REGISTRY, T, params, series

DTYPES = [jnp.float32, jnp.float64]
NAMES = sorted(REGISTRY)
both = pytest.mark.parametrize("dtype", DTYPES, ids=["f32", "f64"])
# One representative of each way to filter: for these the dearest properties are tested by default too.
CORE = {
    "alpha_beta", "delayed_kalman", "extended", "fuzzy_noise", "imm", "kalman", "mixed_hinf", "polynomial_fit",
    "sqrt_kalman", "unscented",
}  # fmt: skip


def _names(slow):
    """All filters, those for which ``slow`` holds only in `make test-all`. One process runs all tests of a filter."""
    return pytest.mark.parametrize(
        "name",
        [pytest.param(name, marks=[pytest.mark.xdist_group(name), *[pytest.mark.slow] * slow(name)]) for name in NAMES],
    )


every = _names(lambda name: False)
every_but_twins = _names(lambda name: REGISTRY[name].twin)  # a twin shares its code with another example
every_core = _names(lambda name: name not in CORE)


def tolerance(dtype):
    return 1e-4 if dtype == jnp.float32 else 1e-10


def skip_exempt(name, prop):
    if prop in REGISTRY[name].exempt:
        pytest.skip(REGISTRY[name].exempt[prop])


def assert_close(a, b, tol):
    leaves_a, tree_a = jax.tree.flatten(a)
    leaves_b, tree_b = jax.tree.flatten(b)
    assert tree_a == tree_b
    for x, y in zip(leaves_a, leaves_b, strict=True):
        x, y = np.asarray(x), np.asarray(y)
        np.testing.assert_allclose(x, y, rtol=0, atol=tol * max(1.0, np.abs(y).max(initial=0)))


def test_every_public_factory_is_registered():
    registered = {example.factory for example in REGISTRY.values()}
    missing = []
    for public in vars(jf).values():
        if callable(public) and getattr(public, "__module__", "").startswith("jaxfilt."):
            try:
                returns = typing.get_type_hints(public).get("return")
            except (TypeError, NameError):
                continue
            machinery = {jf.bind, jf.wrap}
            if returns is jf.Filter and public not in registered and public not in machinery:
                missing.append(public.__name__)
    assert not missing, f"not in tests/registry.py: {missing}"


def test_exemptions_are_reasoned(capsys):
    listed = [(name, prop, why) for name in NAMES for prop, why in REGISTRY[name].exempt.items()]
    with capsys.disabled():
        for entry in listed:
            print("\nexempt: {} from {}: {}".format(*entry), end="")
    assert all(len(why) > 20 for *_, why in listed)


# Compiling is what these tests cost: each function here is compiled once for each filter and dtype, and serves several.


@functools.cache
def compiled(name, masked=True):
    """``(params, ys (3, T, m), mask, keys) -> everything``, batched."""
    example = REGISTRY[name]

    def f(p, ys, mask, keys):
        options = {**example.options, "mask": mask if masked else None}
        return jax.vmap(
            lambda y, k: jf.filter(example.make(p), y, outputs=jf.everything, **{**options, "key": k})
        )(ys, keys)  # fmt: skip

    return jax.jit(f)


def keys_of(name):
    key = REGISTRY[name].options.get("key")
    return None if key is None else jax.random.split(key, 3)


def mask_of(name):
    example = REGISTRY[name]
    return jnp.broadcast_to(jnp.asarray(example.options.get("mask", True)), (T, example.m))


def batch(name, dtype, ys=None, mask=None, *, masked=True):
    """Three runs of the example; ``masked=False`` without any mask."""
    example = REGISTRY[name]
    ys = series(example, dtype, runs=3) if ys is None else ys
    mask = mask_of(name) if mask is None else mask
    return compiled(name, masked)(params(example, dtype), ys, mask if masked else None, keys_of(name))


def alone(name, dtype, i):
    """Run i of the batch by itself."""
    example = REGISTRY[name]
    options = {**example.options, "mask": mask_of(name)}
    if (keys := keys_of(name)) is not None:
        options["key"] = keys[i]
    return jf.filter(example.make(params(example, dtype)), series(example, dtype, runs=3)[i], **options)


@both
@every
def test_shapes_dtypes_and_covariances(name, dtype):
    """Shapes and dtypes as promised, finite; covariances symmetric to the bit and PSD."""
    out = jax.tree.map(lambda x: x[0], batch(name, dtype))
    n, m = out.mean.shape[1], REGISTRY[name].m
    shapes = {
        "mean": (T, n), "cov": (T, n, n), "innovation": (T, m), "innovation_cov": (T, m, m),
        "nis": (T,), "log_lik": (T,), "status": (T,), "noise_cov": (T, m, m),
    }  # fmt: skip
    for field, shape in shapes.items():
        if (got := getattr(out, field)) is not None:
            assert got.shape == shape, field
            assert got.dtype == (jnp.int32 if field == "status" else dtype), field
    assert all(leaf.dtype == dtype for leaf in jax.tree.leaves((out.prediction,)))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(out))
    eps = float(jnp.finfo(dtype).eps)
    for cov in (out.cov, out.prediction.cov, out.innovation_cov):
        if cov is not None:
            cov = np.asarray(cov)
            assert (cov == np.swapaxes(cov, 1, 2)).all()
            eigenvalues = np.linalg.eigvalsh(cov.astype(float))
            assert (eigenvalues[:, 0] >= -10 * cov.shape[1] * eps * eigenvalues[:, -1]).all()


@every
def test_vmap_equals_loop(name):
    batched = jax.vmap(jf.summary, (None, 0))(None, batch(name, jnp.float64))
    for i in range(3):
        assert_close(jax.tree.map(lambda x, i=i: x[i], batched), alone(name, jnp.float64, i), 1e-10)


@every_but_twins
def test_scan_equals_single_steps_and_streams(name):
    """One scan, single steps (uncompiled for one filter), and two chunks with the state handed on agree."""
    example, dtype = REGISTRY[name], jnp.float64
    step = jf.step if name == "kalman" else jax.jit(jf.step)
    filt, ys = example.make(params(example, dtype)), series(example, dtype, runs=3)[0]
    options = {**example.options, "mask": mask_of(name)}
    if (keys := keys_of(name)) is not None:
        options["key"] = keys[0]
    inputs = jf.inputs(ys, **options)
    whole = alone(name, dtype, 0)

    def at(k):
        return jax.tree.map(lambda leaf: leaf[k], inputs)

    first = at(0) if keys is None else at(0)._replace(key=jax.random.fold_in(keys[0], 0))
    state = start = filt.init(first)
    infos = []
    for k in range(3):
        state, info = step(filt, state, at(k))
        infos.append(jf.summary(state, info))
    stepped = jax.tree.map(lambda *xs: jnp.stack(xs), *infos)
    assert_close(stepped, jax.tree.map(lambda x: x[:3], whole), tolerance(dtype))

    half = T // 2
    split = [jax.tree.map(lambda leaf, part=part: leaf[part], inputs) for part in (slice(0, half), slice(half, T))]
    state, head = jf.scan(filt, start, split[0])
    _, tail = jf.scan(filt, state, split[1])
    joined = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), head, tail)
    assert_close(joined, whole, tolerance(dtype))


@every_core
def test_population_of_filters_is_a_vmap(name):
    """A stacked filter is a bank of filters: vmap over the parameters themselves."""
    example = REGISTRY[name]
    base = params(example, jnp.float64)
    population = jax.tree.map(lambda x: jnp.stack([x, x * 1.01]), base)
    ys = series(example, jnp.float64, runs=3)[0]
    options = {**example.options, "mask": mask_of(name)}
    if (keys := keys_of(name)) is not None:
        options["key"] = keys[0]
    filters = jax.vmap(example.make)(population)
    batched = jax.vmap(lambda f: jf.filter(f, ys, **options))(filters)
    assert_close(jax.tree.map(lambda x: x[0], batched), alone(name, jnp.float64, 0), 1e-10)


@every_but_twins
def test_all_true_mask_is_no_mask(name):
    skip_exempt(name, "all_true_mask")
    full = batch(name, jnp.float64, mask=jnp.ones((T, REGISTRY[name].m), bool))
    assert_close(full, batch(name, jnp.float64, masked=False), 1e-13)


@both
@every
def test_all_false_mask_is_prediction(name, dtype):
    skip_exempt(name, "all_false_mask")
    nothing = jnp.full((3, T, REGISTRY[name].m), jnp.nan, dtype)  # what is absent may hold anything
    out = batch(name, dtype, nothing, jnp.zeros(nothing.shape[1:], bool))
    assert_close(out.mean, out.prediction.mean, 0)
    if out.cov is not None:
        assert_close(out.cov, out.prediction.cov, tolerance(dtype))
    if out.log_lik is not None:
        assert (out.log_lik == 0).all()
    assert (out.innovation == 0).all()
    assert ((out.status & int(jf.Status.MISSED)) != 0).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(out))


@every
def test_no_retrace_with_new_parameters_and_data(name):
    example = REGISTRY[name]
    p, ys = params(example, jnp.float64), series(example, jnp.float64, runs=3)[0]
    options = {**example.options, "mask": mask_of(name)}
    jf.filter(example.make(p), ys, **options)
    before = _filter._cache_size()  # pyright: ignore[reportAttributeAccessIssue]
    jf.filter(example.make(jax.tree.map(lambda x: x * 1.001, p)), ys + 1.0, **options)
    assert _filter._cache_size() == before  # pyright: ignore[reportAttributeAccessIssue]


@both
@every
def test_a_bad_value_is_flagged_and_other_runs_are_untouched(name, dtype):
    """NaN in one run of a batch: that step is flagged, and the other runs are the same to the bit."""
    example = REGISTRY[name]
    ys = series(example, dtype, runs=3)
    dirty_ys = ys.at[1, 4, 0].set(jnp.nan).at[1, 7, 0].set(jnp.inf)
    clean, dirty = batch(name, dtype, ys), batch(name, dtype, dirty_ys)
    bad = (np.asarray(dirty.status) & int(jf.Status.NONFINITE)) != 0
    assert bad[1, 4]
    assert bad[1, 7]
    assert bad.sum() == 2
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(dirty))
    for a, b in zip(jax.tree.leaves(clean), jax.tree.leaves(dirty), strict=True):
        assert (np.asarray(a)[[0, 2]] == np.asarray(b)[[0, 2]]).all()
    with pytest.raises(ValueError, match=r"ys\[4, 0\] is nan"):
        jf.filter(example.make(params(example, dtype)), dirty_ys[1], **example.options)


@every
def test_a_traced_parameter_that_is_not_finite_leaves_no_silent_nan(name):
    """Under ``jit`` nothing raises; each step is finite or has a status. The program is that of the tests above."""
    example, dtype = REGISTRY[name], jnp.float64
    leaves, tree = jax.tree.flatten(params(example, dtype))
    ys = series(example, dtype, runs=3)
    for i, bad in itertools.product(range(len(leaves)), (np.nan, np.inf, -1.0)):
        x = np.array(leaves[i])
        x.reshape(-1)[0] = bad
        wrong = jax.tree.unflatten(tree, [*leaves[:i], jnp.asarray(x), *leaves[i + 1 :]])
        out = compiled(name)(wrong, ys, mask_of(name), keys_of(name))
        numbers = [np.asarray(x) for x in (out.mean, out.cov, out.log_lik) if x is not None]
        finite = np.stack([np.isfinite(x).reshape(3, T, -1).all(axis=-1) for x in numbers]).all(axis=0)
        assert (finite | (np.asarray(out.status) != 0)).all(), (i, bad)


@every
def test_wrong_dtype_or_shape_is_refused(name):
    example = REGISTRY[name]
    filt, ys = example.make(params(example, jnp.float64)), series(example, jnp.float64)
    if "dtype" not in example.exempt:
        with pytest.raises(TypeError, match=r"ys: is float32, but the filter's model is float64"):
            jf.filter(filt, ys.astype(jnp.float32), **example.options)
    with pytest.raises(TypeError, match=r"ys: expected a float array, got int"):
        jf.filter(filt, ys.astype(jnp.int32), **example.options)
    with pytest.raises(ValueError, match="ys: expected at least one sample"):
        jf.filter(filt, ys[:0])
    if "shape" not in example.exempt:
        with pytest.raises(ValueError, match="ys: expected 2 components"):
            jf.filter(filt, jnp.concatenate([ys, ys], axis=1), **{**example.options, "mask": None})


@functools.cache
def objective(name):
    """A scalar of all that a filter computes, as a function of ``(params, mask)``."""
    example = REGISTRY[name]

    def f(p, mask):
        ys = series(example, jnp.float64).astype(jax.tree.leaves(p)[0].dtype)
        out = jf.filter(example.make(p), ys, **{**example.options, "mask": mask})
        weights = jnp.sin(jnp.arange(out.mean.size, dtype=out.mean.dtype)).reshape(out.mean.shape)
        total = jnp.sum(weights * out.mean)
        return total if out.log_lik is None else total + jnp.sum(out.log_lik)

    return f


@functools.cache
def gradient(name):
    """One compiled gradient for each filter and dtype, for several tests."""
    return jax.jit(jax.grad(objective(name)))


def points(name):
    """Three random points near the example's parameters, as vectors, and the way back."""
    base, unravel = ravel_pytree(params(REGISTRY[name], jnp.float64))
    near = [jax.random.uniform(jax.random.key(seed), base.shape, minval=-1.0, maxval=1.0) for seed in range(3)]
    return [base * (1 + 0.05 * u) for u in near], unravel


@every_but_twins
def test_gradient_equals_central_differences(name):
    """For every float parameter at three random points."""
    skip_exempt(name, "differences")
    at, unravel = points(name)
    mask = mask_of(name)
    h = 3e-5

    @jax.jit
    def differences(v):
        # Fourth order, so that rounding rather than truncation limits it.
        shifts = h * jnp.array([-2.0, -1.0, 1.0, 2.0])[:, None, None] * jnp.eye(v.size)[None]
        values = jax.vmap(jax.vmap(lambda x: objective(name)(unravel(x), mask)))(v[None, None, :] + shifts)
        return jnp.array([1.0, -8.0, 8.0, -1.0]) @ values / (12 * h)

    for v in at:
        reverse, numeric = ravel_pytree(gradient(name)(unravel(v), mask))[0], differences(v)
        assert np.isfinite(reverse).all()
        np.testing.assert_allclose(reverse, numeric, rtol=1e-6, atol=1e-6 * float(jnp.abs(numeric).max()))


@every_core
def test_forward_mode_equals_reverse_mode(name):
    skip_exempt(name, "gradient")
    at, unravel = points(name)
    mask = mask_of(name)
    forward = jax.jit(jax.jacfwd(lambda v: objective(name)(unravel(v), mask)))
    for v in at:
        reverse = ravel_pytree(gradient(name)(unravel(v), mask))[0]
        np.testing.assert_allclose(reverse, forward(v), rtol=1e-9, atol=1e-11 * float(jnp.abs(reverse).max()))


@every_core
def test_gradients_in_single_precision_and_in_gaps(name):
    """float32 is close to float64; finite in both when everything is missed."""
    skip_exempt(name, "gradient")
    found = {}
    for dtype in DTYPES:
        p, mask = params(REGISTRY[name], dtype), mask_of(name)
        found[dtype] = np.asarray(ravel_pytree(gradient(name)(p, mask))[0], float)
        missed = gradient(name)(p, jnp.zeros_like(mask))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(missed))
    assert np.abs(found[jnp.float32] - found[jnp.float64]).max() <= 1e-3 * np.abs(found[jnp.float64]).max()
