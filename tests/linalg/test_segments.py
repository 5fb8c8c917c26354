"""Programs in segments."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilt.linalg import segments


def program(x, y):
    """Many dependent operations, an output that is an input, one that is a constant, and one that nobody needs."""
    unused = jnp.sin(y["b"])
    del unused
    a, b = x, y["b"]
    for _ in range(10):
        a, b = a * b + 1.0, jnp.cos(a) - 0.5 * b
    return {"a": a, "x": x, "one": 1.0}, (b, jnp.ones(()))


@pytest.mark.parametrize("piece", [1, 3, 7, 1000])
def test_values_and_derivatives_are_those_of_the_whole(piece, monkeypatch):
    monkeypatch.setattr(segments, "PIECE", piece)
    args = jnp.float64(0.3), {"b": jnp.float64(0.7)}
    cut = segments.segmented(program, *args)
    assert jax.tree.structure(cut(*args)) == jax.tree.structure(program(*args))

    def total(f):
        return lambda x, y: f(x, y)[0]["a"] + 2 * f(x, y)[1][0]

    def batched(f):
        return jax.vmap(lambda x: f(x, args[1])[1][0])(jnp.arange(3.0))

    for f in (lambda g: g(*args), lambda g: jax.grad(total(g), (0, 1))(*args), batched):
        got, want = jax.jit(lambda f=f: f(cut))(), jax.jit(lambda f=f: f(program))()
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13), got, want)


def test_xla_does_not_put_the_segments_together():
    """What one segment computes is not computed again by the next."""
    x = jnp.ones((64,))

    def chain(x):
        for _ in range(40):
            x = (x * 0.99 + jnp.tanh(x), x - 0.1 * x * x)
            x = x[0] - x[1]
        return x, x * x

    def lines(f):
        text = jax.jit(jax.vmap(f)).lower(x).compile().as_text()
        assert text is not None
        return sum(" tanh(" in line for line in text.splitlines())

    assert lines(segments.segmented(chain, x[0])) <= 40
