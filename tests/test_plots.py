"""What the pictures show: lines, ellipses, regions, gaps and shares are those of the numbers given."""

from __future__ import annotations

import functools
import inspect
import math
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

import jaxfilt as jf

T = 30
RNG = np.random.default_rng(5)
LOST = np.isin(np.arange(T), [4, 11, 12, 13, 29])
MASK = ~LOST
HISTORY = jf.tune.History(np.array([10, 20, 30]), np.array([0.1, 0.3, 0.4]), np.array([np.inf, 3.0, 1.5]))
FRONT = jf.tune.Front(np.array([[3.0, 1.0], [1.0, 3.0], [2.0, 2.0]]), {"q": np.ones(3)})
TUNED = jf.tune.TuneResult({"q": 1.0}, 1.5, HISTORY, 30, 0.4, 2.0, "genetic")
BOTH = jf.tune.TuneResult({"q": 1.0}, 1.5, HISTORY, 30, 0.4, 2.0, "nsga2", FRONT)


@functools.cache
def run() -> tuple[jf.Info, np.ndarray, np.ndarray]:
    """A Kalman filter's output, the states, and the positions measured."""
    R = np.array([[4.0, 1.5], [1.5, 2.0]])  # leans the ellipses
    P0 = np.diag([9.0, 4.0, 1.0, 1.0])
    model = jf.models.constant_velocity(dt=1.0, q=0.1, r=1.0, m0=np.zeros(4), P0=P0)._replace(R=R)
    truth, ys = jf.simulate.simulate(model, T, jax.random.key(3))
    return jf.filter(jf.kalman(model), ys, mask=MASK, outputs=jf.everything), np.asarray(truth), np.asarray(ys)


@pytest.fixture(autouse=True)
def _close():
    yield
    plt.close("all")


def lines(ax, gid):
    return [line for line in ax.lines if line.get_gid() == gid]


def data(ax, gid):
    (line,) = lines(ax, gid)
    return np.array(line.get_data(), float)


def bounds(ax, gid):
    """Lower and upper edge (2, T) of the filled band."""
    (band,) = [c for c in ax.collections if c.get_gid() == gid]
    points = band.get_paths()[0].vertices
    x = np.unique(points[:, 0])
    return np.array([[f(points[points[:, 0] == v, 1]) for v in x] for f in (np.min, np.max)])


def names(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]


def test_a_track_shows_estimate_truth_measurements_and_lost_samples():
    out, truth, ys = run()
    unknown = truth.copy()
    unknown[5:8] = np.nan
    ax = jf.plots.track(out, truth=unknown, measurements=ys, mask=MASK, label="Kalman")
    np.testing.assert_array_equal(data(ax, "estimate"), out.mean[:, :2].T)
    np.testing.assert_array_equal(data(ax, "truth"), unknown[:, :2].T)
    np.testing.assert_array_equal(data(ax, "measurements"), ys[MASK].T)
    np.testing.assert_array_equal(data(ax, "lost")[:, LOST], out.mean[LOST, :2].T)
    assert np.isnan(data(ax, "lost")[:, MASK]).all()
    assert ax.get_aspect() == 1
    assert names(ax) == ["lost samples", "measurements", "truth", "Kalman", "start", "95 % ellipse"]
    ax.figure.canvas.draw()  # nothing warns


def test_what_the_status_reports_as_missed_is_lost_without_a_mask():
    out, _, ys = run()
    ax = jf.plots.track(out, measurements=ys)
    np.testing.assert_array_equal(np.isfinite(data(ax, "lost")[0]), LOST)


def test_ellipses_have_the_axes_of_the_marginal_covariance_at_the_probability():
    out, _, _ = run()
    ax = jf.plots.track(out, components=(2, 1), probability=0.5, ellipses=4)
    found = [patch for patch in ax.patches if isinstance(patch, Ellipse)]
    samples = [0, 10, 19, 29]
    assert len(found) == len(samples)
    for ellipse, k in zip(found, samples, strict=True):
        picked = np.ix_([2, 1], [2, 1])
        P = np.asarray(out.cov)[k][picked]
        turn = np.radians(ellipse.angle)
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        shape = R @ np.diag([ellipse.width / 2, ellipse.height / 2]) ** 2 @ R.T
        np.testing.assert_allclose(shape, P * -2 * np.log(0.5), rtol=1e-7, atol=1e-12)  # chi-square of 2 in closed form
        np.testing.assert_allclose(ellipse.center, np.asarray(out.mean)[k, [2, 1]])


def test_an_output_without_covariance_has_no_ellipse_and_no_band():
    out, truth, _ = run()
    bare = out._replace(cov=None)
    assert not jf.plots.track(bare).patches
    assert not jf.plots.estimate(bare, mask=np.ones(T, bool)).collections
    for ax in jf.plots.errors(bare, truth):
        assert not ax.collections
        assert "inside" not in ax.get_title("left")


def test_an_estimate_has_its_band_and_a_mark_for_every_gap():
    out, truth, ys = run()
    t = 0.5 * np.arange(T)
    mask = np.stack([MASK, np.ones(T, bool)], axis=1)  # the second component is there: no sample is lost
    for given, gaps in ((MASK, 3), (mask, 0)):
        ax = jf.plots.estimate(out, component=1, truth=truth, measurements=ys[:, 1], mask=given, times=t, unit="m")
        spans = [patch for patch in ax.patches if patch.get_gid() == "gap"]
        assert len(spans) == gaps
        np.testing.assert_array_equal(data(ax, "truth"), [t, truth[:, 1]])
        np.testing.assert_array_equal(data(ax, "measurements"), [t[MASK], ys[MASK, 1]])
        half = 2 * np.sqrt(np.asarray(out.cov)[:, 1, 1])
        np.testing.assert_allclose(bounds(ax, "band"), np.asarray(out.mean)[:, 1] + np.stack([-half, half]))
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("time [s]", "state 1 [m]")
        if gaps:
            np.testing.assert_allclose([span.get_x() for span in spans], [1.75, 5.25, 14.25])
            np.testing.assert_allclose([span.get_width() for span in spans], [0.5, 1.5, 0.25])


def test_a_second_estimate_has_another_color_and_the_gaps_are_marked_once():
    out, _, _ = run()
    ax = jf.plots.estimate(out)
    again = jf.plots.estimate(jf.rts(out), mask=MASK, ax=ax)
    assert again is ax
    first, second = lines(ax, "estimate")
    assert first.get_color() != second.get_color()
    assert len([patch for patch in ax.patches if patch.get_gid() == "gap"]) == 3
    assert names(ax)[-2:] == ["estimate", "smoothed"]


@pytest.mark.parametrize("components", [None, (3, 0)])
def test_error_panels_have_the_share_of_known_samples_inside(components):
    out, truth, _ = run()
    truth = truth.copy()
    truth[10:20] = np.nan
    axes = jf.plots.errors(out, truth, components=components, sigmas=1.0, names=components and ["vy", "x"])
    picked = range(4) if components is None else components
    assert axes.shape == (len(picked),)
    for ax, i in zip(axes, picked, strict=True):
        error = np.asarray(out.mean)[:, i] - truth[:, i]
        sigma = np.sqrt(np.asarray(out.cov)[:, i, i])
        np.testing.assert_array_equal(data(ax, "error")[1], error)
        np.testing.assert_allclose(bounds(ax, "band"), [-sigma, sigma])
        known = [k for k in range(T) if not 10 <= k < 20]
        share = 100 * sum(abs(error[k]) <= sigma[k] for k in known) / 20
        assert f": {share:.3g} % inside ±1σ (if consistent: 68.3 %)" in ax.get_title("left")
    axes[0].figure.canvas.draw()


def test_errors_draw_into_the_given_panels():
    out, truth, _ = run()
    figure = Figure()
    given = figure.subplots(2, 2)
    axes = jf.plots.errors(out, truth, axes=given)
    assert list(axes) == list(given.ravel())
    assert all(lines(ax, "error") for ax in given.ravel())
    with pytest.raises(ValueError, match="axes: expected 2"):
        jf.plots.errors(out, truth, components=(0, 1), axes=given)


@pytest.mark.parametrize("runs", [1, 40])
def test_consistency_shows_the_region_of_the_mean_over_runs(runs):
    values = RNG.chisquare(3, (runs, T))
    values[:, 7] = np.nan  # nothing there
    values[0, 8] = np.nan  # one run less
    ax = jf.plots.consistency(values if runs > 1 else values[0], 3, probability=0.9, label="NIS")
    low, high = (line.get_ydata() for line in lines(ax, "bound"))
    expected = jf.metrics.chi2_region(3, runs, 0.9)
    mean = data(ax, "mean")[1]
    for k in (0, 20):
        np.testing.assert_allclose((low[k], high[k]), expected)
        np.testing.assert_allclose(mean[k], values[:, k].mean())
    assert np.isnan([low[7], high[7], mean[7]]).all()
    if runs > 1:
        np.testing.assert_allclose((low[8], high[8]), jf.metrics.chi2_region(3, runs - 1, 0.9))
    known = ~np.isnan(mean)
    inside = sum(low[k] <= mean[k] <= high[k] for k in np.flatnonzero(known))
    assert f"NIS: {100 * inside / known.sum():.3g} % of {known.sum()}" in ax.get_title("left")
    assert set(data(ax, "expected")[1]) == {3.0}


def test_values_far_above_their_region_are_shown_on_a_logarithmic_scale():
    assert jf.plots.consistency(np.full(T, 3.0), 3).get_yscale() == "linear"
    assert jf.plots.consistency(np.full(T, 3000.0), 3).get_yscale() == "log"


def test_mode_probabilities_have_a_line_each_and_the_true_mode_above():
    p = RNG.dirichlet(np.ones(3), T)
    truth = np.repeat([0, 2, 0], [10, 15, 5])
    ax = jf.plots.mode_probabilities(p, names=["CV", "CA", "CT"], truth=truth)
    np.testing.assert_array_equal([line.get_ydata() for line in lines(ax, "probability")], p.T)
    strips = [c for c in ax.collections if c.get_gid() == "true mode"]
    spans = [[(path.vertices[:, 0].min(), path.vertices[:, 0].max()) for path in strip.get_paths()] for strip in strips]
    assert spans == [[(0, 9.5), (24.5, 29)], [(9.5, 24.5)]]
    assert names(ax) == ["CV", "CA", "CT"]


def test_fronts_show_solutions_and_the_edge_of_what_they_dominate():
    dominated = np.array([[1.0, 2.0], [2.0, 1.0], [2.0, 2.0], [3.0, 1.0]])
    ax = jf.plots.pareto(BOTH, FRONT, dominated, names=["bias [m]", "spread [m]"])
    edges = [np.array(line.get_data()).T.tolist() for line in lines(ax, "front")]
    assert edges == [[[1.0, 3.0], [2.0, 2.0], [3.0, 1.0]]] * 2 + [[[1.0, 2.0], [2.0, 1.0]]]
    assert [len(line.get_xdata()) for line in lines(ax, "solutions")] == [3, 3, 4]
    assert names(ax) == ["nsga2", "result 1", "result 2"]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("bias [m]", "spread [m]")


@pytest.mark.parametrize("against", ["evaluations", "wall_time"])
def test_tuning_shows_the_best_loss_against_its_cost(against):
    ax = jf.plots.tuning(TUNED, BOTH, against=against, labels=["GA", "NSGA-II"])
    line, _ = lines(ax, "best loss")
    np.testing.assert_array_equal(line.get_xdata(), getattr(HISTORY, against))
    np.testing.assert_array_equal(line.get_ydata(), [np.nan, 3.0, 1.5])
    assert names(ax) == ["GA: 1.5", "NSGA-II: 1.5"]


def test_memberships_are_those_that_the_library_computes():
    before, after = jf.fuzzy.partition(10.0, 3), jf.fuzzy.partition(10.0, 3, np.array([0.3, -0.4, 0.0, 0.5, 0.2]))
    ax = jf.plots.memberships(before, after, unit="m")
    x = np.linspace(0.0, 10.0, 41)
    for gid, corners in (("before", before), ("after", after)):
        drawn = [np.interp(x, *line.get_data(), left=0.0, right=0.0) for line in lines(ax, gid)]
        np.testing.assert_allclose(drawn, [jf.fuzzy.trapezoid(x, c) for c in np.asarray(corners)], atol=1e-12)
    assert all(line.get_linestyle() == "--" for line in lines(ax, "before"))
    triangles = jf.plots.memberships(np.array([[0.0, 1.0, 3.0]]), universe=4.0)
    np.testing.assert_array_equal(data(triangles, "before"), [[0, 1, 1, 3], [0, 1, 1, 0]])
    assert triangles.get_xlim() == (0.0, 4.0)


@pytest.mark.parametrize("root", [False, True])
def test_monte_carlo_curves_have_bands_of_their_standard_errors(root):
    values = RNG.chisquare(2, (50, T))
    ax = jf.plots.monte_carlo({"a": values, "one run": values[:1]}, root=root, probability=0.9, unit="m")
    mean, error = values.mean(axis=0), values.std(axis=0, ddof=1) / math.sqrt(50)
    if root:
        mean, error = np.sqrt(mean), error / (2 * np.sqrt(mean))
    first, _ = lines(ax, "mean")
    np.testing.assert_allclose(first.get_ydata(), mean)
    np.testing.assert_allclose(bounds(ax, "band"), mean + 1.6448536 * np.stack([-error, error]), rtol=1e-6)
    assert names(ax) == ["a (50 runs)", "one run (1 runs)"]
    assert ax.get_ylabel() == ("RMSE [m]" if root else "mean [m]")


def calls():
    out, truth, _ = run()
    p = np.full((T, 2), 0.5)
    return {
        "track": lambda ax: jf.plots.track(out, truth=truth, ax=ax),
        "estimate": lambda ax: jf.plots.estimate(out, ax=ax),
        "consistency": lambda ax: jf.plots.consistency(np.ones(T), 2, ax=ax),
        "mode_probabilities": lambda ax: jf.plots.mode_probabilities(p, ax=ax),
        "pareto": lambda ax: jf.plots.pareto(FRONT, ax=ax),
        "tuning": lambda ax: jf.plots.tuning(TUNED, ax=ax),
        "memberships": lambda ax: jf.plots.memberships(jf.fuzzy.partition(10.0), ax=ax),
        "monte_carlo": lambda ax: jf.plots.monte_carlo({"a": np.ones((2, T))}, ax=ax),
    }


def test_every_function_draws_into_the_given_axes_and_nowhere_else():
    functions = {name for name, x in vars(jf.plots).items() if inspect.isfunction(x)}
    assert functions == {*calls(), "errors"}
    before = dict(plt.rcParams)
    for call in calls().values():
        ax = Figure().subplots()
        assert call(ax) is ax
        assert ax.lines
    assert not plt.get_fignums()
    assert dict(plt.rcParams) == before


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda o, x, y: jf.plots.track(3), TypeError, "out: expected what jf.filter"),
        (lambda o, x, y: jf.plots.track(np.ones((3, 3))), TypeError, "out: expected what jf.filter"),
        (lambda o, x, y: jf.plots.track(jax.tree.map(lambda a: a[None], o)), ValueError, "pick a run"),
        (lambda o, x, y: jf.plots.track(o, components=(0, 9)), ValueError, "components: "),
        (lambda o, x, y: jf.plots.track(o, components=(0,)), ValueError, "components: expected two"),
        (lambda o, x, y: jf.plots.track(o, truth=x[:, :3]), ValueError, "truth: "),
        (lambda o, x, y: jf.plots.track(o, truth=np.stack([x, x])), ValueError, "truth: .* pick one"),
        (lambda o, x, y: jf.plots.track(o, measurements=y[:-1]), ValueError, "measurements: "),
        (lambda o, x, y: jf.plots.estimate(o, measurements=y), ValueError, "measurements: .* column"),
        (lambda o, x, y: jf.plots.track(o, mask=MASK.astype(float)), TypeError, "mask: expected bool"),
        (lambda o, x, y: jf.plots.track(o, mask=MASK[1:]), ValueError, "mask: "),
        (lambda o, x, y: jf.plots.track(o, probability=1.0), ValueError, "probability: "),
        (lambda o, x, y: jf.plots.track(o, ellipses=-1), ValueError, "ellipses: "),
        (lambda o, x, y: jf.plots.track(o, ax=3), TypeError, "ax: expected a matplotlib Axes"),
        (lambda o, x, y: jf.plots.estimate(o, component=4), ValueError, "component: "),
        (lambda o, x, y: jf.plots.estimate(o, sigmas=0), ValueError, "sigmas: "),
        (lambda o, x, y: jf.plots.estimate(o, times=np.arange(3)), ValueError, "times: "),
        (lambda o, x, y: jf.plots.estimate(o, label=3), TypeError, "label: "),
        (lambda o, x, y: jf.plots.errors(o, x[:, :2]), ValueError, "truth: "),
        (lambda o, x, y: jf.plots.errors(o, x, names=["x"]), ValueError, "names: expected 4"),
        (lambda o, x, y: jf.plots.consistency(-np.ones(3), 2), ValueError, "values: "),
        (lambda o, x, y: jf.plots.consistency(np.full(3, np.nan), 2), ValueError, "values: "),
        (lambda o, x, y: jf.plots.consistency(np.ones(3), 0), ValueError, "dof: "),
        (lambda o, x, y: jf.plots.mode_probabilities(np.log(np.full((3, 2), 0.1))), ValueError, "logarithms"),
        (lambda o, x, y: jf.plots.mode_probabilities(np.ones((3, 1)), truth=[0, 1, 0]), ValueError, "truth: "),
        (lambda o, x, y: jf.plots.pareto(), ValueError, "results: "),
        (lambda o, x, y: jf.plots.pareto(TUNED), ValueError, "results: genetic has one loss"),
        (lambda o, x, y: jf.plots.pareto(np.ones((4, 3))), ValueError, "results: "),
        (lambda o, x, y: jf.plots.tuning(FRONT), TypeError, "results: "),
        (lambda o, x, y: jf.plots.tuning(TUNED, against="cost"), ValueError, "against: "),
        (lambda o, x, y: jf.plots.memberships(np.array([[2.0, 1.0, 3.0, 4.0]])), ValueError, "before: .* in order"),
        (lambda o, x, y: jf.plots.memberships(np.ones((2, 4)), np.ones((3, 4))), ValueError, "after: expected 2"),
        (lambda o, x, y: jf.plots.monte_carlo({}), TypeError, "curves: "),
        (lambda o, x, y: jf.plots.monte_carlo({"a": np.ones(3)}), ValueError, r"curves\['a'\]: "),
        (lambda o, x, y: jf.plots.monte_carlo({"a": -np.ones((2, 3))}, root=True), ValueError, r"curves\['a'\]: "),
        (lambda o, x, y: jf.plots.monte_carlo({"a": np.array([[1.0], [np.nan]])}), ValueError, r"curves\['a'\]: "),
    ],
)
def test_wrong_input_is_refused_by_name_and_leaves_no_figure(call, error, message):
    with pytest.raises(error, match=message):
        call(*run())
    assert not plt.get_fignums()


def test_what_is_traced_is_refused():
    def drawn(x):
        return jf.plots.estimate(SimpleNamespace(mean=x, cov=None))

    with pytest.raises(TypeError, match="out: is traced"):
        jax.jit(drawn)(np.ones((3, 2)))


def test_without_matplotlib_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    for call in calls().values():
        with pytest.raises(ImportError, match=r'pip install "jaxfilt\[plot\]"'):
            call(None)


def test_importing_the_library_imports_no_extra():
    code = "import sys, jaxfilt; print(sorted({'matplotlib', 'tqdm', 'pandas', 'plotly', 'pymoo'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[1], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr
