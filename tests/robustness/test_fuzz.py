"""Bad values at the public border: an error of ours that names the argument, or an answer that can be trusted.

One argument at a time of every call in :mod:`tests.robustness.border`, and every flag (True or False) that its function
has, is replaced by bad values. What must hold:

* Either a ValueError or TypeError is raised whose text has the argument's name; any other exception is a failure.
* Or the call works. Of a wrong kind (text, an object, None without a default, complex numbers, a fraction for a count,
  a number for a flag, NaN in what a filter or model is built of) it must not. Integers and single precision must give
  what the same values in double precision give; finite values nothing but finite values; NaN and infinity must show in
  the result or in its status; what is built with another shape must run, or say the argument's name when it does.
"""

from __future__ import annotations

import inspect
import re
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from tests.robustness import border

PUBLIC = border.public()

# What is accepted on purpose although it looks wrong.
_SPACE = "any pytree is a space: what is no spec stays as it is"
_MISSING = "a NaN or infinite sample is missing here, as documented"
_IGNORED = "a NaN or infinite sample of a batch is ignored and flagged in the run's status, as in jf.filter under jit"
_UNSTABLE = "an unstable gain has infinite errors"
_ONE_RUN = "of one run the standard error is infinite"
ACCEPTED: dict[tuple[str, str], tuple[str, str]] = {
    ("inputs", "u"): ("complex", "u is what the model functions need"),
    ("mask_nan", "ys"): ("nan", _MISSING),
    ("monte_carlo", "memory_limit"): ("fraction", "bytes may be any number"),
    ("scan_inputs", "u"): ("text object", "any pytree, which jf.filter checks"),
    ("scenario", "mask"): ("text object complex floats", "checked by monte_carlo, which knows the measurement's size"),
    **{(f"tune.{name}", "space"): ("text object none number array", _SPACE)
       for name in ("bounds", "initial", "to_vector", "size", "sample")},
    ("tune.unconstrain", "space"): ("text object number array", _SPACE),
    **{(f"tune.{name}", "ys"): ("nan inf", _IGNORED)
       for name in ("innovation_nll", "prediction_mse", "masked_nll", "rmse", "consistency")},
    **{(f"tune.{name}", "time_limit"): ("inf", "no limit") for name in ("gradient", "genetic", "nsga2")},
    ("metrics.mean", "values"): ("rank", _ONE_RUN),
    ("metrics.root_mean", "squares"): ("rank", _ONE_RUN),
    **{("metrics.predictor_gains", name): ("negative", _UNSTABLE) for name in "FHK"},
    ("simulate.draw_delays", "probabilities"): ("single", "the numbers drawn have the dtype of the probabilities"),
    ("simulate.random_loss", "probability"): ("single", "the numbers drawn have the probability's dtype"),
    **{("gains.is_stable", name): ("nan inf", "no such gain is stable") for name in ("alpha", "beta", "kappa")},
    **{("gains.from_unconstrained", name): ("inf", "the edge of the stable region") for name in "bc"},
    ("fuzzy.infer", "x"): ("nan inf", "NaN fires no rule, which is reported; beyond the universe its end counts"),
    ("simulate.axis_of_quaternion", "q"): ("inf", "recordings have gaps; what is not finite stays so"),
    ("sincos.arctan", "ys"): ("nan inf", _MISSING),
    **{("sincos.calibrated", name): ("nan inf", "such a sample is not trusted") for name in ("mean", "cov")},
    ("sincos.mask_clipped", "ys"): ("nan", _MISSING),
    ("sincos.mask_clipped", "high"): ("inf", "no rail on this side"),
    **{(f"plots.{name}", arg): ("nan", "what is not known leaves a gap in the picture")
       for name, arg in (("track", "truth"), ("track", "measurements"), ("estimate", "truth"),
                         ("estimate", "measurements"), ("errors", "truth"), ("consistency", "values"))},
    ("plots.track", "unit"): ("text none", "any text will do, or none"),
    **{(f"plots.{name}", arg): ("text", "any text will do")
       for name, arg in (("track", "label"), ("estimate", "label"), ("estimate", "unit"),
                         ("consistency", "label"), ("memberships", "unit"), ("monte_carlo", "unit"))},
}  # fmt: skip

# Failures that are known, by function and argument.
_STATE = "a state of no such filter fails inside the filter: to check its structure would cost a trace in every step"
KNOWN = {
    ("scan", "state"): _STATE,
    ("step", "state"): _STATE,
    ("batch", "in_axes"): "is handed to jax.vmap, which refuses it when the function is called",
}

# What compiles for long.
SLOW = {"rts_parallel", "smooth_parallel", "smooth_particles", "filter_parallel", "tune.consistency", "tune.masked_nll"}


def _named(error: BaseException, arg: str) -> bool:
    return isinstance(error, ValueError | TypeError) and re.search(rf"\b{arg}\b", str(error)) is not None


def _call(name, arguments) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # ours: a warning is an answer too
        return PUBLIC[name](**arguments)


def _numbers(result) -> list[np.ndarray]:
    leaves = [
        leaf
        for leaf in jax.tree.leaves(result)
        if isinstance(leaf, bool | float | np.ndarray | np.generic | jax.Array)
        and not (isinstance(leaf, np.ndarray) and leaf.dtype.kind == "O")
    ]
    arrays = [leaf for leaf in leaves if not jnp.issubdtype(jnp.asarray(leaf).dtype, jax.dtypes.prng_key)]
    return [np.asarray(leaf) for leaf in arrays]


def _finite(result) -> bool:
    return all(np.isfinite(a).all() for a in _numbers(result))


def _flagged(result) -> bool:
    status = getattr(result, "status", None)
    return status is not None and bool((np.asarray(status) != 0).any())


def _built(result) -> bool:
    return isinstance(result, jf.Filter | jf.models.LinearGaussian | jf.models.Nonlinear | jf.tune.Spec)


def _same(result, reference) -> bool:
    pairs = list(zip(_numbers(result), _numbers(reference), strict=True))
    return all(a.shape == b.shape and np.allclose(a, b, rtol=2e-5, atol=1e-6, equal_nan=True) for a, b in pairs)


def _verdict(name, arg, kind, bad, valid) -> str | None:
    """What is wrong with the answer to a bad value; None if nothing is."""
    arguments = border.CALLS[name]()
    try:
        result = _call(name, {**arguments, arg: bad})
    except Exception as error:
        return None if _named(error, arg) else f"{type(error).__name__}: {str(error)[:100]}"
    if kind in ("text", "object", "none", "number", "array", "complex", "floats", "fraction"):
        return "is accepted"
    if kind in ("nan", "inf"):
        if isinstance(arguments[arg], int) or _built(result):
            return "is accepted"
        return None if not _finite(result) or _flagged(result) else "is answered with finite numbers"
    if kind in ("integer", "single"):
        reference = (
            valid
            if kind == "single" and valid is not None
            else _call(name, {**arguments, arg: np.asarray(bad, np.float64)})
        )
        return None if _same(result, reference) else "gives other numbers than in double precision"
    if isinstance(result, jf.Filter):
        ys = jnp.zeros((4, 3 if "attitude" in name else 2))
        try:
            jax.eval_shape(lambda f, y: jf.filter(f, y, key=border.KEY), result, ys)
        except Exception as error:
            if not _named(error, arg) and not re.match(r"^\w+: ", str(error)):
                return f"is accepted, and fails when it is run: {type(error).__name__}: {str(error)[:100]}"
        return None
    return None if _finite(result) or not _finite(valid) or _flagged(result) else "is answered with NaN or infinity"


def _arguments(name) -> dict[str, Any]:
    return {**border.flags(PUBLIC[name]), **border.CALLS[name]()}


def _bad_values(name, arg):
    default = inspect.signature(PUBLIC[name]).parameters
    optional = arg in default and default[arg].default is None
    for kind, bad in border.wrong(_arguments(name)[arg]):
        if not (bad is None and optional):
            yield kind, bad


def _failures(name, arg) -> list[str]:
    valid = None
    if not name.startswith(("tune.g", "tune.n", "monte")):
        valid = _call(name, border.CALLS[name]())
    accepted = ACCEPTED.get((name, arg), ("", ""))[0].split()
    found = {kind: _verdict(name, arg, kind, bad, valid) for kind, bad in _bad_values(name, arg)}
    unneeded = [f"{kind}: need not be in ACCEPTED" for kind in accepted if found.get(kind) is None]
    return [f"{arg}, {kind}: {text}" for kind, text in found.items() if text and kind not in accepted] + unneeded


def test_every_public_function_is_called_here_or_exempt_with_a_reason():
    assert set(PUBLIC) == set(border.CALLS) | set(border.EXEMPT)
    assert not set(border.CALLS) & set(border.EXEMPT)
    assert all(border.EXEMPT.values())


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in border.CALLS])
def test_bad_values_are_refused_by_name_or_answered_rightly(name):
    failures = []
    for arg in _arguments(name):
        if (name, arg) not in KNOWN:
            failures += _failures(name, arg)
    assert not failures, "\n".join(failures)


@pytest.mark.parametrize(
    ("name", "arg"),
    [
        pytest.param(name, arg, marks=pytest.mark.xfail(reason=reason, strict=True, raises=AssertionError))
        for (name, arg), reason in KNOWN.items()
    ],
)
def test_known_weaknesses(name, arg):
    assert not _failures(name, arg)


@jax.jit
def _traced(ys, dt, q_scale, r_scale):
    return jf.filter(jf.kalman(border.planar()), ys, dt=dt, q_scale=q_scale, r_scale=r_scale)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
@pytest.mark.parametrize("arg", ["ys", "dt", "q_scale", "r_scale"])
def test_a_traced_bad_value_does_not_raise_and_leaves_no_silent_nan(arg, bad):
    given = {"ys": border.YS, **{name: np.ones(4) for name in ("dt", "q_scale", "r_scale")}}
    given[arg] = given[arg].copy()
    given[arg][1] = bad
    out = _traced(**given)
    finite = np.isfinite(out.mean).all(axis=1) & np.isfinite(out.cov).all(axis=(1, 2)) & np.isfinite(out.log_lik)
    assert (finite | (np.asarray(out.status) != 0)).all()
    if arg in ("ys", "dt") and (arg, bad) not in (("ys", -1.0), ("dt", np.inf)):
        assert out.status[1] != 0
