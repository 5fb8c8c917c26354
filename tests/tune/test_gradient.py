from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxfilt as jf
from jaxfilt import tune

KEY = jax.random.key(0)


def bowl(params, data):
    return jnp.sum((params["x"] - data) ** 2) + (jnp.log(params["q"]) - 1.0) ** 2


SPACE = {"x": tune.real([0.0, 0.0], -5.0, 5.0), "q": tune.positive(0.1), "unused": 1.0}
TARGET = jnp.array([1.0, -2.0])


def test_finds_the_minimum_of_a_quadratic():
    result = tune.gradient(bowl, SPACE, TARGET, key=KEY)
    np.testing.assert_allclose(result.params["x"], TARGET, atol=1e-4)
    np.testing.assert_allclose(result.params["q"], np.e, rtol=1e-4)
    assert result.params["unused"] == 1.0
    assert result.loss < 1e-8
    np.testing.assert_allclose(result.loss, bowl(result.params, TARGET), rtol=1e-6)
    assert result.method == "gradient"
    assert result.front is None


def test_history_counts_evaluations_and_never_rises():
    result = tune.gradient(bowl, SPACE, TARGET, key=KEY, steps=25, starts=3, block=10)
    np.testing.assert_array_equal(result.history.evaluations, [30, 60, 75])
    assert result.evaluations == 75
    assert (np.diff(result.history.best_loss) <= 0).all()
    assert (np.diff(result.history.wall_time) > 0).all()
    assert result.history.best_loss[-1] == result.loss
    assert result.wall_time == result.history.wall_time[-1]
    assert result.compile_time > 0
    assert result.best_at(0.0) == np.inf
    assert result.best_at(result.history.wall_time[1]) == result.history.best_loss[1]
    assert result.best_at(1e9) == result.loss
    assert "gradient" in repr(result)


def test_best_point_of_the_path_is_kept_not_the_last():
    result = tune.gradient(bowl, SPACE, TARGET, key=KEY, optimizer=optax.sgd(1.0), steps=1)
    np.testing.assert_allclose(result.params["x"], [0.0, 0.0], atol=1e-15)
    overshooting = tune.gradient(bowl, SPACE, TARGET, key=KEY, optimizer=optax.sgd(50.0), steps=20)
    assert overshooting.loss <= result.loss


def test_steps_are_projected_onto_the_box():
    space = {"x": tune.real([0.0, 0.0], -5.0, 0.5), "q": tune.positive(0.1, 0.05, 0.2)}
    result = tune.gradient(bowl, space, TARGET, key=KEY)
    np.testing.assert_allclose(result.params["x"], [0.5, -2.0], atol=1e-3)
    np.testing.assert_allclose(result.params["q"], 0.2, rtol=1e-12)


def two_wells(params, data):
    x = params["x"]
    return (x**2 - 4.0) ** 2 / 16.0 - 0.3 * x + data


def test_other_starts_find_a_better_well_and_the_first_start_is_the_initial_value():
    space = {"x": tune.real(-3.0, -4.0, 4.0)}
    one = tune.gradient(two_wells, space, jnp.array(0.0), key=KEY)
    many = tune.gradient(two_wells, space, jnp.array(0.0), key=KEY, starts=8)
    assert one.params["x"] < 0 < many.params["x"]
    near = tune.gradient(two_wells, space, jnp.array(0.0), key=KEY, starts=8, spread=0.0)
    np.testing.assert_allclose(near.loss, one.loss, rtol=1e-12)


def test_same_key_same_result_and_other_keys_other_starts():
    runs = [tune.gradient(bowl, SPACE, TARGET, key=jax.random.key(k), steps=5, starts=4) for k in (3, 3, 4)]
    jax.tree.map(np.testing.assert_array_equal, runs[0].params, runs[1].params)
    np.testing.assert_array_equal(runs[0].history.best_loss, runs[1].history.best_loss)
    assert runs[0].loss != runs[2].loss


def holed(params, data):
    x = params["x"]
    return jnp.where(x < -1.0, jnp.sqrt(x), (x - data) ** 2)  # NaN, value and gradient, below -1


def test_a_start_in_a_hole_leaves_the_others_bitwise_alone():
    space = {"x": tune.real(-3.0, -4.0, 4.0)}
    result = tune.gradient(holed, space, jnp.array(1.0), key=KEY, starts=6, steps=100)
    assert np.isfinite(result.loss)
    np.testing.assert_allclose(result.params["x"], 1.0, atol=1e-2)
    alone = tune.gradient(holed, space, jnp.array(1.0), key=KEY, steps=20)
    assert alone.loss == np.inf
    np.testing.assert_allclose(alone.params["x"], -3.0)


def test_a_path_into_a_hole_steps_back_and_goes_on():
    def cliff(params, data):
        x = params["x"]
        return jnp.where(x > 2.0, jnp.nan, (x - data) ** 2)

    space = {"x": tune.real(-3.0, -4.0, 4.0)}
    result = tune.gradient(cliff, space, jnp.array(1.9), key=KEY, optimizer=optax.sgd(2.0), steps=200)
    assert result.loss < 1e-3


def test_the_loss_is_traced_once_for_all_steps_starts_and_later_calls():
    traces = []

    def counted(params, data):
        traces.append(1)
        return bowl(params, data)

    first = tune.gradient(counted, SPACE, TARGET, key=KEY, steps=25, starts=3)
    again = tune.gradient(counted, SPACE, TARGET, key=KEY, steps=42, starts=3)
    assert len(traces) == 1
    assert again.compile_time < first.compile_time


@pytest.mark.parametrize("make", [lambda: optax.lbfgs(), lambda: optax.adamw(optax.linear_schedule(0.1, 0.0, 300))])
def test_any_optax_optimizer_will_do(make):
    result = tune.gradient(bowl, SPACE, TARGET, key=KEY, optimizer=make(), starts=2)
    np.testing.assert_allclose(result.params["x"], TARGET, atol=1e-2)


def test_float32_stays_float32():
    space = {"x": tune.real(np.zeros(2, np.float32), -5.0, 5.0), "q": tune.positive(0.1)}
    result = tune.gradient(bowl, space, TARGET.astype(jnp.float32), key=KEY)
    assert result.params["q"].dtype == jnp.float32
    np.testing.assert_allclose(result.params["x"], TARGET, atol=1e-3)


def test_time_limit_ends_the_run_early():
    result = tune.gradient(bowl, SPACE, TARGET, key=KEY, steps=1000, time_limit=0.0)
    assert result.evaluations == 10


def test_progress_without_tqdm_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "tqdm.auto", None)
    with pytest.raises(ImportError, match=r'pip install "jaxfilt\[progress\]"'):
        tune.gradient(bowl, SPACE, TARGET, key=KEY, progress=True)


@pytest.mark.parametrize("bad", [{"steps": 0}, {"starts": 0}, {"block": 0}])
def test_bad_counts_are_named(bad):
    with pytest.raises(ValueError, match=f"^{next(iter(bad))}: "):
        tune.gradient(bowl, SPACE, TARGET, key=KEY, **bad)


def test_a_space_without_specs_is_refused():
    with pytest.raises(ValueError, match=r"^space: "):
        tune.gradient(bowl, {"x": TARGET, "q": 1.0}, TARGET, key=KEY)


# The scenario G1 before its gap: constant velocity, T = 1 s, q = 0.1 m^2/s^3, R = 25 m^2, prior on the first sample.
M0 = np.array([0.0, 10.0])
P0 = np.diag([100.0, 25.0])


def g1(seed, runs, steps=20, q=0.1, r=25.0):
    rng = np.random.default_rng(seed)
    F = np.array([[1.0, 1.0], [0.0, 1.0]])
    L = np.linalg.cholesky(q * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]))
    x = M0 + rng.normal(size=(runs, 2)) @ np.sqrt(P0)
    ys = []
    for _ in range(steps):
        ys.append(x[:, :1] + np.sqrt(r) * rng.normal(size=(runs, 1)))
        x = x @ F.T + rng.normal(size=(runs, 2)) @ L.T
    return jnp.asarray(np.stack(ys, axis=1))


def likelihood(params, ys):
    model = jf.models.constant_velocity(dt=1.0, q=params["q"], r=params["r"], m0=jnp.asarray(M0), P0=jnp.asarray(P0))
    return tune.innovation_nll(jf.kalman(model), ys, first_update_only=True)


def test_log_q_from_a_hundredth_of_the_truth_reaches_the_maximum_of_the_likelihood_on_64_runs():
    ys = g1(0, 64)
    space = {"q": tune.positive(0.001, 1e-4, 10.0), "r": 25.0}
    result = tune.gradient(likelihood, space, ys, key=KEY)
    grid = jnp.exp(jnp.linspace(jnp.log(0.03), jnp.log(0.3), 401))
    losses = np.asarray(jax.jit(jax.vmap(lambda q: likelihood({"q": q, "r": 25.0}, ys)))(grid))
    i = losses.argmin()
    best = grid[i]
    np.testing.assert_allclose(result.params["q"], best, rtol=6e-3)  # one cell of the grid
    assert result.loss <= losses.min() + 1e-9
    # What 1280 samples say about q: the curvature of the total likelihood gives a standard error of about a fifth.
    width = 20 * np.log(10.0) / 400
    curvature = 1280.0 * (losses[i + 20] - 2 * losses[i] + losses[i - 20]) / width**2
    assert 0.1 < 1.0 / np.sqrt(curvature) < 0.35
    assert abs(np.log(result.params["q"] / 0.1)) < 3.3 / np.sqrt(curvature)


def test_log_q_and_log_r_reach_the_truth_to_five_percent_when_the_data_can_tell():
    ys = g1(1, 12_800)
    space = {"q": tune.positive(0.001, 1e-4, 10.0), "r": tune.positive(10.0)}
    result = tune.gradient(likelihood, space, ys, key=KEY, steps=300)
    np.testing.assert_allclose(result.params["q"], 0.1, rtol=0.05)
    np.testing.assert_allclose(result.params["r"], 25.0, rtol=0.05)
