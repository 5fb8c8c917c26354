"""What is known of traced arrays."""

from __future__ import annotations

import gc

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.linalg import structure


def labels(x):
    (known,) = structure.of(x)
    return None if known is None else structure.unpack(known).tolist()


def test_values_that_can_be_seen():
    assert labels(jnp.array([[2.0, 0.0], [0.0, 2.0]])) == [[1, 0], [0, 1]]
    assert labels(jnp.array([[1.0, 2.0], [3.0, 4.0]])) is None  # all different, none 0
    assert labels(jnp.array([[-0.0, jnp.nan], [jnp.nan, 1.0]])) == [[0, 1], [1, 2]]
    assert labels(jnp.array([0.0, 0.0])) is None  # a vector is a parameter
    assert labels(jnp.eye(2, dtype=jnp.int32)) is None
    assert structure.of((1.0, jnp.eye(2)))[0] is None


def test_a_batch_is_zero_or_equal_where_all_runs_are():
    batch = jnp.array([[[1.0, 0.0], [0.0, 1.0]], [[2.0, 0.0], [3.0, 2.0]]])
    seen = []
    jax.vmap(lambda A: seen.append(labels(A)))(batch)
    jax.vmap(lambda A: seen.append(labels(A)), in_axes=2)(jnp.moveaxis(batch, 0, 2))
    twice = jnp.stack([batch, 2 * batch], -1).swapaxes(0, 1)
    jax.vmap(jax.vmap(lambda A: seen.append(labels(A)), in_axes=1), in_axes=3)(twice)
    assert seen == [[[1, 0], [2, 1]]] * 3


def test_what_is_traced_is_known_only_if_it_was_noted():
    seen = []

    def f(r):
        seen.append(labels(r * jnp.eye(2)))
        R = structure.diagonal(structure.repeat(r, 2))
        seen.append(labels(R))
        seen.append(labels(R + 0.0))  # another array
        seen.append(labels(structure.diagonal(jnp.stack([r, 2 * r]))))
        seen.append(labels(structure.array(np.eye(2), R.dtype)))
        return R.sum()

    expected = [None, [[1, 0], [0, 1]], None, [[1, 0], [0, 2]], [[1, 0], [0, 1]]]
    for run, shape in ((jax.jit(f), ()), (jax.grad(f), ()), (jax.jit(jax.vmap(f)), (3,)), (jax.jit(jax.grad(f)), ())):
        seen.clear()
        run(jnp.ones(shape))
        assert seen == expected


def test_labels_cross_jit_as_a_static_argument_and_derivatives_do_not_see_them():
    """A derivative by an entry that happens to be 0 is not 0."""
    seen = []

    def f(A, known):
        structure.noted(A, known)
        seen.append(labels(A))
        jax.grad(lambda B: seen.append(labels(B)) or B.sum())(A)
        return A

    jax.jit(f, static_argnums=1)(jnp.eye(2), structure.of(jnp.eye(2)))
    assert seen == [[[1, 0], [0, 1]], None]


def test_notes_go_with_their_arrays():
    gc.collect()
    before = len(structure._NOTED)
    jax.jit(lambda r: structure.diagonal(structure.repeat(r, 3)))(1.0)
    jax.clear_caches()
    gc.collect()
    assert len(structure._NOTED) <= before
