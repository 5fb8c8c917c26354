"""The Monte-Carlo runner: the same numbers whatever the chunk, one bad run alone, honest standard errors."""

import errno
import io
import os
import socket
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxfilt as jf
from jaxfilt.checkpoint import Store
from jaxfilt.core import Wrapped
from jaxfilt.metrics import mse, nees
from jaxfilt.montecarlo import _choose_chunk
from jaxfilt.simulate import gap_mask, simulate

KEY = jax.random.key(5)
GAP = (20, 25)
MASK = gap_mask(41, GAP)


def gap_model(q=0.1, dtype: Any = float):
    P0 = np.diag([100.0, 25.0]).astype(dtype)
    return jf.models.constant_velocity(dt=1.0, q=q, r=25.0, m0=np.array([0.0, 10.0], dtype), P0=P0)


def gap_scenario(**options):
    return jf.scenario(gap_model(), 41, mask=MASK, first_update_only=True, **options)


traces = 0


def gap_score(truth, ys, out):
    global traces
    traces += 1
    del ys
    return {
        "gap": mse(out.mean, truth, components=[0], window=GAP),
        "after": mse(out.mean, truth, components=[0], window=(26, 30)),
        "nees": nees(out.mean[GAP[1]], out.cov[GAP[1]], truth[GAP[1]], components=[0]),
    }


FILTERS = {"matched": jf.kalman(gap_model()), "wrong": jf.kalman(gap_model(q=10.0))}
run = partial(jf.monte_carlo, gap_scenario(), FILTERS, gap_score)


@pytest.fixture(scope="module")
def hundred():
    return run(100, KEY, chunk=32)  # the last chunk is cut


def assert_same_scores(a, b, runs=None):
    for name in a.scores:
        for score in a.scores[name]:
            np.testing.assert_allclose(a.scores[name][score][:runs], b.scores[name][score][:runs], rtol=1e-12)
        np.testing.assert_array_equal(a.status[name][:runs], b.status[name][:runs])


@pytest.mark.parametrize("chunk", [1, None])
def test_scores_do_not_depend_on_the_chunk(hundred, chunk):
    assert_same_scores(hundred, run(100, KEY, chunk=chunk))


def test_more_runs_begin_with_the_fewer_and_nothing_compiles_again(hundred):
    before = traces
    more = run(150, KEY, chunk=32)
    assert_same_scores(hundred, more, runs=100)
    other = jf.monte_carlo(
        gap_scenario(),
        {name: jf.kalman(gap_model(q=0.2)) for name in FILTERS},
        gap_score,
        40,
        jax.random.key(1),
        chunk=32,
    )
    assert traces == before
    assert (other.scores["matched"]["gap"] != hundred.scores["matched"]["gap"][:40]).all()
    assert more.scores["matched"]["gap"].shape == more.status["matched"].shape == (150,)


def test_scores_are_those_of_single_runs(hundred):
    key = jax.random.fold_in(jax.random.fold_in(KEY, 37), 0)
    truth, ys = simulate(gap_model(), 41, key, first_update_only=True)
    for name, filt in FILTERS.items():
        expected = gap_score(truth, ys, jf.filter(filt, ys, mask=MASK, first_update_only=True))
        for score, value in expected.items():
            np.testing.assert_allclose(hundred.scores[name][score][37], value, rtol=1e-12)


def test_matched_coasting_reproduces_the_known_figures():
    result = run(2000, KEY)
    assert 4.7 < result.root_mean("matched", "gap").value < 5.6
    assert 0.8 < result.mean("matched", "nees").value < 1.2
    # The root of the exact mean variance over the gap is 5.2012.
    estimate = result.root_mean("matched", "gap")
    assert abs(estimate.value - 5.2012) < 4 * estimate.standard_error
    worse = result.ratio(("wrong", "gap"), ("matched", "gap"), root=True)
    assert worse.value - 4 * worse.standard_error > 1
    assert result.status_counts("matched") == {jf.Status.MISSED: 2000}
    assert result.runs_per_second > 0
    with pytest.raises(ValueError, match="filter: expected one of"):
        result.mean("none", "gap")
    with pytest.raises(ValueError, match="score: expected one of"):
        result.mean("matched", "none")


def spoiled(bad_key, key):
    truth, ys = simulate(gap_model(), 41, key, first_update_only=True)
    bad = (jax.random.key_data(key) == jax.random.key_data(bad_key)).all()
    return truth, jnp.where(bad & (jnp.arange(41) == 7)[:, None], jnp.nan, ys)


def test_one_bad_run_leaves_the_others_bitwise_unchanged():
    def result(bad_run):
        bad_key = jax.random.fold_in(jax.random.fold_in(KEY, bad_run), 0)
        scenario = jf.Scenario(Partial(spoiled, bad_key), mask=MASK, first_update_only=True)
        return jf.monte_carlo(scenario, FILTERS, gap_score, 64, KEY, chunk=32)

    good, bad = result(1000), result(41)
    others = np.arange(64) != 41
    for name in FILTERS:
        for score in good.scores[name]:
            np.testing.assert_array_equal(good.scores[name][score][others], bad.scores[name][score][others])
        assert bad.status_counts(name) == {jf.Status.MISSED: 64, jf.Status.NONFINITE: 1}
        assert bad.status[name][41] & jf.Status.NONFINITE
        assert np.isfinite(bad.scores[name]["gap"]).all()


def own_mask(mask, key):
    return jf.Draw(*simulate(gap_model(), 41, key, first_update_only=True), mask=mask)


def test_a_mask_may_come_with_the_run(hundred):
    scenario = jf.Scenario(Partial(own_mask, jnp.asarray(MASK)), first_update_only=True)
    assert_same_scores(hundred, jf.monte_carlo(scenario, FILTERS, gap_score, 100, KEY, chunk=100))


def _keyed_update(p, state, inp):
    state, info = p.inner.update(state.inner, inp)
    return Wrapped(state), info._replace(extra={"draw": jax.random.uniform(inp.key)})


def draw_score(truth, ys, out):
    del truth, ys
    return {"draw": out.extra["draw"]}


class Params(NamedTuple):
    inner: jf.Filter


def test_filters_that_draw_get_a_key_of_their_own_per_run():
    filt = jf.wrap(Params(FILTERS["matched"]), update=_keyed_update)
    result = jf.monte_carlo(jf.scenario(gap_model(), 5), {"a": filt, "b": filt}, draw_score, 6, KEY, chunk=4)
    draws = result.scores["a"]["draw"]
    assert draws.shape == (6, 5)
    assert len(np.unique(draws)) == 30
    np.testing.assert_array_equal(draws, result.scores["b"]["draw"])
    key = jax.random.fold_in(jax.random.fold_in(KEY, 2), 1)
    np.testing.assert_array_equal(draws[2, 3], jax.random.uniform(jax.random.fold_in(key, 4)))


def test_float32_models_stay_float32():
    model = gap_model(dtype=np.float32)
    scenario = jf.scenario(model, 41, mask=MASK, dt=1.0, first_update_only=True)
    result = jf.monte_carlo(scenario, {"f32": jf.kalman(model)}, gap_score, 16, KEY, chunk=16)
    assert result.scores["f32"]["gap"].dtype == np.float32
    assert np.isfinite(result.scores["f32"]["gap"]).all()


def test_devices_share_the_chunk_and_give_the_same_numbers(hundred):
    code = (
        f"import sys, numpy as np, jax; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "jax.config.update('jax_enable_x64', True)\n"
        "import test_montecarlo as t; assert len(jax.devices()) == 2\n"
        "r = t.run(100, t.KEY, chunk=31); assert r.chunk == 32\n"
        "np.save(sys.stdout.buffer, r.scores['matched']['gap'])\n"
    )
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    done = subprocess.run([sys.executable, "-c", code], env={**os.environ, "XLA_FLAGS": flags}, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
    np.testing.assert_allclose(np.load(io.BytesIO(done.stdout)), hundred.scores["matched"]["gap"], rtol=1e-12)


def test_processes_share_the_runs_and_all_get_the_same_numbers(hundred, tmp_path):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    code = (
        f"import sys, numpy as np, jax; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "jax.config.update('jax_enable_x64', True)\n"
        f"jax.distributed.initialize('localhost:{port}', 2, int(sys.argv[1]), initialization_timeout=60)\n"
        "import test_montecarlo as t; assert jax.process_count() == 2\n"
        "np.save(sys.argv[2], t.run(100, t.KEY, chunk=16).scores['matched']['gap'])\n"
    )
    files = [tmp_path / "0.npy", tmp_path / "1.npy"]
    command = [sys.executable, "-c", code]
    both = [subprocess.Popen([*command, str(i), str(f)], stderr=subprocess.PIPE) for i, f in enumerate(files)]
    for process in both:
        _, errors = process.communicate(timeout=120)
        assert process.returncode == 0, errors.decode()
    for file in files:
        np.testing.assert_allclose(np.load(file), hundred.scores["matched"]["gap"], rtol=1e-12)


def interrupt_after(chunks, directory, monkeypatch):
    """A job of 100 runs is interrupted when it has stored so many chunks."""
    save = Store.save

    def then_stop(self, first, result):
        save(self, first, result)
        if len(list(self._directory.glob("*.npz"))) == chunks:
            raise KeyboardInterrupt

    monkeypatch.setattr(Store, "save", then_stop)
    with pytest.raises(KeyboardInterrupt):
        run(100, KEY, chunk=32, checkpoint=directory)
    monkeypatch.setattr(Store, "save", save)


def test_an_interrupted_job_goes_on_where_it_was(hundred, tmp_path, monkeypatch):
    """With the same numbers to the bit; a damaged file is computed again; more runs may be asked for."""
    interrupt_after(2, tmp_path, monkeypatch)
    (tmp_path / "runs-000000000032.npz").write_bytes(b"PK damaged")
    stored = []
    save = Store.save
    monkeypatch.setattr(Store, "save", lambda self, first, result: stored.append(first) or save(self, first, result))
    for runs, computed in ((100, [32, 64, 96]), (100, []), (130, [128])):
        stored.clear()
        again = run(runs, KEY, checkpoint=tmp_path)  # the chunk is that of the stored job
        assert again.chunk == 32
        assert stored == computed
        for name, scores in hundred.scores.items():
            for score, values in scores.items():
                np.testing.assert_array_equal(again.scores[name][score][:100], values)
            np.testing.assert_array_equal(again.status[name][:100], hundred.status[name])


def test_the_results_of_another_job_are_not_taken(tmp_path):
    run(32, KEY, chunk=32, checkpoint=tmp_path)
    for other, options in ((jax.random.key(6), {}), (KEY, {"chunk": 16})):
        with pytest.raises(ValueError, match=r"checkpoint: .* holds another job"):
            run(32, other, **{"chunk": 32, **options}, checkpoint=tmp_path)
    filters = {**FILTERS, "wrong": jf.kalman(gap_model(q=11.0))}
    with pytest.raises(ValueError, match=r"checkpoint: .* holds another job"):
        jf.monte_carlo(gap_scenario(), filters, gap_score, 32, KEY, chunk=32, checkpoint=tmp_path)


def test_a_full_disk_does_not_stop_a_job(hundred, tmp_path, monkeypatch):
    def full(source, target):
        if str(target).endswith("64.npz"):
            raise OSError(errno.ENOSPC, "No space left on device")
        os.rename(source, target)

    monkeypatch.setattr(os, "replace", full)
    with pytest.warns(UserWarning, match="checkpoint: a chunk could not be stored .*No space left"):
        assert_same_scores(hundred, run(100, KEY, chunk=32, checkpoint=tmp_path))
    assert sorted(f.name[-7:] for f in tmp_path.iterdir()) == ["000.npz", "032.npz", "096.npz", "ob.json"]


def test_chunks_are_powers_of_two_that_fit_memory():
    assert _choose_chunk(100_000, 8_000, 2**28) == 4096
    assert _choose_chunk(100_000, 1_000_000, 2**28) == 256
    assert _choose_chunk(100, 8_000, 2**28) == 128
    assert _choose_chunk(10, 10**12, 2**28) == 1
    assert _choose_chunk(1, 8_000, 2**28) == 1


class Large(NamedTuple):
    inner: jf.Filter
    size: jf.Static


def _large_update(p, state, inp):
    # Memory that the outputs do not show.
    n = p.size.value
    matrix = jnp.cos(inp.y[0] * jnp.arange(n * n, dtype=inp.y.dtype).reshape(n, n))
    state, info = p.inner.update(state.inner, inp)
    return Wrapped(state), info._replace(extra={"largest": (matrix @ matrix).max()})


def largest_score(truth, ys, out):
    del truth, ys
    return {"largest": out.extra["largest"][-1]}


def test_what_a_filter_needs_in_between_counts_too():
    large = jf.wrap(Large(FILTERS["matched"], jf.Static(40)), update=_large_update)
    job = (jf.scenario(gap_model(), 5), {"large": large}, largest_score, 100, KEY)
    assert jf.monte_carlo(*job, memory_limit=2**20).chunk < 128


def test_the_progress_bar_counts_runs(capsys, monkeypatch):
    pytest.importorskip("tqdm")
    run(100, KEY, chunk=32, progress=True)
    assert "100/100" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    with pytest.raises(ImportError, match=r'pip install "jaxfilt\[progress\]"'):
        run(100, KEY, chunk=32, progress=True)


def not_a_dict(truth, ys, out):
    del truth, ys
    return out.mean[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"runs": 0}, "runs: expected an int >= 1"),
        ({"runs": 1e3}, "runs: expected an int >= 1"),
        ({"chunk": 0}, "chunk: expected an int >= 1"),
        ({"filters": {}}, "filters: expected at least one"),
        ({"score": not_a_dict}, "score: expected a dict of arrays, got"),
        ({"scenario": gap_scenario()._replace(mask=MASK[:40])}, "mask: expected shape"),
        ({"scenario": gap_scenario()._replace(dt=np.full(41, -1.0))}, "dt: expected finite intervals"),
    ],
)
def test_bad_arguments_are_refused(change, message):
    arguments = {
        "scenario": gap_scenario(),
        "filters": FILTERS,
        "score": gap_score,
        "runs": 10,
        "key": KEY,
        "chunk": 32,
    }
    with pytest.raises(ValueError, match=message):
        jf.monte_carlo(**{**arguments, **change})


def wiener_acceleration():
    P0 = np.diag([0.1, 0.1, 0.1, 0.1, 0.5, 0.5])
    return jf.models.constant_acceleration(dt=0.5, q=0.2, r=10.0, m0=np.zeros(6), P0=P0)


def from_rest(key):
    return simulate(wiener_acceleration(), 50, key, x0=np.zeros(6))


def position_score(truth, ys, out):
    del ys
    return {
        "filtered": mse(out.mean, truth, components=[0, 1]) / 2,
        "smoothed": mse(jf.rts(out).mean, truth, components=[0, 1]) / 2,
        "nis": out.nis.mean() / 2,
    }


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_planar_wiener_acceleration_has_the_known_errors(seed):
    filters = {"kf": jf.kalman(wiener_acceleration())}
    result = jf.monte_carlo(jf.Scenario(from_rest), filters, position_score, 500, jax.random.key(seed))
    assert 3.6 < result.mean("kf", "filtered").value < 4.3
    assert 0.93 < result.mean("kf", "smoothed").value < 1.12
    assert 0.9 < result.mean("kf", "nis").value < 1.05


def test_planar_wiener_acceleration_has_the_known_steady_gain():
    out = jf.filter(jf.kalman(wiener_acceleration()), np.zeros((200, 2)))
    gain = out.cov[-1][:, :2] / 10.0  # K = P H' R^-1
    np.testing.assert_allclose(gain[::2, 0], [0.44278, 0.25711, 0.07465], atol=1e-5)
    np.testing.assert_allclose(gain[1::2, 1], [0.44278, 0.25711, 0.07465], atol=1e-5)
