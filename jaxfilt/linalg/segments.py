"""A program of many scalar operations in segments, each of which XLA compiles apart.

XLA for CPUs puts what an output needs into one kernel, and into the next output's kernel again: of a few hundred scalar
operations that depend on each other it computes each about ten times. A call that it must not inline ends that.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend import core

PyTree = Any

# Operations from which a program is cut, and in how long pieces at most. Measured, likelihood, whole against pieces of
# 100: a step of 90 operations runs as fast either way, of 150 1.4 times, of 180 2, of 750 (EKF) 5, of 1300 (IMM) 6
# times as fast; gradients 1.6 to 2.3 times. Pieces of 40 to 200 hardly differ.
MANY, PIECE = 120, 100


def segmented(function: Callable[..., PyTree], *args: PyTree) -> Callable[..., PyTree]:
    """The function, which takes arguments as these, in pieces of :data:`PIECE` operations."""
    closed, spec = jax.make_jaxpr(function, return_shape=True)(*args)
    jaxpr, tree = closed.jaxpr, jax.tree.structure(spec)
    wanted = _variables(jaxpr.outvars)
    kept = []
    for eqn in jaxpr.eqns[::-1]:
        if not wanted.isdisjoint(eqn.outvars):
            kept.append(eqn)
            wanted |= _variables(eqn.invars)
    kept = kept[::-1]
    length = math.ceil(len(kept) / math.ceil(len(kept) / PIECE))
    pieces = [kept[i : i + length] for i in range(0, len(kept), length)]
    parts = []
    later = _variables(jaxpr.outvars)
    for eqns in pieces[::-1]:
        made = dict.fromkeys(v for eqn in eqns for v in eqn.outvars)
        needed = dict.fromkeys(v for eqn in eqns for v in eqn.invars if not hasattr(v, "val") and v not in made)
        outs = [v for v in made if v in later]
        later |= set(needed)
        names = {"arg_names": ("",) * len(needed), "result_paths": ("",) * len(outs)}
        part = core.Jaxpr((), list(needed), outs, eqns, debug_info=jaxpr.debug_info._replace(**names))
        parts.append((list(needed), outs, jax.jit(core.jaxpr_as_fun(core.ClosedJaxpr(part, ())))))
    parts = parts[::-1]

    def run(*args):
        values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*closed.consts, *jax.tree.leaves(args)], strict=True))
        for needed, outs, part in parts:
            with set_xla_metadata(inlineable="false"):
                values.update(zip(outs, part(*(values[v] for v in needed)), strict=True))
        return jax.tree.unflatten(tree, [v.val if hasattr(v, "val") else values[v] for v in jaxpr.outvars])

    return run


def _variables(atoms):
    return {v for v in atoms if not hasattr(v, "val")}
