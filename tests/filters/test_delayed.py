"""The filters for delayed and lost measurements against enumeration of all delays, their limits and their promises.

The enumeration knows nothing of the filters' recursions: it has the joint moments of all states and packets, and
averages over every way in which the packets may be delayed.
"""

from __future__ import annotations

import itertools
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxfilt as jf
from jaxfilt import tune

STEPS = {0: 8, 1: 7, 2: 5, 3: 4}  # by d, as many as can be enumerated


class System(NamedTuple):
    """A random time-varying plant with correlated noise and known input, from x_0 ~ N(m0, P0)."""

    F: np.ndarray  # (K, n, n), from k to k+1
    b: np.ndarray  # (K, n) the input term
    Q: np.ndarray
    S: np.ndarray
    H: np.ndarray
    R: np.ndarray
    m0: np.ndarray
    P0: np.ndarray


def system(m: int, K: int, n: int = 2, seed: int = 0) -> System:
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(n + m, n + m + 1))
    joint = noise @ noise.T / (n + m)
    P0 = rng.normal(size=(n, n + 1))
    return System(
        F=0.6 * rng.normal(size=(K, n, n)), b=rng.normal(size=(K, n)), Q=joint[:n, :n], S=joint[:n, n:],
        H=rng.normal(size=(m, n)), R=joint[n:, n:], m0=rng.normal(size=n), P0=P0 @ P0.T,
    )  # fmt: skip


def _transition(u, dt):
    del dt
    return u["F"]


def _shift(u, dt):
    del dt
    return u["b"]


def model(s: System) -> jf.models.LinearGaussian:
    return jf.models.linear_gaussian(_transition, s.H, s.Q, s.R, s.m0, s.P0, B=_shift, S=s.S)


def inputs(s: System) -> dict[str, np.ndarray]:
    """``u[k]`` belongs to the interval that ends at k; the first is not used."""
    return {"F": np.roll(s.F, 1, axis=0), "b": np.roll(s.b, 1, axis=0)}


class Joint(NamedTuple):
    """Means and second moments of states x_0..x_K and of what arrives, y_0..y_{K-1}, over noise and all delays."""

    x: np.ndarray  # (K+1, n)
    y: np.ndarray  # (K m,)
    xx: np.ndarray  # (K+1, n, n)
    xy: np.ndarray  # (K+1, n, K m)
    yy: np.ndarray  # (K m, K m)


def enumerate_delays(s: System, p: np.ndarray) -> Joint:
    """``p`` (d+2,), or (m, d+2) for channels that are delayed by themselves."""
    K, n, m = len(s.F), len(s.m0), len(s.H)
    # Everything is a constant and a linear function of e = (x_0 - m0, w_0, v_0, w_1, v_1, ...).
    size = n + K * (n + m)
    cov = np.zeros((size, size))
    cov[:n, :n] = s.P0
    for k in range(K):
        at = slice(n + k * (n + m), n + (k + 1) * (n + m))
        cov[at, at] = np.block([[s.Q, s.S], [s.S.T, s.R]])
    unit = np.eye(size)
    mean, rows = [s.m0], [unit[:n]]
    z_mean, z_rows = [], []
    for k in range(K):
        w = n + k * (n + m)
        z_mean.append(s.H @ mean[k])
        z_rows.append(s.H @ rows[k] + unit[w + n : w + n + m])
        mean.append(s.F[k] @ mean[k] + s.b[k])
        rows.append(s.F[k] @ rows[k] + unit[w : w + n])
    zm, zr = np.concatenate(z_mean), np.concatenate(z_rows)
    zz = zr @ cov @ zr.T + np.outer(zm, zm)
    xs, xr = np.array(mean), np.array(rows)
    xz = xr @ cov @ zr.T + xs[:, :, None] * zm

    channels = p.ndim == 2
    table = p if channels else p[None]
    lost = table.shape[1] - 1
    select = np.zeros((K * m, K * m))
    yy = np.zeros_like(select)
    for drawn in itertools.product(range(lost + 1), repeat=K * len(table)):
        delay = np.array(drawn).reshape(K, len(table))
        chance = np.prod(table[np.arange(len(table)), delay])
        rows_of = np.zeros_like(select)
        for k, a in itertools.product(range(K), range(m)):
            for lag in range(min(k, lost - 1) + 1):
                if delay[k - lag, a if channels else 0] == lag:
                    rows_of[k * m + a, (k - lag) * m + a] = 1
                    break
        select += chance * rows_of
        yy += chance * rows_of @ zz @ rows_of.T
    xx = xr @ cov @ np.swapaxes(xr, 1, 2) + xs[:, :, None] * xs[:, None, :]
    return Joint(xs, select @ zm, xx, xz @ select.T, yy)


def estimate(joint: Joint, m: int, i: int, k: int, ys: np.ndarray):
    """The best linear estimate of x_i from y_0..y_k, and its error covariance."""
    seen = slice(0, (k + 1) * m)
    y = joint.y[seen]
    cov = joint.yy[seen, seen] - np.outer(y, y)
    cross = joint.xy[i][:, seen] - np.outer(joint.x[i], y)
    gain = cross @ np.linalg.pinv(cov, rcond=1e-13, hermitian=True)
    own = joint.xx[i] - np.outer(joint.x[i], joint.x[i])
    return joint.x[i] + gain @ (ys[: k + 1].ravel() - y), own - gain @ cross.T


def probabilities(d: int, m: int | None = None, seed: int = 1) -> np.ndarray:
    shape = (d + 2,) if m is None else (m, d + 2)
    p = np.random.default_rng(seed).uniform(0.2, 1.0, shape)
    return p / p.sum(axis=-1, keepdims=True)


def everything(state, info):
    """Info, and the prediction of the step after it, which the state leads to."""
    return state, info


def run(filt, s: System, ys):
    """Info of each step, and the prediction of x_{k+1} from y_0..y_k."""
    states, info = jf.filter(filt, jnp.asarray(ys), u=inputs(s), outputs=everything, first_update_only=True)
    step = {"F": jnp.asarray(s.F), "b": jnp.asarray(s.b)}
    _, ahead = jax.vmap(lambda state, u: filt.predict(state, jf.StepInput(jnp.zeros(len(s.H)), u=u)))(states, step)
    return info, ahead


@pytest.mark.parametrize(
    ("d", "m", "channels"), [(d, m, False) for d in STEPS for m in (1, 2)] + [(1, 2, True), (2, 2, True)]
)
def test_is_the_best_linear_estimator(d, m, channels):
    """Estimates and error covariances, filtered and predicted, against enumeration of every pattern of delays."""
    K = (4 if d == 1 else 3) if channels else STEPS[d]
    s = system(m, K, seed=d)
    p = probabilities(d, m if channels else None)
    joint = enumerate_delays(s, p)
    ys = np.random.default_rng(5).normal(size=(K, m))
    ys[K // 2] = 0.0  # nothing arrived, perhaps
    info, ahead = run(jf.delayed_kalman(model(s), p), s, ys)
    assert ahead.cov is not None
    for k in range(K):
        mean, cov = estimate(joint, m, k, k, ys)
        np.testing.assert_allclose(info.mean[k], mean, atol=1e-9)
        np.testing.assert_allclose(info.cov[k], cov, atol=1e-9)
        mean, cov = estimate(joint, m, k + 1, k, ys)
        np.testing.assert_allclose(ahead.mean[k], mean, atol=1e-9)
        np.testing.assert_allclose(ahead.cov[k], cov, atol=1e-9)
    y = joint.yy[-m:, -m:] - np.outer(joint.y[-m:], joint.y[-m:])
    before = slice(0, (K - 1) * m)
    cross = joint.yy[-m:, before] - np.outer(joint.y[-m:], joint.y[before])
    past = joint.yy[before, before] - np.outer(joint.y[before], joint.y[before])
    np.testing.assert_allclose(info.innovation_cov[-1], y - cross @ np.linalg.solve(past, cross.T), atol=1e-9)


@pytest.mark.parametrize("channels", [False, True])
def test_covariance_is_exact_for_any_gain(channels):
    """With s fixed at 3 the gain is not optimal; the error covariance is that of the gain all the same."""
    d, m, K = 1, 2, 4
    s = system(m, K, seed=3)
    p = probabilities(d, m if channels else None)
    joint = enumerate_delays(s, p)
    filt = jf.adaptive_delayed_kalman(model(s), p, bounds=(3.0, 3.0))
    means = jax.jit(jax.vmap(lambda ys: (run(filt, s, ys)[0].mean, run(filt, s, ys)[1].mean)))
    impulses = np.eye(K * m).reshape(K * m, K, m)
    filtered, ahead = means(np.concatenate([np.zeros((1, K, m)), impulses]))
    info, prediction = run(filt, s, np.zeros((K, m)))
    assert prediction.cov is not None
    for found, cov, later in ((filtered, info.cov, 0), (ahead, prediction.cov, 1)):
        constant = np.asarray(found[0])
        gain = np.moveaxis(np.asarray(found[1:]) - constant, 0, -1)  # (K, n, K m)
        for k in range(K):
            # x - constant - gain y, its mean square
            i = k + later
            c, g = constant[k], gain[k]
            xx = joint.xx[i] - np.outer(joint.x[i], c) - np.outer(c, joint.x[i]) + np.outer(c, c)
            xy = joint.xy[i] - np.outer(c, joint.y)
            np.testing.assert_allclose(cov[k], xx - xy @ g.T - g @ xy.T + g @ joint.yy @ g.T, atol=1e-9)


def printed(s: System, p: np.ndarray, ys: np.ndarray):
    """The filter as printed (corrected), by categories of delay, with three forms of the prediction covariance."""
    d, (m, n) = len(p) - 2, s.H.shape
    N = n + d * m
    joint = np.block([[s.Q, s.S], [s.S.T, s.R]])
    block = [slice(0, n)] + [slice(n + i * m, n + (i + 1) * m) for i in range(d)]
    eye = np.eye(m)
    C1 = np.zeros((m, N))
    C1[:, :n], C1[:, block[1]] = s.H, -eye
    C = np.zeros((m, N))
    C[:, :n], C[:, block[1]] = p[0] * s.H, (1 - p[0]) * eye
    Bs = []
    for c in range(d + 2):
        B = np.zeros((N, n + m))
        B[:n, :n] = np.eye(n)
        if 1 <= c <= d:
            B[block[c], n:] = eye
        Bs.append(B)
    Q_bar = np.einsum("c,cij,jk,clk->il", p, np.array(Bs), joint, np.array(Bs))
    X, P = np.concatenate([s.m0, np.zeros(d * m)]), np.zeros((N, N))
    P[:n, :n] = s.P0
    q, mean = P + np.outer(X, X), X
    for k, y in enumerate(ys):
        A0 = np.zeros((N, N))
        A0[:n, :n] = s.F[k]
        for i in range(1, d):
            A0[block[i], block[i + 1]] = eye
        As = [A0.copy() for _ in range(d + 2)]
        for c in range(1, d + 1):
            As[c][block[c], :n] += s.H
            if c < d:
                As[c][block[c], block[c + 1]] -= eye
        A = np.einsum("c,cij->ij", p, np.array(As))
        Fq = np.einsum("c,cij,jk,clk->il", p, np.array(As), q, np.array(As))
        Q0 = p[0] * (1 - p[0]) * C1 @ q @ C1.T + p[0] * s.R
        S = C @ P @ C.T + Q0
        noise = np.concatenate([s.S, np.zeros((d * m, m))])
        G = p[0] * (A0 - A) @ q @ C1.T + A @ P @ C.T + p[0] * noise
        L = np.linalg.solve(S, G.T).T
        rest = A - L @ C
        half = p[0] * (A0 - A) @ q @ C1.T @ L.T + p[0] * noise @ L.T
        spread = p[0] * (1 - p[0]) * L @ C1 @ q @ C1.T @ L.T + p[0] * L @ s.R @ L.T
        a = Fq - A @ q @ A.T - half - half.T + spread + rest @ P @ rest.T + Q_bar
        b = Fq + Q_bar - A @ (q - P) @ A.T - L @ S @ L.T
        c = rest @ P @ rest.T
        for i, (chance, a_c, b_c) in enumerate(zip(p, As, Bs, strict=True)):
            M = a_c - A - ((i == 0) - p[0]) * L @ C1
            v = b_c - (i == 0) * L @ np.concatenate([np.zeros((m, n)), eye], axis=1)
            c = c + chance * (M @ q @ M.T + v @ joint @ v.T)
        innovation = y - C @ X
        shift = np.concatenate([s.b[k], np.zeros(d * m)])
        q = Fq + Q_bar + np.outer(A @ mean, shift) + np.outer(shift, A @ mean) + np.outer(shift, shift)
        mean = A @ mean + shift
        X, P = A @ X + shift + L @ innovation, c
        yield X, (a, b, c), q


def test_three_forms_of_the_prediction_covariance_agree():
    """The one used is a congruence by lags; the printed one, the short one and the one by categories are the same."""
    s = system(2, 6, seed=2)
    p = probabilities(2)
    filt = jf.delayed_kalman(model(s), p)
    ys = np.random.default_rng(0).normal(size=(6, 2))
    states, _ = jf.filter(filt, jnp.asarray(ys), u=inputs(s), outputs=everything, first_update_only=True)
    for k, (X, forms, q) in enumerate(printed(s, p, ys)):
        if k == 5:
            break
        np.testing.assert_allclose(states.mean[k + 1], X, rtol=1e-10, atol=1e-10)
        for form in forms:
            np.testing.assert_allclose(states.cov[k + 1], form, rtol=1e-10, atol=1e-10)
        mean, cov = states.second
        np.testing.assert_allclose(cov[k + 1] + np.outer(mean[k + 1], mean[k + 1]), q, rtol=1e-10, atol=1e-10)


# Limits


PLANT: dict[str, Any] = {
    "F": np.array([[0.9, 0.2], [-0.1, 0.7]]), "H": np.array([[1.0, 0.3]]), "Q": np.array([[0.5, 0.1], [0.1, 0.4]]),
    "R": np.array([[0.8]]), "m0": np.array([1.0, -2.0]), "P0": np.array([[1.0, 0.2], [0.2, 2.0]]),
}  # fmt: skip


@pytest.fixture(scope="module")
def ys():
    return jnp.asarray(2.0 * np.random.default_rng(4).normal(size=(30, 1)))


def close(a, b, fields=("mean", "cov", "log_lik", "nis", "innovation_cov"), **tolerance):
    for field in fields:
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), err_msg=field, **tolerance)


def test_without_delay_or_loss_it_is_the_kalman_filter(ys):
    plant = jf.models.linear_gaussian(**PLANT, S=np.array([[0.3], [-0.2]]))
    for alpha in ([1.0], [1.0, 0.4, 0.7]):
        delayed = jf.filter(jf.delayed_kalman(plant, jf.models.delay_probabilities(jnp.array(alpha))), ys)
        close(delayed, jf.filter(jf.kalman(plant), ys), rtol=1e-9, atol=1e-9)


def test_pure_delay_is_the_filter_with_time_stamps(ys):
    """At the first step nothing can have arrived: the innovation has no variance, which is flagged and harmless."""
    plant = jf.models.linear_gaussian(**PLANT)
    zs = ys.at[-1].set(0.0)  # never arrives
    received = jf.simulate.deliver(zs, jnp.ones(30, jnp.int32), 1)
    delayed = jf.filter(jf.delayed_kalman(plant, jnp.array([0.0, 1.0, 0.0])), received.ys, first_update_only=True)
    lags = jf.kalman(jf.models.with_lags(plant, 1))
    known = jf.filter(lags, **jf.lag_inputs(received.ys, received.lag, 1), first_update_only=True)
    np.testing.assert_allclose(delayed.mean, known.mean[:, :2], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(delayed.cov, known.cov[:, :2, :2], rtol=1e-9, atol=1e-9)
    singular = (np.asarray(delayed.status) & int(jf.Status.SINGULAR)) != 0
    assert singular.tolist() == [True] + [False] * 29


def test_a_lag_that_never_happens_changes_nothing(ys):
    plant = jf.models.linear_gaussian(**PLANT)
    two = jf.filter(jf.delayed_kalman(plant, jf.models.delay_probabilities(jnp.array([0.5, 0.4, 0.0]))), ys)
    one = jf.filter(jf.delayed_kalman(plant, jf.models.delay_probabilities(jnp.array([0.5, 0.4]))), ys)
    close(two, one, rtol=1e-10, atol=1e-10)


def test_if_nothing_ever_arrives_it_predicts(ys):
    plant = jf.models.linear_gaussian(**PLANT)
    out = jf.filter(jf.delayed_kalman(plant, jf.models.delay_probabilities(jnp.zeros(3))), jnp.zeros_like(ys))
    free = jf.filter(jf.kalman(plant), ys, mask=jnp.zeros(30, bool))
    close(out, free, ("mean", "cov"), rtol=1e-12)


def test_masked_samples_are_zeros_and_covariances_do_not_see_the_mask(ys):
    filt = jf.delayed_kalman(jf.models.linear_gaussian(**PLANT), jnp.array([0.6, 0.2, 0.2]))
    mask = np.arange(30) % 3 > 0
    masked = jf.filter(filt, jnp.where(mask[:, None], ys, jnp.nan), mask=mask)
    zeros = jf.filter(filt, jnp.where(mask[:, None], ys, 0.0))
    close(masked, zeros, rtol=0, atol=0)
    assert (((np.asarray(masked.status) & int(jf.Status.MISSED)) != 0) == ~mask).all()

    def per_run(mask):
        return jf.filter(filt, ys, mask=mask).cov

    batched = jax.make_jaxpr(jax.vmap(per_run, out_axes=None))  # would refuse a covariance that depends on the mask
    batched(jnp.asarray([mask, ~mask]))


@pytest.mark.parametrize("covariance", ["nominal", "inflated"])
@pytest.mark.parametrize("second_moment", ["exact", "zero_mean", "posterior"])
def test_adaptation_bounded_to_one_is_none(ys, covariance, second_moment):
    """The same to the bit; and with an infinite scale nothing but prediction."""
    plant = jf.models.linear_gaussian(**PLANT)
    p = jf.models.delay_probabilities(jnp.array([0.5, 0.4]))
    nominal = jf.filter(jf.delayed_kalman(plant, p, second_moment=second_moment), ys)
    make = partial(jf.adaptive_delayed_kalman, plant, p, covariance=covariance, second_moment=second_moment)
    close(jf.filter(make(bounds=(1.0, 1.0)), ys), nominal, rtol=1e-14)
    free = jf.filter(jf.kalman(plant), ys, mask=jnp.zeros(30, bool))
    if covariance == "nominal":
        close(jf.filter(make(bounds=(1e15, 1e15)), ys), free, ("mean", "cov"), rtol=0, atol=1e-9)


def test_scale_by_hand(ys):
    """s from the innovations, in a window that fills up and with forgetting."""
    plant = jf.models.linear_gaussian(**PLANT)
    p = jf.models.delay_probabilities(jnp.array([0.5, 0.4]))
    for options in ({"window": 4}, {"forgetting": 0.6}):
        out = jf.filter(jf.adaptive_delayed_kalman(plant, p, **options), ys)
        squares, scale = np.asarray(out.innovation[:, 0] ** 2), np.asarray(out.extra["scale"])
        S, noise = np.asarray(out.innovation_cov[:, 0, 0]), np.asarray(out.noise_cov[:, 0, 0])
        for k in range(30):
            age = np.arange(k, -1, -1)
            weights = (age < 4).astype(float) if "window" in options else 0.6**age
            power = weights @ squares[: k + 1] / weights.sum()
            expected = (power - (S[k] - noise[k])) / (noise[k] / scale[k])
            np.testing.assert_allclose(scale[k], max(1.0, expected), rtol=1e-9)
        assert (scale > 1).any()
        assert (scale == 1).any()


# The case worked out by hand in the specification, section 14

HAND = jf.models.linear_gaussian(F=[[0.9]], H=[[1.0]], Q=[[1.0]], R=[[0.5]], m0=[2.0], P0=[[1.0]])


def check_hand(filt, ys, rows):
    """Rows: innovation, filtered mean of x, then mean and covariance (11, 12, 22) of the augmented prediction."""
    ys = jnp.array(ys)[:, None]
    states, info = jf.filter(filt, ys, outputs=everything, first_update_only=True)
    ahead, _ = jax.vmap(lambda s: filt.predict(s, jf.StepInput(jnp.zeros(1))))(states)
    found = [info.innovation[:, 0], info.mean[:, 0], ahead.mean[:, 0], ahead.mean[:, 1],
             ahead.cov[:, 0, 0], ahead.cov[:, 0, 1], ahead.cov[:, 1, 1]]  # fmt: skip
    np.testing.assert_allclose(np.stack(found, axis=1), np.array(rows), atol=1e-6)
    return ahead, info


def test_nominal_hand_case():
    p = jf.models.delay_probabilities(jnp.array([0.8, 0.5]))
    ahead, info = check_hand(jf.delayed_kalman(HAND, p), [1.5, 0.0, 2.0], [
        [-0.1, 1.956522, 1.760870, 0.217391, 1.528261, 0.215217, 0.454348],
        [-1.452174, 0.931894, 0.838705, 0.334222, 1.652667, 0.261585, 0.493492],
        [1.262192, 1.586796, 1.428117, -0.043185, 1.678813, 0.273260, 0.501174],
    ])  # fmt: skip
    np.testing.assert_allclose(info.innovation_cov.ravel(), [1.84, 2.217130, 2.318993], atol=1e-6)
    np.testing.assert_allclose(info.cov.ravel(), [0.652174, 0.805761, 0.838040], atol=1e-6)
    mean, cov = ahead.second
    q = np.asarray(cov + mean[:, :, None] * mean[:, None, :])
    np.testing.assert_allclose(
        np.stack([q[:, 0, 0], q[:, 0, 1], q[:, 1, 1]], axis=1),
        [[5.05, 0.45, 0.55], [5.0905, 0.4545, 0.555], [5.123305, 0.458145, 0.55905]],
        atol=1e-6,
    )


def test_adaptive_hand_case():
    p = jf.models.delay_probabilities(jnp.array([0.8, 0.5]))
    _, info = check_hand(jf.adaptive_delayed_kalman(HAND, p, window=2), [6.0, 0.0, 2.0], [
        [4.4, 2.181818, 1.963636, 0.127273, 1.758991, 0.112671, 0.499924],
        [-1.596364, 1.755281, 1.579753, 0.229157, 2.154684, 0.205544, 0.513829],
        [0.690366, 2.044229, 1.839806, 0.106814, 1.783509, 0.311631, 0.515286],
    ])  # fmt: skip
    np.testing.assert_allclose(info.extra["scale"], [15.6, 8.482971, 1.0], atol=1e-6)


def test_inflated_hand_case():
    p = jf.models.delay_probabilities(jnp.array([0.8, 0.5]))
    filt = jf.adaptive_delayed_kalman(HAND, p, window=2, covariance="inflated")
    states, info = jf.filter(filt, jnp.array([[6.0], [0.0]]), outputs=everything, first_update_only=True)
    assert float(info.extra["scale"][1]) == pytest.approx(8.472334, abs=1e-6)
    np.testing.assert_allclose(
        [states.cov[1, 0, 0], states.cov[1, 0, 1], states.cov[1, 1, 1]], [1.783223, 0.101901, 0.504711], atol=1e-6
    )


# Consistency over many runs


def _angle(k):
    return 0.25 + 0.1 * np.sin(0.2 * k)


def rotating(steps: int = 40) -> System:
    """The test plant of the specification, section 10, item 9."""
    F = np.zeros((steps, 4, 4))
    for k in range(steps):
        c, s = np.cos(_angle(k)), np.sin(_angle(k))
        F[k, :2, :2] = 0.97 * np.array([[c, s], [-s, c]])
        F[k, 2:, 2:] = [[0.9, 0.2], [0.0, 0.8]]
        F[k, 0, 2], F[k, 3, 1] = 0.3, 0.1
    B = np.array([[0.5, 0.0], [0.0, 0.3], [0.2, 0.1], [0.0, 0.4]])
    joint = np.array([[1.0, 0.2, 0.3], [0.2, 0.8, -0.1], [0.3, -0.1, 0.5]])
    return System(
        F, np.zeros((steps, 4)), B @ joint[:2, :2] @ B.T, B @ joint[:2, 2:], np.array([[1.0, 0.0, 0.5, 0.0]]),
        joint[2:, 2:], np.array([3.0, -2.0, 1.0, 0.0]), np.diag([1.0, 2.0, 0.5, 0.3]),
    )  # fmt: skip


@pytest.mark.parametrize("alpha", [(0.9, 0.5, 0.5), (0.5, 0.9, 0.5)])
def test_errors_and_innovations_are_as_stated(alpha):
    s = rotating()
    plant, u = model(s), jax.tree.map(jnp.asarray, inputs(s))
    p = jf.models.delay_probabilities(jnp.array(alpha))
    filt = jf.delayed_kalman(plant, p)

    @jax.jit
    @jax.vmap
    def errors(key):
        truth = jf.simulate.simulate(plant, 40, key, u=u, first_update_only=True)
        delays = jf.simulate.draw_delays(p, (40,), jax.random.fold_in(key, 1_000_000))
        received = jf.simulate.deliver(truth.ys, delays, 2)
        out = jf.filter(filt, received.ys, u=u, first_update_only=True)
        return out.mean - truth.states, out.innovation[:, 0]

    error, innovation = errors(jax.random.split(jax.random.key(0), 40_000))
    stated = jf.filter(filt, jnp.zeros((40, 1)), u=u, first_update_only=True)
    found = np.mean(np.sum(np.asarray(error) ** 2, axis=-1), axis=0)
    np.testing.assert_allclose(found / np.trace(np.asarray(stated.cov), axis1=1, axis2=2), 1.0, atol=0.04)
    innovation = np.asarray(innovation)
    np.testing.assert_allclose(innovation.var(axis=0) / np.asarray(stated.innovation_cov[:, 0, 0]), 1.0, atol=0.05)
    correlation = np.corrcoef(innovation.T) - np.eye(40)
    assert np.abs(correlation).max() < 0.03


# Gradients


def test_gradients_of_likelihood_and_error_equal_differences():
    """Through the scale too, at a point where it is between its bounds in some steps and at them in others."""
    plant = PLANT
    ys = jnp.asarray(np.random.default_rng(3).normal(size=(1, 20, 1)) * 2.0)

    def objective(z, kind):
        p = jf.models.delay_probabilities(jax.nn.sigmoid(z[:3]))
        made = jf.models.linear_gaussian(**{**plant, "Q": jnp.exp(z[3]) * plant["Q"], "R": jnp.exp(z[4]) * plant["R"]})
        if kind == "likelihood":
            return tune.innovation_nll(jf.delayed_kalman(made, p), ys)
        filt = jf.adaptive_delayed_kalman(made, p, window=5)
        return jnp.mean(jf.filter(filt, ys[0]).mean ** 2)

    z = jnp.array([0.3, -0.2, 0.5, 0.1, -0.4])
    for kind in ("likelihood", "error"):
        value = jax.jit(partial(objective, kind=kind))
        reverse = jax.jit(jax.grad(value))(z)
        h = 1e-4
        shifts = jnp.array([-2.0, -1.0, 1.0, 2.0])[:, None, None] * h * jnp.eye(5)[None]
        values = jax.vmap(jax.vmap(value))(z[None, None] + shifts)
        numeric = jnp.array([1.0, -8.0, 8.0, -1.0]) @ values / (12 * h)
        np.testing.assert_allclose(reverse, numeric, rtol=1e-5, atol=1e-9)


# Bad input: each row of the specification's table, section 12

GOOD = jf.models.linear_gaussian(**PLANT)
P = jnp.array([0.6, 0.2, 0.2])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jf.models.delay_probabilities(jnp.array([0.5, 1.2])), r"alpha: expected probabilities"),
        (lambda: jf.models.delay_probabilities(jnp.zeros(0)), r"alpha: expected shape"),
        (lambda: jf.delayed_kalman(GOOD, jnp.array([0.5, 0.2, 0.2])), r"probabilities: .* sum to 1"),
        (lambda: jf.delayed_kalman(GOOD, jnp.array([1.2, -0.2])), r"probabilities: .* sum to 1"),
        (lambda: jf.delayed_kalman(GOOD, jnp.array([jnp.nan, 1.0])), r"probabilities: .* sum to 1"),
        (lambda: jf.delayed_kalman(GOOD, jnp.ones(1)), r"probabilities: expected shape"),
        (lambda: jf.delayed_kalman(GOOD, jnp.full((2, 2), 0.5)), r"probabilities: expected shape"),
        (lambda: jf.delayed_kalman(GOOD, P, second_moment="none"), r"second_moment: expected"),
        (lambda: jf.adaptive_delayed_kalman(GOOD, P, window=0), r"window: expected an int >= 1"),
        (lambda: jf.adaptive_delayed_kalman(GOOD, P, forgetting=1.0), r"forgetting: expected a value in"),
        (lambda: jf.adaptive_delayed_kalman(GOOD, P, bounds=(2.0, 1.0)), r"bounds: expected smallest <= largest"),
        (lambda: jf.adaptive_delayed_kalman(GOOD, P, bounds=(0.0, 1.0)), r"bounds: expected"),
        (lambda: jf.adaptive_delayed_kalman(GOOD, P, covariance="none"), r"covariance: expected"),
        (lambda: jf.models.with_lags(GOOD, -1), r"max_delay: expected an int >= 0"),
        (lambda: jf.simulate.deliver(jnp.zeros((3, 1)), jnp.zeros(3, jnp.int32), -1), r"max_delay: expected an int"),
        (lambda: jf.simulate.deliver(jnp.zeros((3, 1)), jnp.zeros(4, jnp.int32), 1), r"delays: expected shape"),
    ],
)
def test_wrong_probabilities_options_and_shapes_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_indefinite_noise_is_refused():
    with pytest.raises(ValueError, match="Q: expected a positive semidefinite"):
        jf.models.linear_gaussian(**{**PLANT, "Q": np.diag([1.0, -0.1])})
    with pytest.raises(ValueError, match="P0: expected a positive semidefinite"):
        jf.models.linear_gaussian(**{**PLANT, "P0": np.diag([1.0, -0.1])})


def test_noise_that_is_too_correlated_is_refused():
    """Q, R and S are each fine, and no joint covariance."""
    with pytest.raises(ValueError, match=r"S, with Q and R: .*positive semidefinite"):
        jf.models.linear_gaussian(**PLANT, S=np.array([[3.0], [0.0]]))


def test_nan_is_refused_and_flagged_under_a_transformation(ys):
    filt = jf.delayed_kalman(GOOD, P)
    bad = ys.at[3].set(jnp.nan)
    with pytest.raises(ValueError, match=r"ys\[3, 0\] is nan"):
        jf.filter(filt, bad)
    out = jax.jit(jf.filter)(filt, bad)
    assert ((np.asarray(out.status) & int(jf.Status.NONFINITE)) != 0).tolist() == [k == 3 for k in range(30)]
    assert np.isfinite(out.mean).all()


def test_correlated_noise_and_time_stamps_exclude_each_other():
    with pytest.raises(ValueError, match=r"\(S\) is not covered with lags"):
        jf.models.with_lags(jf.models.linear_gaussian(**PLANT, S=np.array([[0.1], [0.0]])), 1)


def test_integrating_plant_is_warned_of_and_posterior_copes():
    walk = jf.models.constant_velocity(dt=1.0, q=0.1, r=1.0, m0=[0.0, 1.0], P0=np.eye(2).tolist())
    with pytest.warns(UserWarning, match="goes blind"):
        jf.delayed_kalman(walk, P)
    out = jf.filter(jf.delayed_kalman(walk, P, second_moment="posterior"), jnp.zeros((5, 1)))
    assert np.isfinite(out.mean).all()


def test_measurement_offset_is_refused():
    offset = jf.models.linear_gaussian(**PLANT, D=np.array([[1.0]]))
    with pytest.raises(ValueError, match="an empty sample differ from 0"):
        jf.delayed_kalman(offset, P)
    with pytest.raises(ValueError, match=r"\(D\) is not covered with lags"):
        jf.models.with_lags(offset, 1)


def _explode(u, dt):
    del u, dt
    return 1e60 * jnp.eye(2)


def test_overflow_is_flagged_at_its_first_step(ys):
    with pytest.warns(UserWarning, match="goes blind"):
        filt = jf.delayed_kalman(GOOD._replace(F=Partial(_explode)), P)
    out = jf.filter(filt, ys[:12])
    bad = (np.asarray(out.status) & int(jf.Status.NONFINITE)) != 0
    assert bad.any()
    assert np.isfinite(np.asarray(out.cov)[: int(np.argmax(bad))]).all()
    assert bad[int(np.argmax(bad)) :].all()
