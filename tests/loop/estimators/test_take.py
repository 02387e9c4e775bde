"""Readings of references beside vision in the filter: what they add, whether it knows, and in what order they come."""

from dataclasses import replace

import numpy as np
import pytest
from arm_rig import ARM, MIDDLE, TICK_S, legs, measured, mounts, off, sampled, seen, small, states
from scipy.stats import chi2
from wire import Wire

from armsight.errors import InputError
from armsight.loop.estimators import Delay, KalmanEstimator, Outcome, Prior
from armsight.loop.references.inertial import ACCELEROMETER, Inertial
from armsight.loop.references.reference import Reading, ToolMotion

#: Three wires that cross at the workspace; each calibrated to 0.02 mm.
ANCHORS = np.array([[1.2, 0.1, 0.7], [0.2, 1.0, 0.7], [0.2, 0.1, 1.8]])
COV = np.diag([*np.full(4, 2e-5**2), 1e-12])
SIGMA_M = 5e-5
CHANCE = 1e-4


def wires(rng):
    """Wires as they are, and as their calibration says."""
    said = [
        Wire(name=f"wire {k}", cov=COV, values=np.array([*at, 0.0, 0.0]), sigma_delay_s=1e-4)
        for k, at in enumerate(ANCHORS)
    ]
    return [
        replace(w.moved(rng.normal(size=5) * np.sqrt(np.diag(COV))), delay_s=rng.normal() * 1e-4) for w in said
    ], said


def world(seed, seconds=2.0, blind_s=1.5):
    """A sampled arm: its shaft, noisy readings, true poses, pose measurements of vision until it is blind, and wires'."""
    rng = np.random.default_rng(seed)
    shaft, (true, mounting), (hung, said) = legs(rng, seconds), mounts(rng), wires(rng)
    Ts = sampled(rng).tool(shaft)
    q = shaft + rng.normal(size=shaft.shape) * Prior().reading_rad
    looks = [measured(mounting, seen(rng, Ts[k], true), k * TICK_S) for k in range(20, int(blind_s / TICK_S), 16)]
    lengths = []
    for n, k in enumerate(range(1003, len(shaft) - 5, 6)):  # one after the other
        wire, name = hung[n % 3], said[n % 3]
        at = k - wire.delay_s / TICK_S
        low = int(at)
        T = Ts[low] @ small((at - low) * off(Ts[low], Ts[low + 1]))
        z = wire.expected(ToolMotion(T), 0).z + rng.normal(0.0, SIGMA_M, 1)
        lengths.append((name, Reading(k * TICK_S, 0, z, SIGMA_M**2 * np.eye(1))))
    return shaft, q, Ts, looks, lengths


def fed(q):
    estimator = KalmanEstimator(ARM, delay=Delay(0.0, 2e-4))
    estimator.joints(states(np.arange(len(q)) * TICK_S, q))
    return estimator


def go(q, looks, lengths):
    """Give everything in order of time, 0.1 s of readings at a time; return the estimator."""
    estimator, events = KalmanEstimator(ARM, delay=Delay(0.0, 2e-4)), []
    events += [(m.t_s, estimator.vision, (m,)) for m in looks]
    events += [(r.t_s, estimator.take, (w, r)) for w, r in lengths]
    events.sort(key=lambda e: e[0])
    for begin in range(0, len(q), 100):
        estimator.joints(states(np.arange(begin, min(begin + 100, len(q))) * TICK_S, q[begin : begin + 100]))
        while events and events[0][0] <= (begin + 99) * TICK_S:
            _, take, given = events.pop(0)
            take(*given)
    return estimator


def test_wires_bound_the_error_while_the_cameras_are_covered_and_the_covariance_knows():
    errors, squares, alone = [], [], []
    for seed in range(12):
        _, q, Ts, looks, lengths = world(100 + seed)
        now = go(q, looks, lengths).estimate()
        e = off(now.T_base_tool, Ts[-1])
        errors.append(e)
        squares.append(e @ np.linalg.solve(now.cov, e))
        if seed < 6:  # enough for a mean
            alone.append(off(go(q, looks, []).estimate().T_base_tool, Ts[-1]))
    with_wires, without = (np.sqrt(np.mean(np.square(np.array(x)[..., :3]))) for x in (errors, alone))
    assert with_wires < 0.6 * without
    low, high = chi2.ppf([CHANCE / 2, 1 - CHANCE / 2], 6 * len(squares))
    assert low < np.sum(squares) < high, f"mean NEES {np.mean(squares):.2f}, six is right"


def test_an_image_that_waits_is_not_dropped_for_a_fast_sensor():
    _, q, _, looks, lengths = world(3, seconds=2.6, blind_s=2.1)
    count = 1500
    estimator = fed(q[:count])
    image = next(m for m in looks if m.t_s > count * TICK_S + 0.01)
    assert estimator.vision(image) is Outcome.WAITING
    wire, reading = lengths[0]
    for k in range(40):
        assert estimator.take(wire, replace(reading, t_s=image.t_s + 1e-3 * k)) is Outcome.WAITING
    estimator.joints(states(np.arange(count, count + 100) * TICK_S, q[count : count + 100]))
    newest_s = (count + 99) * TICK_S
    assert estimator.estimate().vision_age_s == pytest.approx(newest_s - image.t_s, abs=2e-3)


def test_many_readings_do_not_average_the_calibration_of_one_sensor_away():
    wire = Wire(name="wire", cov=np.diag([1e-6, 1e-6, 1e-6, 1e-6, 1e-12]), values=np.array([*ANCHORS[0], 0.0, 0.0]))
    q = np.tile(MIDDLE, (1000, 1))
    estimator, T = fed(q), ARM.forward(MIDDLE)
    z = wire.expected(ToolMotion(T), 0)
    for k in range(400):
        estimator.take(wire, Reading(0.1 + 2e-3 * k, 0, z.z, 1e-10 * np.eye(1)))
    cov = estimator.estimate(0.9).cov
    along = float((z.by_tool @ cov @ z.by_tool.T)[0, 0])
    # The anchor along the wire and the offset: 1 mm each, less what the arm's own prior of some mm adds.
    assert 0.8 * 2e-6 < along < 2e-6


def test_order_of_arrival_does_not_matter():
    _, q, _, looks, lengths = world(3, seconds=2.0, blind_s=1.9)
    looks, lengths = looks[60:], lengths[:60]
    straight, crossed = fed(q), fed(q)
    events = [(m.t_s, "vision", (m,)) for m in looks] + [(r.t_s, "take", (w, r)) for w, r in lengths]
    events.sort(key=lambda e: e[0])
    for _, name, given in events:
        assert getattr(straight, name)(*given) is Outcome.USED
    for k in range(0, len(events), 4):
        for _, name, given in events[k : k + 4][::-1]:
            assert getattr(crossed, name)(*given) is Outcome.USED
    a, b = straight.estimate(), crossed.estimate()
    assert np.allclose(a.T_base_tool, b.T_base_tool, atol=1e-8)
    assert np.allclose(a.cov, b.cov, rtol=1e-4, atol=1e-14)
    assert a.vision_age_s == pytest.approx(b.vision_age_s, abs=1e-6)
    assert a.vision_age_s > 2.0 - 1.9


def test_an_outlier_is_never_used_and_is_reported():
    _, q, _, looks, lengths = world(5, seconds=2.0, blind_s=1.9)
    estimator, heard = go(q, looks, []), []
    estimator.on_reading = lambda name, innovation: heard.append((name, innovation))
    before = estimator.estimate()
    wire, reading = lengths[-1]
    for _ in range(20):
        assert estimator.take(wire, replace(reading, z=reading.z + 0.1)) is Outcome.OUTLIER
    np.testing.assert_array_equal(estimator.estimate().T_base_tool, before.T_base_tool)
    assert {name for name, _ in heard} == {wire.name}
    assert heard[0][1].z.shape == (1,)
    assert heard[0][1].z[0] == pytest.approx(0.1, abs=0.01)
    assert estimator.take(wire, reading) is Outcome.USED
    with pytest.raises(InputError, match="wire 0: channel 1 of 1: length"):
        estimator.take(lengths[0][0], replace(reading, channel=1))


def test_gravity_at_rest_shows_what_vision_does_not_see_yet():
    """Before anything was seen the tool's attitude is known to a degree; about two axes gravity shows it."""
    rng = np.random.default_rng(8)
    q, arm = np.tile(MIDDLE, (1500, 1)), sampled(rng)
    T = arm.tool(q)[-1]
    sigma = np.zeros(38)
    sigma[9:12], sigma[36:] = 0.005, np.radians(0.02)  # what its calibration left
    sensor = replace(Inertial.of("imu"), cov=np.diag(sigma**2), sigma_delay_s=0.0)
    true = sensor.moved(rng.normal(size=38) * sigma)
    estimator = fed(q)
    for k in range(100):
        z = true.expected(ToolMotion(T), ACCELEROMETER).z + rng.normal(0.0, 0.02, 3)
        assert estimator.take(sensor, Reading(1.0 + 3e-3 * k, ACCELEROMETER, z, 0.02**2 * np.eye(3))) is Outcome.USED
    found = estimator.estimate(1.3)
    down = T[:3, :3].T @ [0.0, 0.0, 1.0]
    e = np.degrees(off(found.T_base_tool, T)[3:])
    e = e - (e @ down) * down  # the heading is not gravity's
    # 0.005 m/s2 of bias an axis are 0.03 degrees, the tilt 0.02 each.
    sigma_deg = np.degrees(np.sqrt(np.diag(found.cov)[3:]))
    assert np.linalg.norm(e) < 4 * 0.04
    assert np.sort(sigma_deg)[0] < 0.1
    assert np.abs(np.degrees(off(ARM.forward(MIDDLE), T)[3:])).max() > 0.2


def test_a_delay_that_is_not_to_be_learned_stays():
    _, q, _, looks, lengths = world(6, seconds=1.5, blind_s=1.4)
    estimator = KalmanEstimator(ARM, delay=Delay(0.0, 1e-3), learns_delay=False)
    estimator.joints(states(np.arange(len(q)) * TICK_S, q))
    for m in looks:
        estimator.vision(m)
    before = estimator.learned().delay
    for wire, reading in lengths[-40:]:
        assert estimator.take(wire, reading) is Outcome.USED
    assert estimator.learned().delay == before
    assert (np.linalg.eigvalsh(estimator.estimate().cov) > 0.0).all()
