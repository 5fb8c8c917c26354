"""Optimal linear filters for measurements that arrive late or never, without time stamps; nominal and adaptive."""

from __future__ import annotations

import contextlib
import warnings
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import (
    Filter,
    Info,
    Prediction,
    Static,
    Status,
    aspartial,
    bind,
    check_count,
    flag,
    is_concrete,
    number,
)
from jaxfilt.filters.common import innovate, likelihood
from jaxfilt.filters.kalman import init_mean, input_term
from jaxfilt.linalg import chol, scale_cov, solve_chol, solve_lower, sym
from jaxfilt.models.delays import check_probabilities
from jaxfilt.models.linear import LinearGaussian, check_linear, check_positive, common_dtype, value

# The packets under way are part of the state: X = [x; Z_1; ..; Z_d], where Z_l is what will arrive in l samples as far
# as it has been decided. With rows H_0 = [H, -I at Z_1], .., H_d = [H, 0] and theta_l = 1 if the packet is l late:
#   y = Z_1 + theta_0 (H_0 X + v),    Z_l' = Z_{l+1} + theta_l (H_l X + v),    x' = F x + B u + w.
# All d + 1 lines together have the rows G = [H_0; ..; H_d], and everything random in them is theta (G X + v). Its
# covariance, given the moments q = E[X X'], is Gamma o (G q G') + Pi o (1 1' x R): Hadamard products of covariances,
# with Gamma the covariance of all thetas and Pi = E[theta theta']. So one form serves packets that are lost as a whole
# and channels that are lost one by one, and every covariance below is a congruence: PSD for any gain.


class _Options(NamedTuple):
    second_moment: str  # exact, zero_mean, posterior
    covariance: str = "nominal"  # or inflated
    window: int | None = None  # samples; None = forgetting


class _Adaptation(NamedTuple):
    bounds: Any  # (2,) of the scale
    forgetting: Any  # ()


class _Params(NamedTuple):
    model: LinearGaussian
    probabilities: Any  # (d+2,), (m, d+2), or a function (u, dt)
    options: Static
    adaptation: _Adaptation | None = None


class _Sent(NamedTuple):
    """What the next prediction must know of the packet sent at this step."""

    H: Array  # (m, n)
    R: Array  # (m, m)
    S: Array | None  # (n, m)
    theta: Array  # ((d+1) m,) probability of arriving l late, lags outermost
    same: Array  # ((d+1) m, (d+1) m) E[theta theta']


class _Innovated(NamedTuple):
    """The innovation of this step: its gain for the next prediction is not F times the gain of the update."""

    value: Array  # (m,)
    factor: Array  # (m, m) of its covariance
    scale: Array | None  # () of the measurement part of that, if adapted


class _Memory(NamedTuple):
    """The innovations' power, over a window or with forgetting."""

    power: Array  # (window,) or ()
    weight: Array  # () samples in the window, int32; or the sum of the weights


class DelayedState(NamedTuple):
    """After ``predict``, and still after ``update``, the prediction of X; the update's own results beside it."""

    mean: Array  # (N,) of X given y up to the step before
    cov: Array  # (N, N)
    second: tuple[Array | None, Array] | None  # mean (N,) and covariance (N, N) of X itself
    posterior: tuple[Array, Array]  # (n,), (n, n) of x
    sent: _Sent
    innovated: _Innovated
    memory: _Memory | None = None


def delayed_kalman(model: LinearGaussian, probabilities: Any, *, second_moment: str = "exact") -> Filter:
    """The optimal linear filter for measurements that arrive up to d samples late or never, without time stamps.

    Each packet ``z_k = H x_k + v_k`` draws one delay from ``0..d`` or is lost; ``y_k`` is the newest packet that
    arrives at k, and 0 where none does (see :func:`jaxfilt.simulate.deliver`). The filter is told neither the delay nor
    whether anything has arrived. It knows the probabilities, and is the linear estimator of least mean squared error.

    **If the arrival or the delay is known, use it**: ``jf.kalman`` with a mask of arrivals, or the exact
    ``jf.kalman(jf.models.with_lags(model, d))``, are often 10 to 100 times better in mean square.

    ``y_k = 0`` is a measurement here. A masked sample *means* "nothing arrived" and is read as 0, whatever it holds; it
    sets MISSED, but it is used, ``log_lik`` counts it, and covariances do not depend on the mask. Do not subtract a
    reference from y: an empty sample must be 0. To learn the probabilities give :func:`jaxfilt.tune.innovation_nll` the
    zeros and no mask, or empty samples are left out. Between predictions the gain is not F times that of the update,
    because the same packet decides what arrives now and what is still under way; no cross-covariance is reported.

    ``log_lik`` and ``nis`` are those of a Gaussian innovation: the true one is a mixture, so it is a pseudo-likelihood.
    Covariances are the exact error covariances on average over all delays, and do not depend on the data (except with
    ``second_moment="posterior"``). ``noise_cov`` is the innovation covariance that is not due to the estimate's error.

    Args:
        model: a linear-Gaussian model (F, H, Q, R, B, S may vary with ``(u, dt)``; no D). S is the covariance of v_k
            with the process noise of the interval that begins at k.
        probabilities: (d+2,) of a packet being on time, 1..d samples late, lost; (m, d+2) if each channel is delayed by
            itself; or a function ``(u, dt)`` of what is in force at the step when the packet is sent. Bernoulli
            channels: :func:`jaxfilt.models.delay_probabilities`.
        second_moment: how ``E[x x']`` is had, on which the noise of a random delay depends. ``"exact"``: from m0, P0,
            the inputs and the model. ``"posterior"``: of the prediction, so that no prior mean needs to be right and
            integrating plants are possible; the gains then depend on the data and are not optimal. ``"zero_mean"``: as
            if m0 and all inputs were 0 there, which is wrong by far for large means. It reproduces Table 3 of Nikfetrat
            et al. and serves for nothing else.

    Status: MISSED, NONFINITE, SINGULAR as in :func:`jaxfilt.kalman`.

    Raises:
        ValueError: no probabilities, a shape that does not fit, a model with D, an unknown option.

    Warns:
        UserWarning: F has an eigenvalue of modulus 1 or more (where it is known when the filter is built) and
            ``second_moment="exact"``: the second moment grows without bound, and the filter goes blind.

    Source: Sun 2013, Optimal linear filters for discrete-time systems with randomly delayed and lost measurements
    with/without time stamps, with the equations of the case without; d = 0: Nahi 1969.
    """
    return bind(_params(model, probabilities, second_moment), _init, _predict, _update, _moments)


def adaptive_delayed_kalman(
    model: LinearGaussian,
    probabilities: Any,
    *,
    window: int = 5,
    forgetting: Any = None,
    bounds: tuple[Any, Any] = (1.0, np.inf),
    covariance: str = "nominal",
    second_moment: str = "exact",
) -> Filter:
    """:func:`delayed_kalman` that trusts measurements less while innovations are larger than its model says.

    The part Q_0 of the innovation covariance that is not due to the estimate's error is multiplied by
    ``s = clip((mean |innovation|^2 - tr C P C') / tr Q_0, bounds)``, the mean over the last ``window`` samples, this
    one included.

    With the default bounds it can only become more cautious: it is the nominal filter as long as innovations are not
    larger than expected, and an open-loop predictor for large s. It cannot tell a wrong channel from a wrong motion
    model: with a wrong prior or an unmodeled disturbance it closes its eyes when it should open them. Compare it with
    predicting only; learning the probabilities by the innovation likelihood is the better cure for a wrong channel.

    Info as in :func:`delayed_kalman`, with ``extra["scale"]`` () s. All of it depends on the data, so a batch computes
    covariances for each run. With m > 1 the squares are added up: scale the channels to like units.

    Args:
        model: as in :func:`delayed_kalman`.
        probabilities: likewise.
        window: number of samples; a window of 1 shuts out single large innovations.
        forgetting: instead of the window a factor in [0, 1) of exponential forgetting, tunable by gradient;
            ``(window - 1) / (window + 1)`` has the mean age of a window.
        bounds: smallest and largest s.
        covariance: error covariances for the gain as it is and noise as modeled (``"nominal"``), or with Q_0 multiplied
            by s as in the gain (``"inflated"``).
        second_moment: as in :func:`delayed_kalman`.

    Raises:
        ValueError: as :func:`delayed_kalman`; a window < 1, forgetting outside [0, 1), bounds not in order.

    Source: Nikfetrat, Mahboobi Esfanjani and Azimi 2017, eqs. (22) to (38), corrected.
    """
    check_count("window", window, 1)
    if forgetting is not None and is_concrete(forgetting) and not 0 <= number("forgetting", forgetting) < 1:
        raise ValueError(f"forgetting: expected a value in [0, 1), got {forgetting}")
    if not hasattr(bounds, "__len__") or len(bounds) != 2:
        raise ValueError(f"bounds: expected (smallest, largest), got {bounds}")
    check_positive("bounds", bounds[0])
    if is_concrete(bounds) and not bounds[0] <= bounds[1]:
        raise ValueError(f"bounds: expected smallest <= largest, got {bounds}")
    if covariance not in ("nominal", "inflated"):
        raise ValueError(f'covariance: expected "nominal" or "inflated", got {covariance!r}')
    params = _params(model, probabilities, second_moment)
    options = params.options.value._replace(covariance=covariance, window=window if forgetting is None else None)
    adaptation = _Adaptation(tuple(bounds), forgetting)
    params = params._replace(options=Static(options), adaptation=adaptation)
    return bind(params, _init, _predict, _update, _moments)


def _params(model, probabilities, second_moment):
    if second_moment not in ("exact", "zero_mean", "posterior"):
        raise ValueError(f'second_moment: expected "exact", "zero_mean" or "posterior", got {second_moment!r}')
    check_linear(model)
    if model.D is not None:
        raise ValueError("model: an input of the measurement (D) would make an empty sample differ from 0")
    if callable(probabilities):
        probabilities = aspartial(probabilities)
    else:
        common_dtype({"probabilities": probabilities})
        probabilities = jnp.asarray(probabilities, model.m0.dtype)
        _check_shape(probabilities, None if callable(model.H) else model.H.shape[0])
        check_probabilities("probabilities", probabilities)
    if second_moment == "exact":
        _warn_if_unstable(model.F)
    return _Params(model, probabilities, Static(_Options(second_moment)))


def _warn_if_unstable(F):
    if callable(F):
        with contextlib.suppress(Exception):  # motion models have an interval of their own; others need u
            F = F(None, None)
    if callable(F) or not is_concrete(F):
        return
    radius = float(np.abs(np.linalg.eigvals(np.asarray(F, np.float64))).max())
    if radius >= 1 - 1e-6:
        warnings.warn(
            f"F: has an eigenvalue of modulus {radius:.6g}, so the second moment of the state grows without bound and "
            "the filter goes blind; use a filter that knows the arrivals, or second_moment='posterior'",
            stacklevel=4,
        )


def _check_shape(p, m):
    if p.ndim not in (1, 2) or (p.ndim == 2 and m is not None and p.shape[0] != m):
        raise ValueError(f"probabilities: expected shape (d+2,) or ({'m' if m is None else m}, d+2), got {p.shape}")


def _sent(p, inp):
    """The packet of this step, and the moments of its delays."""
    model = p.model
    H = value(model.H, inp.u, inp.dt)
    R = scale_cov(value(model.R, inp.u, inp.dt), inp.r_scale)
    S = None if model.S is None else value(model.S, inp.u, inp.dt)
    given = p.probabilities
    probabilities = jnp.asarray(given(inp.u, inp.dt) if callable(given) else given, H.dtype)
    m = H.shape[0]
    _check_shape(probabilities, m)
    arrive = probabilities[..., :-1]
    lags = arrive.shape[-1]
    if probabilities.ndim == 1:  # one draw for all channels
        theta = jnp.repeat(arrive, m)
        together = np.kron(np.eye(lags, dtype=bool), np.ones((m, m), bool))
        same = jnp.where(together, theta[:, None], jnp.zeros((), H.dtype))
    else:  # one draw for each channel
        theta = arrive.T.reshape(-1)
        channel = np.tile(np.eye(m, dtype=bool), (lags, lags))
        alone = jnp.where(np.eye(lags * m, dtype=bool), theta[:, None], jnp.zeros((), H.dtype))
        same = jnp.where(channel, alone, theta[:, None] * theta[None, :])
    return _Sent(H, R, S, theta, same)


def _rows(sent):
    """G ((d+1) m, N): H_l = [H, -I at Z_{l+1}] for l < d, H_d = [H, 0]."""
    size, m = sent.theta.shape[0], sent.H.shape[0]
    H = jnp.tile(sent.H, (size // m, 1))
    return jnp.concatenate([H, -jnp.eye(size, size - m, dtype=H.dtype)], axis=1)


def _measured(sent, G):
    """The mean measurement matrix C (m, N) of ``y = Z_1 + theta_0 H_0 X``."""
    m, n = sent.H.shape
    newest = jnp.pad(jnp.eye(m, G.shape[1] - n, dtype=G.dtype), ((0, 0), (n, 0)))
    return newest + sent.theta[:m, None] * G[:m]


def _noise(sent, G, mean, cov):
    """Covariance ((d+1) m,) squared of all that delays make random, for the moments of X; mean None = 0."""
    spread = G @ cov @ G.T
    if mean is not None:
        level = G @ mean
        spread = spread + level[:, None] * level[None, :]
    times = sent.theta.shape[0] // sent.R.shape[0]
    chance = sent.same - sent.theta[:, None] * sent.theta[None, :]
    return chance * spread + sent.same * jnp.tile(sent.R, (times, times))


def _second(p, state):
    """Mean and covariance of X itself, as the option has them."""
    return (state.mean, state.cov) if state.second is None else state.second


def _init(p, inp):
    m0 = init_mean(p.model, inp)
    options = p.options.value
    sent = _sent(p, inp)
    # Nothing is under way, and no packet precedes the first sample: a packet of zero length, as it were.
    extra = sent.theta.shape[0] - sent.H.shape[0]
    m, dtype = sent.H.shape[0], m0.dtype
    mean, cov = jnp.pad(m0, (0, extra)), jnp.pad(p.model.P0, (0, extra))
    nothing = sent._replace(
        H=jnp.zeros_like(sent.H), R=jnp.zeros_like(sent.R), S=None if sent.S is None else jnp.zeros_like(sent.S)
    )
    second = None
    if options.second_moment != "posterior":
        second = (None if options.second_moment == "zero_mean" else mean, cov)
    zero = jnp.zeros((), dtype)
    scale = memory = None
    if p.adaptation is not None:
        scale = jnp.ones((), dtype)
        memory = _Memory(zero, zero)
        if options.window is not None:
            memory = _Memory(jnp.zeros((options.window,), dtype), jnp.int32(0))
    innovated = _Innovated(jnp.zeros((m,), dtype), jnp.zeros((m, m), dtype), scale)
    return DelayedState(mean, cov, second, (m0, p.model.P0), nothing, innovated, memory)


def _predict(p, state, inp):
    F = value(p.model.F, inp.u, inp.dt)
    Q = scale_cov(value(p.model.Q, inp.u, inp.dt), inp.q_scale)
    sent, innovated = state.sent, state.innovated
    m, n = sent.H.shape
    N = state.mean.shape[0]
    G = _rows(sent)
    C = _measured(sent, G)
    shifted = jnp.pad(jnp.eye(N - n, N - n, m, dtype=G.dtype), ((0, 0), (n, 0)))
    A = jnp.concatenate([jnp.pad(F, ((0, 0), (0, N - n))), shifted + sent.theta[m:, None] * G[m:]])

    # Noise of [x; y; Z_1; ..; Z_d], then apart for the measurement and for X.
    second_mean, second_cov = _second(p, state)
    random = _noise(sent, G, second_mean, second_cov)
    with_state = jnp.zeros((n, random.shape[0]), Q.dtype)
    if sent.S is not None:
        with_state = jnp.tile(sent.S, (1, random.shape[0] // m)) * sent.theta[None, :]
    W = jnp.block([[Q, with_state], [with_state.T, random]])
    X = np.delete(np.arange(N + m), np.arange(n, n + m))
    W_X, W_Xy, W_y = W[X[:, None], X[None, :]], W[X, n : n + m], W[n : n + m, n : n + m]

    gain = solve_chol(innovated.factor, (A @ state.cov @ C.T + W_Xy).T).T
    rest = A - gain @ C
    identity = jnp.eye(N, dtype=A.dtype)
    T = jnp.concatenate([identity[:, :n], -gain, identity[:, n:]], axis=1)
    cov = rest @ state.cov @ rest.T + T @ W @ T.T
    if innovated.scale is not None and p.options.value.covariance == "inflated":
        cov = cov + (innovated.scale - 1) * (gain @ W_y @ gain.T)
    mean = A @ state.mean + gain @ innovated.value
    shift = input_term(p.model.B, inp)
    second = None
    if state.second is not None:
        if second_mean is not None:
            second_mean = A @ second_mean
            second_mean = second_mean if shift is None else second_mean.at[:n].add(shift)
        second = second_mean, sym(A @ second_cov @ A.T + W_X)
    mean = mean if shift is None else mean.at[:n].add(shift)
    cov = sym(cov)
    state = state._replace(mean=mean, cov=cov, second=second, posterior=(mean[:n], cov[:n, :n]))
    return state, Prediction(mean[:n], cov[:n, :n])


def _update(p, state, inp):
    sent = _sent(p, inp)
    m, n = sent.H.shape
    G = _rows(sent)
    C = _measured(sent, G)
    missed = flag(jnp.zeros((), bool), Status.MISSED)
    if inp.mask is not None:
        missed = flag(~inp.mask.any(), Status.MISSED)
        inp = inp._replace(y=jnp.where(inp.mask, inp.y, jnp.zeros((), inp.y.dtype)), mask=None)
    nu, _, status = innovate(inp, C @ state.mean)
    known = sym(C @ state.cov @ C.T)
    second_mean, second_cov = _second(p, state)
    noise = _noise(sent._replace(theta=sent.theta[:m], same=sent.same[:m, :m]), G[:m], second_mean, second_cov)
    scale, memory, extra = None, state.memory, {}
    honest = noise
    if p.adaptation is not None:
        memory, power = _power(p, memory, nu, (status & int(Status.NONFINITE)) == 0)
        scale = _scale(p, power - jnp.trace(known), jnp.trace(noise))
        noise = scale * noise
        extra = {"scale": scale}
        honest = noise if p.options.value.covariance == "inflated" else honest
    S = sym(known + noise)
    L = chol(S)
    nis, log_lik, singular = likelihood(None, L, solve_lower(L, nu))
    K = solve_chol(L, C @ state.cov).T
    rest = jnp.eye(len(state.mean), dtype=S.dtype) - K @ C
    cov = sym(rest @ state.cov @ rest.T + K @ honest @ K.T)[:n, :n]
    mean = (state.mean + K @ nu)[:n]
    info = Info(mean, cov, nu, S, nis, log_lik, status | missed | singular, noise_cov=sym(noise), extra=extra)
    innovated = _Innovated(nu, L, scale)
    return state._replace(posterior=(mean, cov), sent=sent, innovated=innovated, memory=memory), info


def _power(p, memory, nu, usable):
    """The memory with this innovation, and the innovations' mean square."""
    square = jnp.sum(nu * nu)
    window = p.options.value.window
    if window is None:
        keep = jnp.asarray(p.adaptation.forgetting, square.dtype)
        new = _Memory(keep * memory.power + (1 - keep) * square, keep * memory.weight + (1 - keep))
    else:
        power = jnp.concatenate([memory.power[1:], square[None]])
        new = _Memory(power, jnp.minimum(memory.weight + jnp.int32(1), jnp.int32(window)))
    new = _Memory(*(jnp.where(usable, a, b) for a, b in zip(new, memory, strict=True)))
    some = new.weight > 0
    weight = jnp.where(some, new.weight, jnp.ones_like(new.weight)).astype(square.dtype)
    return new, jnp.sum(new.power) / weight


def _scale(p, excess, expected):
    """s, with 1 where nothing of the innovation is random."""
    low, high = (jnp.asarray(bound, excess.dtype) for bound in p.adaptation.bounds)
    random = expected > 0
    one = jnp.ones((), excess.dtype)
    return jnp.clip(jnp.where(random, excess / jnp.where(random, expected, one), one), low, high)


def _moments(p, state):
    del p
    return state.posterior
