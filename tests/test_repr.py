"""What models, filters and results print: what they hold, in a few lines, whatever is in them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from tests import registry

MODEL = jf.models.linear_gaussian(
    F=np.eye(3), H=np.eye(2, 3), Q=np.eye(3), R=np.eye(2), m0=[0.0, 1.5, 2.0], P0=np.eye(3)
)
YS = np.ones((6, 2))
MASK = np.array([True, True, False, True, False, True])


@pytest.fixture(scope="module")
def out():
    return jf.filter(jf.kalman(MODEL), YS, mask=MASK, outputs=jf.everything)


def few_lines(x) -> str:
    text = repr(x)
    assert text.count("\n") < 12, text
    assert max(map(len, text.splitlines())) <= 130, text
    assert "0x" not in text  # no address of a function
    return text


@pytest.mark.parametrize("name", registry.REGISTRY)
def test_every_filter_prints_in_a_few_lines(name):
    example = registry.REGISTRY[name]
    texts = []
    # Traced, which compiles nothing: the shapes are there all the same.
    jax.eval_shape(lambda p: texts.append(few_lines(example.make(p))), registry.params(example, jnp.float64))
    assert texts[0].startswith("Filter ")
    assert ", float64: " in texts[0] or ", float64:\n" in texts[0]


def test_a_filter_tells_its_file_and_its_parameters():
    assert repr(jf.kalman(MODEL)) == (
        "Filter kalman, float64: F=(3, 3), H=(2, 3), Q=(3, 3), R=(2, 2), m0=[0, 1.5, 2], P0=(3, 3)"
    )
    wrapped = repr(jf.gated(jf.kalman(MODEL), p_false=0.01))
    assert wrapped.startswith("Filter gate.gated, float64:")
    assert "inner=kalman(F=(3, 3)" in wrapped
    assert "p_false=0.01" in wrapped
    both = repr(jf.imm((jf.kalman(MODEL), jf.kalman(MODEL)), np.full((2, 2), 0.5)))
    assert "filters[0]=kalman(" in both
    assert "filters[1]=kalman(" in both


def test_a_model_tells_its_functions_and_what_they_hold():
    model = jf.models.constant_velocity(dt=0.5, q=0.25, r=4.0, m0=np.zeros(2), P0=np.eye(2))
    text = few_lines(model)
    assert text.startswith("LinearGaussian, float64: F=transition(Motion(dt=0.5, q=[0.25]")
    sensor = jf.models.sensors.range_bearing(np.eye(2))
    plane = jf.models.constant_velocity(dt=0.5, q=0.25, r=4.0, m0=np.zeros(4), P0=np.eye(4))
    assert few_lines(sensor).startswith("Sensor, float64: h=range_bearing(")
    assert few_lines(jf.models.with_sensor(plane, sensor)).startswith("Nonlinear, float64:")


def test_an_info_tells_shapes_and_the_status_bits_that_occurred(out):
    text = few_lines(out)
    assert text.startswith("Info of 6 samples, float64: mean=(6, 3), cov=(6, 3, 3)")
    assert "status: MISSED 2 of 6" in text
    assert f"sum of log_lik: {float(out.log_lik.sum()):.5g}" in text
    one = few_lines(jax.tree.map(lambda leaf: leaf[0], out))
    assert one.startswith("Info of one step, float64: mean=[")
    assert "no bit set of 1" in one
    batch = few_lines(jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), out))
    assert batch.startswith("Info of 2 x 6 samples")
    assert "MISSED 4 of 12" in batch
    assert f"sum of log_lik: {float(out.log_lik.sum()):.5g} on average of runs" in batch
    assert repr(jf.rts(out)) == "Smoothed, float64: mean=(6, 3), cov=(6, 3, 3)"
    assert repr(out.prediction) == "Prediction, float64: mean=(6, 3), cov=(6, 3, 3), cross=(6, 3, 3)"


def test_a_monte_carlo_result_tells_means_with_standard_errors():
    mse = np.array([1.0, 2.0, 6.0])
    course = np.arange(6.0).reshape(3, 2)
    words = np.array([0, 1, 5], np.int32)
    result = jf.MonteCarloResult({"a": {"mse": mse, "course": course}}, {"a": words}, 3, 4, 2.0, 0.25)
    assert few_lines(result) == (
        "MonteCarloResult: 3 runs in chunks of 4, 12 runs/s (0.25 s; compilation 2 s)\n"
        "  a: mse 3 ± 1.5, course 2.5 ± 1.2 (over (2,)); runs with MISSED 2, SINGULAR 1"
    )
    assert [f"{result.mean('a', 'mse').value:.4g}", f"{result.mean('a', 'mse').standard_error:.2g}"] == ["3", "1.5"]


def test_a_scenario_and_its_draw_tell_their_inputs():
    text = few_lines(jf.scenario(MODEL, 6, mask=MASK))
    assert text.startswith("Scenario, float64:\n  simulate=draw_from_model(LinearGaussian(F=(3, 3)")
    assert text.endswith("mask=(6,), first_update_only=False")
    assert few_lines(jf.Draw(np.ones((6, 3)), YS)) == "Draw, float64: truth=(6, 3), ys=(6, 2)"


def test_results_of_tuning_tell_their_course():
    history = jf.tune.History(np.array([10, 20]), np.array([0.25, 0.5]), np.array([3.0, 1.5]))
    front = jf.tune.Front(np.array([[1.0, 3.0], [2.0, 2.5]]), {"q": np.ones(2)})
    assert repr(history) == "History of 2 rows: best_loss 3 -> 1.5, 20 evaluations in 0.5 s"
    assert repr(front) == "Front of 2 solutions: losses 1 to 2, 2.5 to 3; params={q=[1, 1]}"
    result = jf.tune.TuneResult({"q": jnp.asarray(0.25)}, 1.5, history, 20, 0.5, 2.0, "nsga2", front)
    assert few_lines(result).endswith("front of 2, params={q=0.25})")
    assert repr(jf.Static(3)) == "Static(value=3)"


def test_a_repr_never_fails_under_a_transformation_or_of_half_built_trees(out):
    texts = []

    @jax.jit
    @jax.vmap
    def inside(R, mean):
        model = MODEL._replace(R=R)
        texts.extend(repr(x) for x in (model, jf.kalman(model), out._replace(mean=mean), jf.Smoothed(mean, R)))
        return mean

    inside(np.ones((5, 2, 2)), np.ones((5, 6, 3)))
    assert any("R=(2, 2)" in text for text in texts)
    result = jf.MonteCarloResult({}, {}, 1, 1, 0.0, 1.0)
    trees = (MODEL, jf.kalman(MODEL), out, jf.rts(out), result, jf.tune.History(*np.ones((3, 2))),
             jf.tune.Front(np.ones((2, 2)), {}), jf.Draw(np.ones(2), np.ones(2)))  # fmt: skip
    for tree in trees:
        for wrong in (object(), None, jax.ShapeDtypeStruct((2,), np.float64), jax.random.key(0), "text"):
            built = jax.tree.map(lambda _: wrong, tree)  # noqa: B023
            assert repr(built).startswith(("Filter ", type(tree).__name__))


def test_a_deleted_array_prints_its_shape():
    x = jnp.arange(3.0)
    x.delete()
    assert "mean=(3,)" in repr(jf.Smoothed(x, x))


def test_trees_with_a_repr_are_trees_as_before(out):
    again = jax.tree.unflatten(jax.tree.structure(out), jax.tree.leaves(out))
    assert type(again) is jf.Info
    np.testing.assert_array_equal(again.mean, out.mean)
    assert jax.tree.structure(jf.kalman(MODEL)) == jax.tree.structure(jf.kalman(MODEL._replace(R=2 * np.eye(2))))
