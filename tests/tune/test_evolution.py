from __future__ import annotations

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilt import tune

pytest.importorskip("pymoo")

KEY = jax.random.key(0)
SPACE = {"x": tune.real([0.0, 0.0], -5.0, 5.0), "q": tune.positive(0.1), "unused": 1.0}
TARGET = jnp.array([1.0, -2.0])


def bowl(params, data):
    return jnp.sum((params["x"] - data) ** 2) + (jnp.log(params["q"]) - 1.0) ** 2


def trade_off(params, data):
    """Its Pareto set is x[0] in [-1, 1], x[1] = 0, q = 1; on it sqrt(f0) + sqrt(f1) = 2."""
    x, rest = params["x"], params["x"][1] ** 2 + jnp.log(params["q"]) ** 2
    return jnp.stack([(x[0] + data) ** 2 + rest, (x[0] - data) ** 2 + rest])


def test_genetic_finds_the_minimum_of_a_quadratic():
    result = tune.genetic(bowl, SPACE, TARGET, key=KEY)
    np.testing.assert_allclose(result.params["x"], TARGET, atol=0.2)
    np.testing.assert_allclose(jnp.log(result.params["q"]), 1.0, atol=0.2)
    assert result.params["unused"] == 1.0
    np.testing.assert_allclose(result.loss, bowl(result.params, TARGET), rtol=1e-12)
    assert result.evaluations == 30 * 40


def test_nsga2_finds_the_front():
    result = tune.nsga2(trade_off, SPACE, jnp.array(1.0), key=KEY, generations=60)
    assert result.front is not None
    losses = result.front.losses
    assert losses.shape == (40, 2)
    np.testing.assert_allclose(np.sqrt(losses).sum(axis=1), 2.0, atol=0.1)
    assert (np.diff(losses[:, 0]) >= 0).all()
    assert losses[0, 0] < 0.05
    assert losses[-1, 1] < 0.05
    again = jax.vmap(trade_off, (0, None))(result.front.params, jnp.array(1.0))
    np.testing.assert_allclose(again, losses, rtol=1e-10)
    np.testing.assert_allclose(result.loss, 2.0, atol=0.05)  # the middle of the front, for equal weights
    np.testing.assert_allclose(result.params["x"][0], 0.0, atol=0.2)


def test_weights_choose_the_member_that_is_shown_and_leave_the_search_alone():
    runs = [
        tune.nsga2(trade_off, SPACE, jnp.array(1.0), key=KEY, generations=20, weights=weights)
        for weights in ([1.0, 0.0], [0.0, 1.0])
    ]
    fronts = [run.front for run in runs if run.front is not None]
    np.testing.assert_array_equal(fronts[0].losses, fronts[1].losses)
    assert runs[0].params["x"][0] < -0.8
    assert runs[1].params["x"][0] > 0.8


def test_all_tuners_return_the_same_fields():
    results = [
        tune.gradient(bowl, SPACE, TARGET, key=KEY, steps=20),
        tune.genetic(bowl, SPACE, TARGET, key=KEY, generations=3),
        tune.nsga2(trade_off, SPACE, jnp.array(1.0), key=KEY, generations=3),
    ]
    for result in results:
        assert isinstance(result, tune.TuneResult)
        assert jax.tree.structure(result.params) == jax.tree.structure(results[0].params)
        assert type(result.loss) is float
        rows = {len(column) for column in result.history}
        assert len(rows) == 1
        assert result.history.evaluations[-1] == result.evaluations
        assert result.history.wall_time[-1] == result.wall_time
        assert result.history.best_loss[-1] == result.loss == result.best_at(1e9)
        assert (np.diff(result.history.best_loss) <= 0).all()
        assert result.compile_time > 0
        assert result.method in repr(result)
    assert [result.front is None for result in results] == [True, True, False]


@pytest.mark.parametrize(("tuner", "loss", "data"), [(tune.genetic, bowl, TARGET), (tune.nsga2, trade_off, 1.0)])
def test_same_key_same_result(tuner, loss, data):
    data = jnp.asarray(data)
    runs = [tuner(loss, SPACE, data, key=jax.random.key(k), population=8, generations=6) for k in (5, 5, 6)]
    jax.tree.map(np.testing.assert_array_equal, runs[0].params, runs[1].params)
    np.testing.assert_array_equal(runs[0].history.best_loss, runs[1].history.best_loss)
    np.testing.assert_array_equal(runs[0].history.evaluations, runs[1].history.evaluations)
    assert runs[0].loss != runs[2].loss


def test_the_first_population_holds_the_initial_value():
    space = {"x": tune.real(TARGET, -5.0, 5.0), "q": tune.positive(jnp.e)}
    result = tune.genetic(bowl, space, TARGET, key=KEY, generations=1)
    assert result.loss < 1e-24
    assert result.evaluations == 30


def test_members_stay_in_the_box():
    space = {"x": tune.real([0.0, 0.0], -5.0, 0.5), "q": tune.positive(0.1, 0.05, 0.2)}
    result = tune.genetic(bowl, space, TARGET, key=KEY)
    np.testing.assert_allclose(result.params["x"], [0.5, -2.0], atol=0.2)
    assert result.params["x"][0] <= 0.5
    assert result.params["q"] <= 0.2 * (1 + 1e-12)


def test_the_population_is_one_batch_traced_once_also_when_pymoo_breeds_fewer_members():
    traces = []

    def counted(params, data):
        traces.append(params["n"].shape)
        return (params["n"] - data) ** 2

    def stepped(params, data):
        return counted({"n": jnp.round(params["n"])}, data)

    space = {"n": tune.real(0.0, -3.0, 3.0)}
    for _ in range(2):
        tune.genetic(stepped, space, jnp.array(2.0), key=KEY, population=7, generations=30)
    assert traces == [()]


def test_non_finite_losses_rank_last():
    def holed(params, data):
        x = params["x"]
        return jnp.where(x < -1.0, jnp.sqrt(x), (x - data) ** 2)

    space = {"x": tune.real(-3.0, -4.0, 4.0)}
    result = tune.genetic(holed, space, jnp.array(1.0), key=KEY, population=10)
    np.testing.assert_allclose(result.params["x"], 1.0, atol=0.05)


def test_only_non_finite_losses_give_the_initial_value_and_an_infinite_loss():
    def hopeless(params, data):
        return params["x"] * data

    space = {"x": tune.real(-3.0, -4.0, 4.0)}
    result = tune.genetic(hopeless, space, jnp.array(jnp.nan), key=KEY, population=4, generations=2)
    assert result.loss == np.inf
    np.testing.assert_allclose(result.params["x"], -3.0)

    def hopeless_pair(params, data):
        return jnp.stack([params["x"] * data, params["x"]])

    front = tune.nsga2(hopeless_pair, space, jnp.array(jnp.nan), key=KEY, population=4, generations=2).front
    assert front is not None
    assert (front.losses == np.inf).all()


def test_float32_stays_float32():
    space = {"x": tune.real(np.zeros(2, np.float32), -5.0, 5.0), "q": tune.positive(0.1)}
    result = tune.genetic(bowl, space, TARGET.astype(jnp.float32), key=KEY, generations=3)
    assert result.params["q"].dtype == jnp.float32


def test_time_limit_ends_the_run_early():
    result = tune.genetic(bowl, SPACE, TARGET, key=KEY, time_limit=0.0)
    assert result.evaluations == 30


def test_missing_pymoo_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymoo.algorithms.moo.nsga2", None)
    with pytest.raises(ImportError, match=r'pip install "jaxfilt\[tune\]"'):
        tune.genetic(bowl, SPACE, TARGET, key=KEY)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match=r"^population: "):
        tune.genetic(bowl, SPACE, TARGET, key=KEY, population=1)
    with pytest.raises(ValueError, match=r"^generations: "):
        tune.genetic(bowl, SPACE, TARGET, key=KEY, generations=0)
    with pytest.raises(ValueError, match=r"^weights: "):
        tune.nsga2(trade_off, SPACE, jnp.array(1.0), key=KEY, weights=[1.0])
    with pytest.raises(ValueError, match=r"^space: "):
        tune.genetic(bowl, {"x": TARGET, "q": 1.0}, TARGET, key=KEY)
