"""The joint filter: exact checks E3 to E6 of the specification, degenerate clouds, gradients, bad inputs."""

from __future__ import annotations

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxfilt as jf
from tests.examples import LINEAR

joint = importlib.import_module("jaxfilt.filters.joint_particle")

N = 400
PI = ((0.9, 0.1), (0.2, 0.8))
YS = np.asarray(jf.simulate.simulate(jf.models.linear_gaussian(**LINEAR), 60, jax.random.key(5))[1])


def _model(scale):
    return jf.models.linear_gaussian(**{**LINEAR, "Q": scale * LINEAR["Q"]})


CLASSES = [[_model(0.5), _model(1.0)], [_model(2.0), _model(4.0)]]
KEY = jax.random.key(1)


# ------------------------------------------------------------------------------------------------------ exact checks


@pytest.mark.parametrize(
    ("p", "floor", "expected"),
    [
        ((0.97, 0.03), 0.1, (4750, 250)),  # E3
        ((0.6, 0.4), 0.1, (3000, 2000)),
        ((0.97, 0.03), 1.0, (2500, 2500)),
        ((1.0, 0.0), 0.5, (3750, 1250)),
        ((0.5, 0.3, 0.2), 0.3, (2501, 1500, 1000)),
        ((0.9, 0.09, 0.01), 0.6, (3001, 1000, 1000)),
        ((1 / 3, 1 / 3, 1 / 3), 1.0, (1667, 1667, 1667)),
    ],
)
def test_allocation(p, floor, expected):
    logs = jnp.log(jnp.maximum(jnp.asarray(p), 1e-300))
    np.testing.assert_array_equal(joint.allocate(logs, sum(expected), floor), expected)


@pytest.mark.parametrize("scheme", joint.SCHEMES)
def test_resampling_leaves_the_classes_alone(scheme):
    """E3, E4: class probabilities stay to the bit, total 1, blocks sorted; each particle comes of its own class."""
    filt = jf.joint_particle(CLASSES, PI, 5000, floor=0.1, resampling=scheme, threshold=1.0)
    p = filt.predict.args[0]  # pyright: ignore[reportFunctionMemberAccess]
    rng = np.random.default_rng(0)
    counts = np.array([3000, 2000])
    within = np.concatenate([np.log(w / w.sum()) for w in (rng.gamma(0.1, size=n) for n in counts)])
    marks = np.broadcast_to(np.arange(5000.0), (3, 5000))
    state = joint.JointState(
        jnp.asarray(marks), jnp.zeros(5000, jnp.int32), jnp.asarray(within), jnp.log(jnp.array([0.97, 0.03])),
        jnp.asarray(counts, jnp.int32), jnp.zeros((2, 3)),
    )  # fmt: skip
    u = jnp.asarray(rng.uniform(size=2 if scheme == "systematic" else 5000))
    after = joint._resample(p, state, u)
    np.testing.assert_array_equal(after.log_classes, state.log_classes)
    np.testing.assert_array_equal(after.counts, (4750, 250))
    classes = np.repeat([0, 1], after.counts)
    log_weights = np.asarray(after.log_weights + after.log_classes[classes])
    np.testing.assert_allclose(np.exp(log_weights), np.where(classes == 0, 0.97 / 4750, 0.03 / 250), rtol=1e-12)
    np.testing.assert_allclose(np.exp(log_weights).sum(), 1, rtol=1e-12)
    origin = np.asarray(after.particles[0])
    np.testing.assert_array_equal(origin >= 3000, classes == 1)
    # Each particle is drawn as often as its weight says, to one with systematic resampling.
    for c, (begin, n, wanted) in enumerate(((0, 3000, 4750), (3000, 2000, 250))):
        drawn = np.bincount(origin[classes == c].astype(int) - begin, minlength=n)
        expected = wanted * np.exp(within[begin : begin + n])
        slack = {"systematic": 1.0, "stratified": 2.0, "multinomial": 6 * np.sqrt(expected.max()) + 6}[scheme]
        assert (np.abs(drawn - expected) < slack + 1e-9).all()


def test_one_class_and_one_mode_is_the_bootstrap_filter():
    """E6, with the same key."""
    plain = jf.filter(jf.particle(_model(1.0), N), YS, key=KEY)
    multi = jf.filter(jf.multi_mode_particle([_model(1.0)], [[1.0]], N), YS, key=KEY)
    assert (multi.extra["log_probabilities"] == 0).all()
    assert int(((np.asarray(plain.status) & int(jf.Status.LOW_ESS)) != 0).sum()) > 5
    for name in ("mean", "cov", "log_lik", "nis", "innovation", "status"):
        np.testing.assert_allclose(getattr(multi, name), getattr(plain, name), rtol=1e-8, atol=1e-9)


def test_equal_split_is_a_bank_of_separate_filters():
    """E5: equal split and resampling in every step against separate filters that are fed the same draws."""
    options = {"resampling": "systematic", "threshold": 1.0}
    both = jf.joint_particle(CLASSES, PI, N, floor=1.0, **options)
    separate = [jf.multi_mode_particle(models, PI, N // 2, **options) for models in CLASSES]
    p, ps = both.predict.args[0], [f.predict.args[0] for f in separate]  # pyright: ignore[reportFunctionMemberAccess]
    inputs = jf.inputs(YS, key=KEY)
    state = both.init(jf.StepInput(jnp.asarray(YS[0]), key=KEY))
    blocks = [slice(0, N // 2), slice(N // 2, N)]
    states = [
        joint.JointState(
            state.particles[:, b], state.modes[b], state.log_weights[b], jnp.zeros(1),
            jnp.array([N // 2], jnp.int32), state.means[c : c + 1],
        )
        for c, b in enumerate(blocks)
    ]  # fmt: skip

    @jax.jit
    def step(state, states, inp):
        draws = joint._draws(p, inp)
        state, info = joint._update(p, joint._move(p, state, inp, draws), inp)
        found = []
        for c, b in enumerate(blocks):
            own = joint._Draws(draws.ancestors[c : c + 1], draws.modes[b], draws.noise[b])
            found.append(joint._update(ps[c], joint._move(ps[c], states[c], inp, own), inp))
        return state, [s for s, _ in found], info, [i for _, i in found]

    log_p = np.log([0.5, 0.5])
    for k in range(60):
        inp = jax.tree.map(lambda x, k=k: x[k], inputs)
        state, states, info, infos = step(state, states, inp)
        log_p = log_p + np.array([float(i.log_lik) for i in infos])
        log_p -= np.logaddexp(*log_p)
        np.testing.assert_allclose(info.extra["log_probabilities"], log_p, rtol=0, atol=1e-10)
        np.testing.assert_allclose(info.extra["means"], np.stack([i.mean for i in infos]), rtol=0, atol=1e-8)


# -------------------------------------------------------------------------------------------------------- statistics


def test_posterior_and_evidence_agree_with_the_exact_ones():
    """Two linear classes of one mode, where a bank of Kalman filters is exact."""
    models = [_model(0.5), _model(4.0)]
    ys = jnp.asarray(YS[:12])
    exact = jf.filter(jf.bank([jf.kalman(m) for m in models]), ys)
    filt = jf.joint_particle([[m] for m in models], [[1.0]], N, floor=0.2)
    out = jax.vmap(lambda k: jf.filter(filt, ys, key=k))(jax.random.split(KEY, 200))
    ratio = np.exp(np.asarray(out.log_lik).sum(axis=1) - float(exact.log_lik.sum()))
    assert abs(ratio.mean() - 1) < 3.5 * ratio.std(ddof=1) / np.sqrt(200)
    p = np.exp(np.asarray(out.extra["log_probabilities"])[:, -1, 1])
    assert abs(p.mean() - float(np.exp(exact.extra["log_probabilities"][-1, 1]))) < 0.01
    assert (np.asarray(out.extra["counts"]).sum(axis=2) == N).all()
    assert (np.asarray(out.extra["counts"]).min(axis=2) >= 0.1 * N).all()


def test_modes_follow_the_chain():
    """Without measurements the modes' shares are those of the chain, within 5 standard errors."""
    filt = jf.multi_mode_particle(CLASSES[0], PI, 4000, mode_prior=(1.0, 0.0))
    out = jf.filter(filt, jnp.zeros((5, 2)), mask=np.zeros((5, 2), bool), key=KEY)
    chain = np.array([1.0, 0.0]) @ np.linalg.matrix_power(np.array(PI), 5)
    np.testing.assert_allclose(out.extra["mode_probabilities"][-1], chain, atol=5 * 0.5 / np.sqrt(4000))


# -------------------------------------------------------------------------------------------------- degenerate clouds


def _nothing(scale, x, u, dt):
    del u, dt
    return scale * x[:2]


def _likelihood_free(R):
    f = Partial(_step_back, jnp.asarray(1.0))
    return jf.models.nonlinear(f, Partial(_nothing, 1.0), 1e-4 * np.eye(3), R, np.zeros(3), np.eye(3))


def _step_back(scale, x, u, dt):
    del u, dt
    return scale * x


def _run(filt, ys, **options):
    out = jf.filter(filt, jnp.asarray(ys), key=KEY, **options)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(out))
    return out


def _bits(out, bit):
    return (np.asarray(out.status) & int(bit)) != 0


SMALL = jf.joint_particle([[_model(1.0)], [_model(4.0)]], [[1.0]], 20, floor=0.5)


def test_all_weights_lost_keeps_the_predicted_cloud_and_flags():
    """A measurement so far off that no likelihood is finite."""
    ys = YS[:6].copy()
    ys[3] = 1e200
    out = jf.filter(SMALL, jnp.asarray(ys), key=KEY)
    out = out._replace(nis=jnp.where(jnp.arange(6) == 3, 0.0, out.nis))  # the square of 1e200
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(out))
    assert (_bits(out, jf.Status.NONFINITE) == (np.arange(6) == 3)).all()
    np.testing.assert_array_equal(out.extra["log_probabilities"][3], out.extra["log_probabilities"][2])
    assert float(out.log_lik[3]) < -1e300


def test_one_particle_dominating_is_flagged():
    ys = YS[:6].copy()
    ys[3] += 300.0
    out = _run(SMALL, ys)
    assert _bits(out, jf.Status.LOW_ESS)[3]
    assert float(out.extra["ess"][3].min()) < 1.01


def test_a_single_particle_is_flagged_throughout():
    out = _run(jf.multi_mode_particle([_model(1.0)], [[1.0]], 1), YS[:6])
    assert _bits(out, jf.Status.LOW_ESS).all()
    assert (np.asarray(out.cov) == 0).all()
    assert (np.asarray(out.extra["ess"]) == 1).all()


def test_a_class_that_underflows_stays_finite_and_recovers():
    """Class 1 stands still; the data first stand still and then move fast for long."""
    still = jf.models.linear_gaussian(
        F=np.eye(1), H=np.eye(1), Q=1e-4 * np.eye(1), R=1e-2 * np.eye(1), m0=np.zeros(1), P0=1e-2 * np.eye(1)
    )
    moving = still._replace(Q=25.0 * jnp.eye(1))
    filt = jf.joint_particle([[still], [moving]], [[1.0]], 200, floor=0.5)
    ys = np.concatenate([np.zeros(400), 3.0 * np.arange(40)])[:, None]
    out = _run(filt, ys)
    log_p = np.asarray(out.extra["log_probabilities"])
    assert log_p[399, 1] < np.log(np.finfo(float).tiny)  # its probability is 0 in floating point
    assert log_p[-1, 1] > -1e-6
    assert (np.asarray(out.extra["counts"])[:400].min(axis=1) >= 50).all()


# ---------------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize("masked", [True, False])
def test_missing_components(masked):
    """One NaN component: the likelihood of the other only; both: predicted, nothing weighed."""
    ys = YS[:4].copy()
    ys[1, 0] = ys[2, :] = np.nan
    mask = np.isfinite(ys)
    score = Partial(_prefer, jnp.asarray(1.0))
    filt = jf.joint_particle([[_model(1.0)], [_model(4.0)]], [[1.0]], 20, score=score, threshold=0.0)

    @jax.jit
    def run(filt, y):
        return jf.filter(filt, y, mask=jnp.asarray(mask) if masked else None, key=KEY)

    out = run(filt, jnp.asarray(ys))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(out))
    np.testing.assert_array_equal(out.extra["log_probabilities"][2], out.extra["log_probabilities"][1])
    assert float(out.log_lik[2]) == 0
    other = run(filt, jnp.asarray(np.where(mask, ys, -7.0)) if masked else jnp.asarray(np.where(mask, ys, np.inf)))
    np.testing.assert_array_equal(out.mean, other.mean)
    assert _bits(out, jf.Status.MISSED if masked else jf.Status.NONFINITE)[2]


def _prefer(weight, x, c):
    del x
    return weight * c.astype(weight.dtype)


def test_a_score_moves_the_odds_by_its_value_in_each_step():
    """The same model in both classes, at each particle or at the class's mean: odds grow by 0.3 in expectation."""
    for at in ("particle", "class_mean"):
        filt = jf.joint_particle(
            [[_model(1.0)]] * 2, [[1.0]], 4000, score=Partial(_prefer, jnp.asarray(0.3)), score_at=at, floor=1.0
        )
        out = _run(filt, YS[:5])
        log_p = np.asarray(out.extra["log_probabilities"])
        np.testing.assert_allclose(log_p[:, 1] - log_p[:, 0], np.linspace(0.3, 1.5, 5), atol=0.3)


BAD = [
    ({"count": 401}, "multiple of the 2 classes"),
    ({"count": 0}, "count"),
    ({"count": 2.0}, "count"),
    ({"floor": 0.0}, "floor"),
    ({"floor": 1.1}, "floor"),
    ({"floor": -0.1}, "floor"),
    ({"floor": 0.001}, "without any"),
    ({"threshold": 1.5}, "threshold"),
    ({"transition": ((0.9, 0.2), (0.2, 0.8))}, "transition"),
    ({"transition": ((1.1, -0.1), (0.2, 0.8))}, "transition"),
    ({"transition": ((1.0,),)}, "transition"),
    ({"prior": (0.5, 0.6)}, "prior"),
    ({"mode_prior": (0.5, 0.6)}, "mode_prior"),
    ({"resampling": "residual"}, "resampling"),
    ({"score_at": "mean"}, "score_at"),
    ({"noise_rank": 4}, "noise_rank"),
    ({"noise_rank": 2}, "Q needs more than 2"),
    ({"models": []}, "models"),
    ({"models": [CLASSES[0], CLASSES[1][:1]]}, "models"),
    ({"models": [[_model(1.0), _likelihood_free(np.eye(2))]] * 2}, "built otherwise"),
]


@pytest.mark.parametrize(("change", "match"), BAD)
def test_refused(change, match):
    given = {"models": CLASSES, "transition": PI, "count": N, **change}
    with pytest.raises(ValueError, match=match):
        jf.joint_particle(**given)


def test_no_key_is_refused():
    with pytest.raises(ValueError, match="key"):
        jf.filter(SMALL, YS[:3])


def test_no_process_noise_warns():
    with pytest.warns(UserWarning, match="copies"):
        jf.multi_mode_particle([_model(0.0)], [[1.0]], 10)


def test_a_lower_noise_rank_draws_from_the_same_law():
    """Q of rank 1 in 3 dimensions: one number per particle, and the same spread."""
    g = np.array([0.5, 1.0, -0.3])
    model = jf.models.linear_gaussian(**{**LINEAR, "Q": np.outer(g, g), "P0": 1e-12 * np.eye(3)})
    out = jf.filter(
        jf.multi_mode_particle([model], [[1.0]], 4000, noise_rank=1), jnp.zeros((1, 2)),
        mask=np.zeros((1, 2), bool), key=KEY,
    )  # fmt: skip
    assert out.cov is not None
    np.testing.assert_allclose(out.cov[0], np.outer(g, g), atol=5 * np.sqrt(2 / 4000))
