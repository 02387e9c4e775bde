"""Links that float in their backlash: the crude dynamics against differences, and joint 1 against a link that coasts."""

import numpy as np
import pytest
from arm_rig import ARM, MIDDLE, TICK_S, TrueArm, distance_mm, legs, link_motions, rms, run, states

from armsight.loop.estimators import Delay, KalmanEstimator, Prior
from armsight.loop.estimators import backlash_dynamics as floating
from armsight.loop.estimators.readings import GAP_RAD, Readings
from armsight.robot.models import MODELS

OTHERS = np.arange(6) != 0


def positions(points, q):
    """Where the points are, (K, 3), by products of 4x4 matrices."""
    T, frames = np.eye(4), []
    for i in range(6):
        c, s = np.cos(q[i]), np.sin(q[i])
        frames.append(T @ np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, ARM.d[i]], [0, 0, 0, 1.0]]))
        T = T @ link_motions(q[None])[i, 0]
    return np.array([(frames[int(p[0])] @ np.append(p[2:], 1.0))[:3] for p in points])


def columns(points, q, step=1e-6):
    ways = np.eye(6) * step
    return np.stack([(positions(points, q + w) - positions(points, q - w)) / (2 * step) for w in ways], axis=2)


def test_inertia_and_torques_are_those_of_points_that_weigh_and_resist():
    rng = np.random.default_rng(0)
    points, (own, _, _) = floating.masses(ARM)
    M, tau = np.empty((6, 6)), np.empty((2, 6))
    for _ in range(4):
        q, qd, qdd = MIDDLE + rng.uniform(-1, 1, 6), rng.normal(size=6), 3 * rng.normal(size=6)
        floating._dynamics(ARM.table, points, own, q, qd, qdd, M, tau)
        J, mass = columns(points, q), points[:, 1]
        assert np.allclose(M, np.einsum("k,kai,kaj->ij", mass, J, J) + np.diag(own), atol=1e-8)
        assert np.allclose(tau[0], np.einsum("k,ki->i", mass * 9.81, J[:, 2]), atol=1e-7)
        h = 1e-4
        before, now, after = (positions(points, q + qd * t + qdd * t**2 / 2) for t in (-h, 0.0, h))
        push = (before - 2 * now + after) / h**2
        # The path's fourth derivative, at most some 100 m/s^4, over 12 h^-2; rounding 1e-16 h^-2.
        assert np.allclose(tau[1], np.einsum("k,ka,kai->i", mass, push, J) + own * qdd, atol=1e-6)


def test_rods_weigh_what_they_are_long():
    points = floating.rods(ARM)
    tip = np.linalg.norm(ARM.T_flange_tool[:3, 3])
    assert points[:, 1].sum() == pytest.approx(np.abs(ARM.a).sum() + np.abs(ARM.d).sum() + tip)


@pytest.mark.parametrize("arm", MODELS.values(), ids=MODELS)
def test_every_arm_has_links_that_weigh_and_resist(arm):
    points, beside = floating.masses(arm)
    assert np.all(np.diff(points[:, 0]) >= 0)
    assert points[-1, 0] == arm.joints - 1
    assert np.isfinite(beside).all()
    assert (beside > 0).all()
    n = arm.joints
    M, tau, still = np.empty((n, n)), np.empty((2, n)), np.zeros(n)
    floating._dynamics(arm.table, points, beside[0], arm.home, still, still, M, tau)
    assert np.linalg.eigvalsh(M).min() > 0


def coasting(shaft, width, brake):
    """Where a link is beyond its shaft (N,), rad: it keeps its speed but for its bearing's friction, between two stops."""
    at, speed, out = shaft[0], 0.0, np.zeros(len(shaft))
    for n, q in enumerate(shaft):
        speed -= np.clip(speed, -brake * TICK_S, brake * TICK_S)
        at += speed * TICK_S
        held = min(max(at, q - width / 2), q + width / 2)
        if held != at:
            speed, at = (q - shaft[max(n - 1, 0)]) / TICK_S, held
        out[n] = at - q
    return out


def side_of(shaft, rows):
    """The floating side (len(rows),) of joint 1 where it alone moves."""
    readings, q = Readings(1e-9, ARM), np.tile(MIDDLE, (len(shaft), 1))
    q[:, 0] = shaft
    readings.add(states(np.arange(len(shaft)) * TICK_S, q))
    return readings.at(rows * TICK_S).unseen[:, 1, 0]


def test_a_link_without_gravity_changes_sides_when_its_shaft_slows_down():
    t = np.arange(1900) * TICK_S
    shaft = 0.3 * np.sin(4 * t)
    points, beside = floating.masses(ARM)
    J = columns(points, MIDDLE)[:, :, 0]
    brake = beside[1, 0] / (points[:, 1] @ (J**2).sum(axis=1) + beside[0, 0])
    true, rows = coasting(shaft, GAP_RAD, brake), np.arange(300, 1850)
    side = side_of(shaft, rows)
    # It leaves and comes at the same times, but for what links 5 and 6 do meanwhile: it is elsewhere for few of the rows.
    assert np.mean(np.abs(side + 2 * true[rows] / GAP_RAD) > 0.5) < 0.05
    # While it slows down the backlash operator has it on the other side.
    slows = (4 * t[rows] % np.pi > np.pi / 4) & (4 * t[rows] % np.pi < np.pi / 2)
    assert (side[slows] * np.sign(np.cos(4 * t[rows])[slows]) < -0.9).all()


@pytest.mark.parametrize("way", [-1, 1])
def test_where_nothing_presses_friction_decides(way):
    t = np.arange(1900) * TICK_S
    rows = np.arange(1500, 1850)
    # At constant speed for long: the link rubs in its bearing and stays behind.
    assert (side_of(way * 0.05 * t, rows) * way > 0.99).all()


@pytest.mark.parametrize("way", [-1, 1])
def test_a_loose_link_stays_where_it_is_while_its_shaft_creeps(way):
    t = np.arange(4000) * TICK_S
    far = np.radians(0.05)
    shaft = 0.05 * np.clip(t, 0.0, 1.0) + way * far * np.clip(t - 1.5, 0.0, 1.0)
    before, after = side_of(shaft, np.array([1450, 2900]))
    assert after - before == pytest.approx(way * 2 * far / GAP_RAD, abs=0.02)


def test_loose_is_what_gravity_does_not_move():
    readings = Readings(1e-9, ARM)
    loose = readings.loose(MIDDLE)
    assert loose[0]  # upright
    assert not loose[1]  # it carries the arm


class Floating(TrueArm):
    """An arm whose link 1 coasts in its backlash; the others have none."""

    def tool(self, shaft):
        moved = shaft.copy()
        moved[:, 0] += coasting(shaft[:, 0], np.radians(0.25), 0.2)
        return super().tool(moved)


def test_through_half_a_second_without_vision_it_knows_where_a_floating_link_is():
    rng = np.random.default_rng(21)
    shaft, hidden = legs(rng, 14.0), [(10.2, 10.7), (11.5, 12.0), (12.8, 13.3)]
    blind = {}
    for name, prior in (("known", Prior()), ("not known", Prior(float_rad=1e-9))):
        estimator = KalmanEstimator(ARM, prior=prior, delay=Delay(0.0, 2e-4))
        track, Ts = run(np.random.default_rng(22), estimator, Floating(), shaft, blind=hidden)
        # A measurement comes 40 ms late.
        gone = np.any([(track.t_s > a + 0.04) & (track.t_s < b + 0.04) for a, b in hidden], axis=0)
        blind[name] = rms(distance_mm(track.Ts_base_tool, Ts)[gone])
    assert blind["known"] <= 0.5
    assert blind["known"] < blind["not known"]
