"""The variable-dimension filter: constant velocity while the target is quiet, constant acceleration in a maneuver."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt import maneuver
from jaxfilt.chi2 import chi2_quantile
from jaxfilt.core import Filter, Prediction, Static, StepInput, bind, is_concrete, present
from jaxfilt.filters.kalman import KalmanState, kalman, measurement
from jaxfilt.models.linear import LinearGaussian, check_linear, common_dtype, value
from jaxfilt.wrappers.adaptive import select
from jaxfilt.wrappers.common import check_count


class History(NamedTuple):
    """The last s inputs and s + 1 posteriors, the newest first."""

    means: Array  # (s + 1, 2d)
    covs: Array  # (s + 1, 2d, 2d)
    inputs: StepInput  # leading s
    elapsed: Array  # (s,) interval before each sample
    valid: Array  # (s,) bool, false before the first sample


class VariableDimensionState(NamedTuple):
    """Moments of ``[p, v, a]``; while quiet the acceleration is 0 with variance 0."""

    mean: Array  # (3d,)
    cov: Array  # (3d, 3d)
    maneuvering: Array  # () bool
    detector: maneuver.Memory
    significances: Array  # (s,) of the acceleration at the last samples, the newest first
    count: Array  # () int32, samples since the maneuver was noticed, at most s
    elapsed: Array  # () time predicted since the last posterior
    history: History


class _Options(NamedTuple):
    detector: maneuver.Detector
    lookback: int
    end_probability: float


class _Params(NamedTuple):
    cv: LinearGaussian
    ca: LinearGaussian
    options: Static


def variable_dimension(
    model_cv: LinearGaussian,
    model_ca: LinearGaussian,
    *,
    statistic: str = "fading",
    p_false: float = 1e-3,
    forgetting: float = 0.8,
    window: int = 5,
    lookback: int = 5,
    end_probability: float = 0.95,
) -> Filter:
    """A Kalman filter that takes on an acceleration when the innovations say that the target maneuvers.

    While quiet it is ``kalman(model_cv)``, watched by a detector (:func:`jaxfilt.maneuver.detector`). On an alarm at
    sample k the maneuver is taken to have begun at l = k - ``lookback``: a constant-acceleration estimate starts at
    sample l from the posterior of l - 1 (:func:`jaxfilt.maneuver.restart`) and the samples l + 1 ... k are filtered
    once more, with ``model_ca``. If sample l is missing, it starts at the first whole one after it. The maneuver is
    over when the acceleration's significance ``a' P_aa^-1 a``, summed over the last ``lookback`` samples, is below its
    chi-square quantile; then constant velocity goes on from the position and velocity block, with the detector cleared.
    (These terms are correlated: ``end_probability`` is a design value, not a test level.)

    The restart is computed in every step, at the cost of ``lookback`` further updates; a batch has covariances per run.
    The switch is a hard decision: gradients go through the branch taken.

    State and Info hold ``[positions, velocities, accelerations]``; while quiet the acceleration is 0 and its variance
    0. Innovation, S, NIS and ``log_lik`` are those of the model in force when the sample came. ``extra``:
    ``"statistic"`` (), held during a maneuver, ``"alarm"`` () bool, and ``"maneuvering"`` () bool, after the step. A
    posterior that was filtered anew has no cross-covariance with the one before: no smoothing.

    Args:
        model_cv: from :func:`jaxfilt.models.constant_velocity`. Its m0, P0 begin the run.
        model_ca: from :func:`jaxfilt.models.constant_acceleration`, of as many axes. Its m0, P0 are not used.
        statistic: of the detector.
        p_false: of the detector, false alarms per sample. Static, as are all options.
        forgetting: of the detector.
        window: of the detector.
        lookback: s, in samples; about the detector's memory ``1 / (1 - forgetting)``, or its window.
        end_probability: of the chi-square quantile in the end test; larger ends maneuvers earlier.

    Raises:
        ValueError: models of other shapes than 2d, 3d and H = [I 0], or with inputs or correlated noise; options out of
            range.
        TypeError: models of different dtypes, or traced options.

    Source: Bar-Shalom and Birmiwal 1982; Bar-Shalom, Li and Kirubarajan 2001, section 11.4; thesis on lost targets,
    (3-22).
    """
    detector = maneuver.detector(statistic, p_false=p_false, forgetting=forgetting, window=window)
    check_count("lookback", lookback, 1)
    end_probability = maneuver.static_number("end_probability", end_probability)
    if not 0 < end_probability < 1:
        raise ValueError(f"end_probability: expected a value in (0, 1), got {end_probability}")
    check_linear(model_cv, "model_cv")
    check_linear(model_ca, "model_ca")
    common_dtype({"model_cv": model_cv.m0, "model_ca": model_ca.m0})
    d = model_cv.m0.shape[0] // 2
    for name, model, order in (("model_cv", model_cv, 2), ("model_ca", model_ca, 3)):
        _check_motion(name, model, d, order)
    options = _Options(detector, lookback, end_probability)
    return bind(_Params(model_cv, model_ca, Static(options)), _init, _predict, _update, _moments)


def _check_motion(name, model, d, order):
    if model.m0.shape != (order * d,):
        raise ValueError(f"{name}: expected {order} d states for d = {d} axes, got {model.m0.shape[0]}")
    if any(x is not None for x in (model.B, model.D, model.S)):
        raise ValueError(f"{name}: expected a motion model, without input and without correlated noise")
    if callable(model.H) or model.H.shape != (d, order * d):
        raise ValueError(f"{name}: expected H = [I 0] of shape ({d}, {order * d})")
    if is_concrete(model.H) and not (np.asarray(model.H) == np.eye(d, order * d)).all():
        raise ValueError(f"{name}: expected H = [I 0], got {np.asarray(model.H).tolist()}")


def _axes(p):
    return p.cv.m0.shape[0] // 2


def _quiet(mean, cov, d):
    """The moments with the acceleration taken out, from those of (2d,) or (3d,)."""
    n = 2 * d
    return (
        jnp.zeros((3 * d,), mean.dtype).at[:n].set(mean[:n]),
        jnp.zeros((3 * d, 3 * d), cov.dtype).at[:n, :n].set(cov[:n, :n]),
    )


def _narrow(inp, d):
    """The input for the smaller model: a q_scale per state is cut."""
    scale = inp.q_scale
    return inp if scale is None or scale.ndim == 0 else inp._replace(q_scale=scale[: 2 * d])


def _init(p, inp):
    first = kalman(p.cv).init(inp)
    d, options = _axes(p), p.options.value
    s = options.lookback

    def repeat(x, count):
        return jnp.broadcast_to(x[None], (count, *x.shape))

    blank = inp._replace(y=jnp.zeros_like(inp.y), key=None)
    blank = blank if blank.dt is None else blank._replace(dt=jnp.zeros_like(blank.dt))
    zeros = jnp.zeros((s,), first.mean.dtype)
    history = History(
        repeat(first.mean, s + 1),
        repeat(first.cov, s + 1),
        jax.tree.map(lambda x: repeat(x, s), blank),
        zeros,
        jnp.zeros((s,), bool),
    )
    mean, cov = _quiet(first.mean, first.cov, d)
    false, count = jnp.zeros((), bool), jnp.zeros((), jnp.int32)
    memory = maneuver.start(options.detector, inp.y)
    return VariableDimensionState(mean, cov, false, memory, zeros, count, zeros[0], history)


def _predict(p, s, inp):
    d = _axes(p)
    narrow = _narrow(inp, d)
    cv, _ = kalman(p.cv).predict(KalmanState(*_block(s, d)), narrow)
    ca, _ = kalman(p.ca).predict(KalmanState(s.mean, s.cov), inp)
    mean, cov = select(s.maneuvering, (ca.mean, ca.cov), _quiet(cv.mean, cv.cov, d))
    elapsed = s.elapsed + _interval(p, inp)
    return s._replace(mean=mean, cov=cov, elapsed=elapsed), Prediction(mean, cov)


def _interval(p, inp):
    return value(p.cv.F, inp.u, inp.dt)[0, _axes(p)]


def _update(p, s, inp):
    d, options = _axes(p), p.options.value
    usable = present(inp) & jnp.isfinite(inp.y)
    cv, cv_info = kalman(p.cv).update(KalmanState(*_block(s, d)), inp)
    ca, ca_info = kalman(p.ca).update(KalmanState(s.mean, s.cov), inp)
    history = _push_input(s, inp)

    memory = maneuver.advance(options.detector, s.detector, cv_info, usable)
    memory = select(s.maneuvering, s.detector, memory)
    statistic, alarm = maneuver.evaluate(options.detector, memory, d)
    alarm = alarm & ~s.maneuvering
    anew, started = _refilter(p, history)
    begins = alarm & started
    significances, count, over = _end_test(options, s, ca, usable, d)
    ends = s.maneuvering & over
    maneuvering = begins | (s.maneuvering & ~ends)

    mean, cov = select(ends, _block(ca, d), (cv.mean, cv.cov))
    mean, cov = select(maneuvering, select(begins, anew, (ca.mean, ca.cov)), _quiet(mean, cov, d))
    state = VariableDimensionState(
        mean,
        cov,
        maneuvering,
        select(ends, maneuver.start(options.detector, inp.y), memory),
        significances,
        count,
        jnp.zeros_like(s.elapsed),
        _kept(history, mean[: 2 * d], cov[: 2 * d, : 2 * d]),
    )
    info = select(s.maneuvering, ca_info._replace(mean=mean, cov=cov), cv_info._replace(mean=mean, cov=cov))
    return state, info._replace(extra={"statistic": statistic, "alarm": alarm, "maneuvering": maneuvering})


def _block(state, d):
    return state.mean[: 2 * d], state.cov[: 2 * d, : 2 * d]


def _push_input(s, inp):
    """The history with this step's input at the front: one entry more than is kept."""
    old = s.history

    def push(x, xs):
        return jnp.concatenate([x[None], xs])

    inputs = jax.tree.map(push, inp._replace(key=None), old.inputs)
    return old._replace(inputs=inputs, elapsed=push(s.elapsed, old.elapsed), valid=push(jnp.ones((), bool), old.valid))


def _kept(history, mean, cov):
    """The history of :func:`_push_input` with its oldest input dropped, and the posterior at the front."""
    inputs, elapsed, valid = jax.tree.map(lambda x: x[:-1], (history.inputs, history.elapsed, history.valid))
    means = jnp.concatenate([mean[None], history.means[:-1]])
    return History(means, jnp.concatenate([cov[None], history.covs[:-1]]), inputs, elapsed, valid)


def _refilter(p, history):
    """``((mean, cov), started)``: the constant-acceleration posterior from the oldest input in the history on."""
    mean0, cov0 = history.means[-1], history.covs[-1]
    quiet_mean, quiet_cov = _quiet(mean0, cov0, _axes(p))
    filt = kalman(p.ca)

    def body(carry, entry):
        started, T, mean, cov = carry
        inp, elapsed, valid = entry
        T = T + elapsed
        possible = valid & present(inp).all() & jnp.isfinite(inp.y).all() & (T > 0)
        start = possible & ~started
        y = jnp.where(possible, inp.y, jnp.zeros_like(inp.y))
        _, R, _ = measurement(p.ca, inp, mean)
        first = maneuver.restart(mean0, cov0, y, R, jnp.where(T > 0, T, jnp.ones_like(T)))
        predicted, _ = filt.predict(KalmanState(mean, cov), inp)
        after, _ = filt.update(predicted, inp)
        mean, cov = select(start, first, select(started, (after.mean, after.cov), (mean, cov)))
        return (started | start, T, mean, cov), None

    begin = (jnp.zeros((), bool), jnp.zeros_like(history.elapsed[0]), quiet_mean, quiet_cov)
    entries = jax.tree.map(lambda x: x[::-1], (history.inputs, history.elapsed, history.valid))
    (started, _, mean, cov), _ = jax.lax.scan(body, begin, entries)
    return (mean, cov), started


def _end_test(options, s, ca, usable, d):
    """``(significances, count, over)`` with this sample's acceleration; a missed sample changes nothing."""
    size = options.lookback
    mean, cov = jax.lax.stop_gradient((ca.mean, ca.cov))
    delta = maneuver.significance(mean, cov, d)
    pushed = jnp.concatenate([delta[None], s.significances[:-1]])
    counts = s.maneuvering & usable.any()
    significances = jnp.where(counts, pushed, s.significances)
    count = jnp.where(s.maneuvering, jnp.minimum(s.count + counts.astype(jnp.int32), size), 0)
    limit = chi2_quantile(options.end_probability, d * size)
    return significances, count, counts & (count >= size) & (significances.sum() < limit)


def _moments(p, s):
    del p
    return s.mean, s.cov
