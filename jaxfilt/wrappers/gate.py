"""Refusing improbable measurements, and choosing one of several detections."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import Filter, Info, PyTree, Status, Wrapped, flag, is_concrete, present, wrap
from jaxfilt.models.linear import check_positive, common_dtype


class _Params(NamedTuple):
    inner: Filter
    p_false: Any  # ()


def gated(filt: Filter, p_false: Any = 1e-3) -> Filter:
    """Refuses a sample whose innovation is too improbable: an outlier is treated as missed.

    A sample passes if ``P(chi2_n >= NIS) >= p_false``, n the number of its present components; a partly present sample
    is thus judged by the components it has, and all of them pass or none. The gate is chi-square whatever the filter:
    for nonlinear filters it is as good as their S.

    Info: innovation and ``nis`` are those of the sample as it came, refused or not. ``log_lik`` is that of what the
    filter was given: a refused sample counts as missed and adds exactly 0. (It is no likelihood of the gate itself, so
    do not tune ``p_false`` by it: refusing everything would look best.)

    Status: GATED where a sample was refused, with MISSED from the filter inside.

    Put it outside of wrappers that fill gaps or learn from data, so that these see a refused sample as missed. A filter
    that has lost its target refuses everything from then on, with a growing S that ends it sooner or later: watch for
    a row of GATED. Even with the right model refusals come in rows, because the error of prediction that made one
    sample improbable is not corrected: at p_false = 0.02, 3 % of the samples of a constant-velocity run were refused.

    Args:
        filt: the filter; must report nis.
        p_false: probability of refusing a sample although the model is right and none was refused before it, in (0, 1).
            May be traced; the decision is hard, so no gradient flows to it.

    Raises:
        ValueError: p_false out of range; at trace time, a filter without nis.

    Source: Bar-Shalom, Li and Kirubarajan 2001, section 5.4.
    """
    _check_probability(p_false)
    return wrap(_Params(filt, p_false), update=_gated_update)


def nearest_neighbor(filt: Filter, p_false: Any = 1e-3) -> Filter:
    """Takes the detection with the smallest NIS of each scan, if it is within the gate; else the scan counts as missed.

    Detections arrive in ``u``, at most D per scan, made into the arguments of :func:`jaxfilt.filter` by
    :func:`scan_inputs`::

        detections = np.zeros((T, D, 2)); valid = np.zeros((T, D), bool)     # fill in what each scan has
        out = jf.filter(jf.nearest_neighbor(jf.kalman(model)), **jf.scan_inputs(detections, valid))
        out.extra["choice"]                                                  # (T,) index of the detection, or -1

    ``inp.u`` is a dict of ``"detections"`` (D, m), ``"valid"`` (D,) bool, and optionally ``"u"``, which is all that the
    filter inside sees as its own u. ``inp.y`` is a placeholder and its values do not matter; ``inp.mask``, if given,
    says which components this scan measures (all False: no scan). With D = 1 this is :func:`gated`.

    Info is the inner filter's with the chosen detection for y; the innovation is exactly 0 where none was chosen.
    ``log_lik`` takes the choice for the target's own echo: neither the other detections nor a probability of detection
    enter it, and a missed scan adds 0. ``extra``: ``"choice"`` () int32, -1 for none, and ``"detections_in_gate"`` ()
    int32; with more than one in the gate the choice may be wrong, and the covariance does not know it.

    Status: GATED where there were detections, but none in the gate; NONFINITE where a valid detection has a NaN or
    infinite component (it is not chosen); MISSED from the filter inside where none was chosen.

    Args:
        filt: the filter; must report nis.
        p_false: probability that the gate refuses the target's own detection, in (0, 1). May be traced.

    Raises:
        ValueError: p_false out of range; at trace time, a filter without nis, or u without detections of shape (D, m).

    Source: Bar-Shalom, Li and Kirubarajan 2001, section 1.5 (data association) and 5.4 (the gate).
    """
    _check_probability(p_false)
    return wrap(_Params(filt, p_false), init=_nearest_init, predict=_nearest_predict, update=_nearest_update)


def scan_inputs(detections: Any, valid: Any = None, *, u: PyTree = None) -> dict[str, Any]:
    """Scans of detections as the arguments ``ys`` and ``u`` of :func:`jaxfilt.filter`.

    Args:
        detections: (T, D, m) float, at most D in each of T scans; the unused may hold anything.
        valid: (T, D) bool, which ones there are; None = all.
        u: pytree with leading T for the filter inside.

    Returns:
        ``{"ys": zeros (T, m), "u": {"detections", "valid"(, "u")}}``.

    Raises:
        ValueError: wrong shapes, or (concrete arrays) a valid detection that is not finite.
        TypeError: integer detections, or ``valid`` that is not bool.
    """
    common_dtype({"detections": detections})
    detections = jnp.asarray(detections)
    if detections.ndim != 3:
        raise ValueError(f"detections: expected shape (T, D, m), got {detections.shape}")
    T, D, m = detections.shape
    if D == 0:
        raise ValueError("detections: expected room for at least one detection per scan")
    valid = jnp.ones((T, D), bool) if valid is None else jnp.asarray(valid)
    if valid.dtype != bool:
        raise TypeError(f"valid: expected bool, got {valid.dtype}")
    if valid.shape != (T, D):
        raise ValueError(f"valid: expected shape ({T}, {D}), got {valid.shape}")
    if is_concrete((detections, valid)):
        bad = np.asarray(valid) & ~np.isfinite(np.asarray(detections)).all(axis=-1)
        if bad.any():
            k, i = (int(index) for index in np.argwhere(bad)[0])
            raise ValueError(f"detections: detections[{k}, {i}] is valid but not finite; set valid to False there")
    extra = {} if u is None else {"u": u}
    return {
        "ys": jnp.zeros((T, m), detections.dtype),
        "u": {"detections": detections, "valid": valid, **extra},
    }


def _check_probability(p_false):
    check_positive("p_false", p_false, scalar=True)
    if is_concrete(p_false) and not (np.asarray(p_false) < 1).all():
        raise ValueError(f"p_false: expected a value in (0, 1), got {p_false}")


def _passes(info: Info, count: Array, p_false: Any) -> Array:
    """Whether a sample (or each of several) with ``count`` usable components is within the gate."""
    if info.nis is None:
        raise ValueError("filt: a gate needs a filter that reports nis")
    nis = jax.lax.stop_gradient(info.nis)
    p_false = jax.lax.stop_gradient(jnp.asarray(p_false, nis.dtype))
    half = 0.5 * jnp.maximum(count, 1).astype(nis.dtype)
    return (count == 0) | (jax.scipy.special.gammaincc(half, 0.5 * nis) >= p_false)


def _gated_update(p, s, inp):
    _, dry = p.inner.update(s.inner, inp)
    mask = present(inp)
    ok = _passes(dry, (mask & jnp.isfinite(inp.y)).sum(), p.p_false)
    inner, info = p.inner.update(s.inner, inp._replace(mask=mask & ok))
    status = info.status | flag(~ok, Status.GATED) | (dry.status & int(Status.NONFINITE))
    return s._replace(inner=inner), info._replace(innovation=dry.innovation, nis=dry.nis, status=status)


def _own(inp):
    """The input as the filter inside sees it."""
    if not (isinstance(inp.u, dict) and {"detections", "valid"} <= inp.u.keys()):
        raise ValueError("u: nearest_neighbor needs a dict with detections and valid; see jf.scan_inputs")
    m, shape = inp.y.shape[0], jnp.shape(inp.u["detections"])
    if len(shape) != 2 or shape[1] != m or jnp.shape(inp.u["valid"]) != shape[:1]:
        raise ValueError(
            f"u: expected detections (D, {m}) and valid (D,) per scan, got {shape} and {jnp.shape(inp.u['valid'])}"
        )
    return inp._replace(u=inp.u.get("u"), y=jnp.zeros_like(inp.y))


def _nearest_init(p, inp):
    return Wrapped(p.inner.init(_own(inp)))


def _nearest_predict(p, s, inp):
    inner, prediction = p.inner.predict(s.inner, _own(inp))
    return s._replace(inner=inner), prediction


def _nearest_update(p, s, inp):
    own = _own(inp)
    mask = present(inp)
    measured = mask.any()
    detections, valid = inp.u["detections"], inp.u["valid"] & measured
    finite = (jnp.isfinite(detections) | ~mask[None, :]).all(axis=1)
    candidates = jnp.where((valid & finite)[:, None] & mask[None, :], detections, jnp.zeros((), detections.dtype))

    def dry(y):
        return p.inner.update(s.inner, own._replace(y=y, mask=mask))[1]._replace(extra={})

    infos = jax.vmap(dry)(candidates)
    inside = valid & finite & _passes(infos, mask.sum(), p.p_false)
    distances = jnp.where(inside, jax.lax.stop_gradient(infos.nis), jnp.inf)
    nearest = jnp.argmin(distances)
    found = inside.any()
    inner, info = p.inner.update(s.inner, own._replace(y=candidates[nearest], mask=mask & found))
    status = flag((valid & finite).any() & ~found, Status.GATED) | flag((valid & ~finite).any(), Status.NONFINITE)
    extra = {
        "choice": jnp.where(found, nearest.astype(jnp.int32), jnp.int32(-1)),
        "detections_in_gate": inside.sum().astype(jnp.int32),
    }
    return s._replace(inner=inner), info._replace(status=info.status | status, extra={**info.extra, **extra})
