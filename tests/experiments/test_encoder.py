"""The capacitive encoder: exact checks and acceptance bands of specification S4f, section 6, and published tables."""

from __future__ import annotations

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.__main__ import ROOT
from experiments.encoder import estimators, network, recorded, system
from experiments.encoder import run as encoder
from experiments.encoder.estimators import (
    ALPHA_BETA,
    ARCTAN,
    ELLIPSE,
    FIXED,
    OWN,
    RADIUS,
    SMOOTH,
    SUPERVISED,
)
from experiments.report import Report, compare
from jaxfilt import sincos

pytestmark = pytest.mark.xdist_group("encoder")

MOVES = ("10° move", "3° move")


@functools.cache
def published():
    return json.loads((ROOT / "encoder" / "published.json").read_text(encoding="utf-8"))


def median(scores, name, part, q=0.5):
    return float(np.quantile(scores[name][f"{part} max"], q))


# --------------------------------------------------------------------------------------------------------- exact checks


@pytest.mark.parametrize(
    "c",
    [
        network.Capacitances(),
        network.Capacitances(adjacent=2.0, mean=1.3),  # both drop out
        network.Capacitances(7.0, 20.0, 0.5, 0.4, 1.1, 9.0, 2.5, 2.0),
    ],
)
def test_the_network_gives_four_phases_and_the_closed_form_gain(c):
    angles = np.linspace(0, 2 * np.pi, 50)
    got = np.array([network.receiver_voltages(theta, c) for theta in angles])
    gain = network.network_gain(c)
    expected = gain * np.stack([np.cos(angles), np.sin(angles), -np.cos(angles), -np.sin(angles)], 1)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)
    if (c.stator, c.rotor) == (10.0, 14.0):
        np.testing.assert_allclose(gain, 0.0690714, rtol=1e-6)


def test_demodulation_at_the_carrier():
    """One sample per carrier period; the angle moves within it, which leaves an error of the order of 1e-4 rad."""
    t = np.arange(50 * 400) / network.SAMPLING
    ys = np.asarray(network.demodulated(jnp.asarray(2 * np.pi * 37.0 * t)))
    middle = 2 * np.pi * 37.0 * (t.reshape(-1, 50).mean(axis=1))
    error = np.angle(np.exp(1j * (np.arctan2(ys[:, 1], ys[:, 0]) - middle)))
    assert 1e-5 < np.abs(error).max() < 1.3e-4


OMEGA = {10: 6292, 12: 2545, 14: 1274, 16: 305}  # [rad/s]
# Of the sheet's last printed digit of t1, t2 and K_a.
DIGITS = {10: (1e-4, 1e-6, 1e5), 12: (1e-3, 1e-6, 1e5), 14: (1e-3, 1e-6, 1e5), 16: (1e-3, 1e-6, 100.0)}


@pytest.mark.parametrize("bits", sorted(network.LOOPS))
def test_the_converter_s_loop_agrees_with_its_data_sheet(bits):
    for value, printed, digit in zip(network.loop_constants(bits), network.LOOPS[bits][1], DIGITS[bits], strict=True):
        # two of the twelve are 1.1 and 1.4 % off, because the sheet prints two digits of them
        assert abs(value / printed - 1) <= 0.01 or abs(value - printed) <= 0.5 * digit
    np.testing.assert_allclose(np.sqrt(network.loop_constants(bits)[2]), OMEGA[bits], rtol=2e-3)
    t1, _, gain = network.loop_constants(bits)
    assert 1.15 < gain * t1 / (2 * np.sqrt(gain)) < 1.3


def test_gains_of_the_converter_s_loop_at_20_khz():
    alpha, beta = network.loop_gains(10, 50e-6)
    np.testing.assert_allclose([alpha, beta], [0.79, 0.099], rtol=0.01)


@pytest.mark.parametrize("cycles", [20, 40])
def test_ring_to_first_order(cycles):
    """The mechanical error is half of eccentricity times tilt, whatever the number of cycles."""
    offset, tilt = 30e-6, 0.2 * np.exp(0.4j)
    for direction in (0.9, 2.0, -1.0):
        ring = system.Ring(*(jnp.asarray(z) for z in (offset * np.exp(1j * direction), 0j, tilt, 0j)))
        G = system.ring_gain(jnp.linspace(0, 6.0, 9), ring, cycles)
        expected = 0.5 * offset / system.RADIUS * 0.2 * np.sin(direction - 0.4)
        # at 40 cycles the shift within the ring is 0.067 rad; the formula is its first order
        np.testing.assert_allclose(np.angle(G) / cycles, expected, rtol=0.02)
    np.testing.assert_allclose(np.rad2deg(0.5 * offset / system.RADIUS * 0.2), 0.0095, rtol=0.01)


def test_eccentricity_alone_only_lowers_the_amplitude():
    ring = system.Ring(*(jnp.asarray(z) for z in (100e-6 + 0j, 0j, 0j, 0j)))
    G = system.ring_gain(jnp.zeros(1), ring)[0]
    assert abs(float(jnp.angle(G))) < 1e-12
    assert 0.5 < float(jnp.abs(G)) < 1


def test_the_motion_turns_once_and_moves_in_ten_steps_each():
    angle = np.asarray(system.motion(jax.random.key(3)))
    assert angle.shape == (16300,)
    np.testing.assert_allclose(angle[system.TURN - 1], 360, atol=1e-4)
    for move, points in system.HOLDS.items():
        np.testing.assert_allclose(angle[points[-1]] - angle[points[0]], move, atol=1e-9)
        np.testing.assert_allclose(angle[points], angle[points - system.HOLD + 1], atol=1e-9)
        assert (np.diff(angle[points]) > 0.3 * move / 10).all()


# ---------------------------------------------------------------------------------------------------------------- bands


@functools.cache
def small(seed=1, runs=80):
    """Without the costlier filters."""
    data = system.draw(runs, seed)
    ys, ideal = data.ys, estimators.ideal(runs + 1)
    found = {
        ARCTAN: estimators.angles(ys, ideal, estimators.COUNTS),
        ELLIPSE: estimators.angles(ys, ideal._replace(**estimators.ellipse_parameters(estimators.ellipses(ys)))),
        OWN: estimators.track(estimators.own_ekf, ys, estimators.WITH_H3)[..., 0],
    }
    return encoder.split({name: estimators.scores(theta, data.angle) for name, theta in found.items()})


def check(scores):
    """For at least 40 draws. By single move the filter is better in 93 to 99 % of the devices, so the moves are pooled.

    The shares and ratios by move are in the published table. 40 draws scatter too much: a median ratio of 3.6 is known
    to 0.4 then.
    """
    own, arctan = scores[OWN], scores[ARCTAN]
    for part in MOVES:
        assert 0.04 <= median(scores, ARCTAN, part) <= 0.09
        assert median(scores, ARCTAN, part, 0.9) <= 0.14
        assert median(scores, ELLIPSE, part) <= 0.04
        assert np.median(arctan[f"{part} rms"] / own[f"{part} rms"]) >= 3
    ratio = arctan["moves rms"] / own["moves rms"]
    assert np.mean(ratio > 1) >= 0.95
    assert np.median(ratio) >= 3
    assert median(scores, OWN, "10° move") <= 0.025
    assert median(scores, OWN, "3° move") <= 0.020


def test_bands():
    check(small()[0])


def test_published_table_agrees_with_another_seed():
    scores = small()[0]
    keep = published()
    table = keep["tables"]["encoder"]
    table = {**table, "rows": [row for row in table["rows"] if row[0] in scores]}
    result = encoder.Result(80, scores, {}, {}, {}, {}, {}, None)
    again = Report("encoder", "", [encoder.main_table(result)])
    assert compare({"tables": {"encoder": table}}, again) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_bands_of_everything(seed):
    result = encoder.simulate(120, 20, seed)
    check(result.scores)
    for part in MOVES:
        plain = median(result.scores, "arctan", part)
        for name in (ALPHA_BETA, FIXED):
            assert abs(median(result.scores, name, part) / plain - 1) <= 0.15
        assert np.median(result.causes["noise"][f"{part} max"]) <= 0.007
        assert median(result.calibration, estimators.SUPERVISED, part) <= 0.010
        assert median(result.calibration, SMOOTH, part) < median(result.calibration, RADIUS, part)
    for found in result.found.values():
        assert float(np.asarray(found.slope).max()) < 1e-5
        assert 5 <= int(np.asarray(found.evaluations).min())
        assert int(np.asarray(found.evaluations).max()) <= 60
    report = Report("encoder", "", [encoder.main_table(result), encoder.causes_table(result),
                                    encoder.calibration_table(result)])  # fmt: skip
    assert compare(published(), report) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_gradient_and_genetic_algorithm_find_the_same(seed):
    data = system.draw(0, seed)
    _, tuned = encoder.tuner_table(data, estimators.calibrate(SUPERVISED, data.ys, data.angle), seed, 80)
    (gradient, count), (genetic, many) = tuned["L-BFGS"], tuned["genetic algorithm"]
    assert genetic >= gradient * (1 - 1e-9)
    assert genetic <= 1.05 * gradient
    assert count <= 30 < many


@pytest.mark.slow
def test_the_converter_s_own_loop_is_next_to_arctan():
    _, apart = encoder.converter_loop(system.draw(0, 0))
    assert apart < 2e-4


# ------------------------------------------------------------------------------------------------------------- recorded


def test_published_ellipses_and_converter():
    report = Report("encoder", "", [recorded.ellipse_table(), encoder.converter_table()])
    assert compare(published(), report) == []


def test_verdicts_on_the_records_ellipses():
    verdicts = {row[0]: row[8] for row in recorded.ellipse_table().rows}
    assert verdicts == {
        "angle_trial02_b": "accepted",
        "angle_trial02_a": "refused: too little of a cycle",
        "angle_trial03": "accepted",
    }
    with pytest.raises(ValueError, match=r"expected samples of 0\.75 of the cycle"):
        recorded.ellipse_of(recorded.load("angle_trial02_a"))


def test_the_signals_lag_behind_the_reference_by_the_same_time_on_all_records():
    lag, se = recorded.delay()
    assert 0.012 < lag < 0.020
    for name in recorded.SCORED:
        record = recorded.load(name)
        theta = np.arctan2(record.ys[:, 1], record.ys[:, 0])
        before, after = (recorded.error(theta, recorded.aligned(record, x)) for x in (0.0, lag))
        assert np.nanmean(after**2) < 0.6 * np.nanmean(before**2)
    assert se < 0.2 * lag


def test_rows_are_masked_by_tilt():
    kept = {name: int(recorded.load(name).usable.sum()) for name in (recorded.CALIBRATION, *recorded.SCORED)}
    assert kept == {"angle_trial02_b": 3945, "angle_trial02_a": 3974, "angle_trial03": 2428}


def test_supervised_calibration_lowers_the_error_that_it_was_given():
    record = recorded.load(recorded.CALIBRATION)
    ys = jnp.asarray(record.ys[record.usable] / recorded.amplitude())
    angle = jnp.asarray(record.angle[record.usable])
    p = recorded.calibrate(SUPERVISED, ys, angle)
    before = sincos.supervised_loss(sincos.Parameters(), ys, angle)
    assert 0.7 < float(sincos.supervised_loss(p, ys, angle) / before) < 1.0


@pytest.mark.slow
def test_published_recorded_table_agrees():
    result = recorded.run(recorded.published())
    late = recorded.run(recorded.published(), recorded.delay()[0])
    tables = [recorded.table(result), recorded.aligned_table(late), recorded.noise_table(result.noise)]
    report = Report("encoder", "", tables)
    assert compare(published(), report) == []
