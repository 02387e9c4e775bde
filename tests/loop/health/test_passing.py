"""What changes and does not stay is not taken for cameras or a body that moved, nor the other way round."""

import faults
import numpy as np
import pytest

from armsight.data import Correspondences
from armsight.vision.pose.shutter import Motion, Shutters, TimedShot, measure_with_motion

#: Between two shots, s; when the faults begin, s.
FRAME_S, AT_S = 1.0 / faults.RATE_HZ, 4.0


def found(seed, **fault):
    """The findings at the end, and the mean NEES of the poses from 2 s after the fault on."""
    squares, monitor = [], None
    for monitor, t_s, T, _, given in faults.watched_body(seed, at_s=AT_S, seconds=14.0, **fault):  # noqa: B007
        off = faults.log_se3(faults.inverse(given.T_left_body) @ T)
        squares += [off @ np.linalg.solve(given.cov, off)] if t_s > AT_S + 2.0 else []
    return monitor.findings(), float(np.mean(squares))


@pytest.mark.parametrize(
    ("fault", "cause", "words"),
    [
        ({"skew_s": lambda k: -FRAME_S * (k % 2)}, "time", "another rate"),
        ({"skew_s": lambda k: -FRAME_S * (k % 3 == 0)}, "time", "another rate"),
        ({"skew_s": FRAME_S}, "time", "exposes 3"),
        ({"row_s": 2e-5}, "time", "one after the other"),
        ({"focal": lambda t: (0.0, 1.5e-3 * np.sin(2 * np.pi * t / 5.0))}, "lens", "focal length"),
    ],
    ids=["half rate", "each third dropped", "a frame late", "rolling shutter", "lens that breathes"],
)
def test_time_and_lens_are_not_taken_for_motion(fault, cause, words):
    (only,), nees = found(7301, **fault)
    assert cause in (only.cause, *only.alternatives)
    assert only.cause == cause
    assert words in only.what
    assert nees < 12.0


def test_a_camera_that_rotated_is_not_taken_for_time():
    (only,), nees = found(7302, rotated=np.radians(0.05) * np.eye(3)[1])
    assert (only.cause, only.alternatives) == ("rig", ())
    assert only.size == pytest.approx(0.05, abs=4 * only.sigma)
    assert nees < 12.0


def test_a_moved_camera_is_taken_back_once_a_lens_that_breathes_explains_all_tests_better():
    alarmed = False
    for monitor, *_ in faults.watched_body(
        9301, at_s=5.0, seconds=20.0, focal=lambda t: (0.0, 1.5e-3 * np.sin(2 * np.pi * t / 6.0))
    ):
        alarmed = alarmed or monitor._rig.alarm
    assert alarmed
    assert [each.cause for each in monitor.findings()] == ["lens"]


#: Of webcams: sigma of skew and readout, s, and of the velocity by which detections are moved to one time, as a share.
SHUTTER_SIGMAS_S, VELOCITY_SHARE = np.array([4e-4, 1e-3]), 0.2


def as_by_webcams(seed, off_s=0.0, knows=True):
    """Findings before webcams whose skew and readout were measured, to their sigma and ``off_s``, and velocities, too."""
    rng = np.random.default_rng(seed)
    true_s = np.array([4e-3, 14e-3])
    skew_s, readout_s = true_s + SHUTTER_SIGMAS_S * rng.normal(size=2) + [off_s, 0.0]
    shutters = Shutters(skew_s, readout_s, np.diag(SHUTTER_SIGMAS_S**2))

    def measure(rig, body, t, uv, body_at):
        seen = Correspondences(np.arange(len(uv)), uv, np.tile(faults.SIGMA_PX**2 * np.eye(2), (len(uv), 2, 1, 1)))
        before, after = (faults.log_se3(faults.inverse(body_at(t)) @ body_at(t + h)) / 5e-3 for h in (-5e-3, 5e-3))
        sigmas = VELOCITY_SHARE * np.repeat(np.linalg.norm(after.reshape(2, 3), axis=1), 3) + 1e-6
        twist, bent = (after - before) / 2.0 + sigmas * rng.normal(size=6), (after + before) / 5e-3
        motion = Motion(twist, bent, np.diag(sigmas**2), True)
        found = measure_with_motion(rig, body, TimedShot(t, seen, body_at(t)), motion, shutters)
        return found if knows else faults.replace(found, exposures=None)

    row_s = 2 * (true_s[1] / faults.TRUE.right.image_size_px[1],)
    *_, (monitor, *_) = faults.watched_body(seed, skew_s=true_s[0], row_s=row_s, measure=measure)
    return monitor.findings()


def test_what_is_not_known_of_skew_readout_and_velocity_is_no_fault():
    assert [as_by_webcams(seed) for seed in (7310, 7311)] == 2 * [()]
    assert as_by_webcams(7310, knows=False)  # else nothing is found because nothing can be seen


def test_a_skew_far_beyond_its_sigma_is_named():
    (found,) = as_by_webcams(7316, off_s=4e-3)
    assert found.cause == "time"
    assert abs(found.size + 4.0) < 3 * found.sigma < 1.5
