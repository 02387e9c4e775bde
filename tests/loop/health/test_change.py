"""Hypotheses of a change: what they do to a pose, how probable they are, and how they are named together."""

from dataclasses import replace

import numpy as np
import pytest
from arm_rig import ARM, adjoint_of, off, small

from armsight.loop.estimators import PoseMeasurement
from armsight.loop.health.change import (
    Change,
    doubtful,
    finding,
    happened_besides,
    probabilities,
    ranked,
    suspected,
    suspects,
)

SUSPECTS = {(each.kind, each.joint): each for each in suspects(6)}
T, T_LATER = small(np.array([0.4, 0.1, 0.3, 0.2, -0.5, 1.0])), small(np.array([0.2, -0.3, 0.5, -1.0, 0.4, 0.3]))
MOTION = np.array([2e-3, -1e-3, 5e-4, 1e-3, 2e-3, -1e-3])


def change(kind, joint=-1, score=50.0, **other):
    suspect = SUSPECTS[kind, joint]
    size = np.full(1, 0.01) if joint >= 0 or suspect.cause == "time" else MOTION
    effect = np.ones((6, 1)) if len(size) == 1 else np.eye(6) if kind == "body" else adjoint_of(np.linalg.inv(T))
    cov = 1e-8 * np.eye(len(size))
    return replace(Change(suspect, 10.0, 14.0, size, cov, 100.0, score, effect, T), **other)


def test_a_beam_bends_under_gravity_where_it_is_level():
    size = np.array([0.0, 2e-3, 0.0, 1e-4])  # a beam along y
    bends = replace(change("body"), suspect=SUSPECTS["bend", -1], size=size, cov=1e-8 * np.eye(4))
    for R, rotated in ((np.eye(3), [-2e-3, 0.0, 0.0]), (small([0, 0, 0, np.pi / 2, 0, 0])[:3, :3], [0.0, 0.0, 0.0])):
        T = np.eye(4)
        T[:3, :3] = R  # level; then the beam stands up
        shift, cov = bends.displacement(T, 20.0)
        np.testing.assert_allclose(shift, [*(R.T @ [0.0, 0.0, -1e-4]), *rotated], atol=1e-12)
        assert np.diag(cov)[3:].max() == pytest.approx(1e-8)
    assert "bends under gravity" in finding([bends], ARM.joint_names).what
    assert finding([bends], ARM.joint_names).size == pytest.approx(np.degrees(2e-3))


def test_a_motion_of_the_base_is_carried_to_the_pose_at_hand():
    moved = small(MOTION)  # of the base
    shift, cov = change("rig").displacement(T_LATER, 20.0)
    np.testing.assert_allclose(shift, off(T_LATER, moved @ T_LATER), atol=1e-5)
    carried = adjoint_of(np.linalg.inv(T_LATER))
    np.testing.assert_allclose(cov, 1e-8 * carried @ carried.T, atol=1e-12)


def test_a_slip_of_the_body_is_the_same_at_every_pose_and_a_drift_goes_on():
    np.testing.assert_array_equal(change("body").displacement(T_LATER, 20.0)[0], MOTION)
    now, later = (change("drift").displacement(T, t_s)[0] for t_s in (14.0, 18.0))
    np.testing.assert_allclose(later, 2.0 * now, atol=1e-12)
    # No further than as long again as it was seen: a stale finding does not widen poses without bound.
    np.testing.assert_allclose(change("drift").displacement(T, 1e4)[0], 2.0 * now, atol=1e-12)


def second_order(shift):
    metres, radians = np.linalg.norm(shift.reshape(2, 3), axis=1)
    return np.diag(np.repeat([(metres * radians / 2) ** 2, (radians**2 / 2) ** 2], 3))


def test_a_large_rotation_is_suspected_with_its_second_order():
    size = np.array([0.0, 0.0, 0.0, 0.02, -0.01, 0.015])
    rotated = replace(change("rig"), size=size, cov=1e-14 * np.eye(6))
    extra = suspected(PoseMeasurement(12.0, T, np.eye(6), np.zeros((6, 6))), [rotated])
    true = np.linalg.inv(T) @ small(size) @ T  # right tangent by its matrix, to second order
    missing = true[:3, 3] - rotated.displacement(T, 12.0)[0][:3]
    assert np.linalg.norm(missing) > 1e-5
    assert missing @ np.linalg.solve(extra[:3, :3], missing) < 12.0
    assert (
        missing @ np.linalg.solve(extra[:3, :3] - second_order(rotated.displacement(T, 12.0)[0])[:3, :3], missing) > 1e3
    )


def test_a_pose_is_widened_by_the_mixture_of_what_cannot_be_distinguished():
    measurement = PoseMeasurement(12.0, T, np.eye(6), np.zeros((6, 6)))
    rig, body = change("rig"), change("body")
    np.testing.assert_allclose(probabilities([rig, body]), 0.5)
    shifts = [each.displacement(T, 12.0) for each in (rig, body)]
    both = [shift[:, None] * shift + cov + second_order(shift) for shift, cov in shifts]
    np.testing.assert_allclose(suspected(measurement, [rig, body]), np.mean(both, axis=0))
    assert suspected(replace(measurement, t_s=9.0), [rig, body]) is None
    assert suspected(measurement, [change("joint", 2)]) is None


def test_beside_a_drift_some_of_it_is_suspected_in_every_direction():
    measurement = PoseMeasurement(18.0, T, np.eye(6), np.zeros((6, 6)))
    drift = change("drift")
    extra, (shift, cov) = suspected(measurement, [drift]), drift.displacement(T, 18.0)
    sizes = 0.08 * np.repeat([np.linalg.norm(shift[:3]), np.linalg.norm(shift[3:])], 3)
    expected = np.outer(shift, shift) + cov + second_order(shift) + np.diag(sizes**2)
    np.testing.assert_allclose(extra, expected, rtol=1e-12)


def test_what_was_reported_is_not_undone_by_another_change_at_another_time():
    measurement = PoseMeasurement(30.0, T, np.eye(6), np.zeros((6, 6)))
    rig, joint = change("rig", score=5.0), change("joint", 2, 90.0, begin_s=25.0, end_s=29.0)
    (besides,) = happened_besides([rig], joint)
    # The joint explains far more, but the rig's motion still displaces every pose, in full.
    np.testing.assert_allclose(suspected(measurement, [joint, besides]), suspected(measurement, [rig]))
    assert doubtful([joint, besides])
    assert finding([joint, besides], ARM.joint_names).alternatives == ("fixed",)
    # The same change seen otherwise: at about the same time, or of the same cause; or one that moves no pose.
    assert not happened_besides([rig], replace(joint, begin_s=11.0))
    assert not happened_besides([rig], change("drift", begin_s=25.0, end_s=29.0))
    assert not happened_besides([joint], rig)


@pytest.mark.parametrize(
    ("given", "cause", "alternatives"),
    [
        ([("rig", -1, 60.0), ("body", -1, 55.0), ("joint", 2, 20.0)], "fixed", ("body",)),
        ([("joint", 2, 60.0), ("rig", -1, 55.0), ("drift", -1, 54.0)], "joint", ("fixed",)),
        ([("joint", 0, 60.0), ("rig", -1, 20.0)], "joint", ("fixed",)),
        ([("time", -1, 60.0), ("rate", -1, 59.0)], "time", ()),
    ],
)
def test_one_record_names_all_that_cannot_be_distinguished(given, cause, alternatives):
    changes = ranked([change(*each) for each in given])
    found = finding(changes, ARM.joint_names)
    assert (found.cause, found.alternatives) == (cause, alternatives)
    assert found.what.count("cannot be excluded") == (len(changes) > 1 and bool(alternatives))
    assert doubtful(changes) == ("fixed" in (cause, *alternatives))
