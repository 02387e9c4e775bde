"""What changes and does not stay is not taken for cameras or a body that moved, nor the other way round."""

import faults
import numpy as np
import pytest

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
