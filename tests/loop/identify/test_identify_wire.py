"""An arm identified by one draw-wire: the anchor, blunders that agree with each other, and joints without rounding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armsight.data import Array
from armsight.errors import InputError
from armsight.loop.identify.identify import identify
from armsight.loop.identify.lengths import steps_of, unrounded, without_blunders
from armsight.robot.arm_file import open_arm

ROWS, NOISE_M, STEP_RAD, STEP_M = 90, 2e-4, np.deg2rad(0.1), 1e-4
ANCHOR, TOOL = np.array([0.25, -0.5, -0.05]), np.array([0.01, 0.02, 0.07])
HOOKED, LOST = np.arange(20, 28), np.arange(60, 68)


def _recording(seed: int) -> tuple[Array, Array, Array, Array]:
    """Return true joints, joints as printed, lengths and the controller's positions."""
    rng = np.random.default_rng(seed)
    arm = open_arm("irb120")
    q = rng.uniform(*np.deg2rad([[-70, -20, -50, -40, 30, -80], [-10, 50, 10, -5, 80, -40]]), (ROWS, 6))
    T = arm.forward(q)
    p = T[:, :3, 3] + T[:, :3, :3] @ TOOL
    length = np.linalg.norm(p - ANCHOR, axis=1) + NOISE_M * rng.standard_normal(ROWS)
    length[HOOKED] += 4e-3 + 5e-4 * rng.standard_normal(len(HOOKED))  # longer, and not by a constant
    printed = np.round(q / STEP_RAD) * STEP_RAD
    printed[LOST, 5] *= -1
    return q, printed, length, np.round(T[:, :3, 3] / STEP_M) * STEP_M


def test_the_anchor_is_found_and_blunders_are_named() -> None:
    _, printed, length, p = _recording(3)
    p[10, 2] += 0.099
    measured, used, blunders = without_blunders(open_arm("irb120"), printed, length, p)
    found = identify(open_arm("irb120"), measured.rows(used))
    named = {text: set(rows) for rows, text in blunders}
    assert {10} == set().union(*(rows for text, rows in named.items() if "contradicts" in text))
    assert set(LOST) == set().union(*(rows for text, rows in named.items() if "sign of joint 6" in text))
    assert set(HOOKED) == set().union(*(rows for text, rows in named.items() if "too long" in text))
    sigma = np.sqrt(np.diag(found.cov))[:3]
    assert (np.abs(found.solution.x[:3] + ANCHOR) < 4 * sigma).all()  # the base in the anchor's frame
    assert (sigma < 0.03).all()


def test_a_position_says_what_rounding_took_away() -> None:
    q, printed, _, p = _recording(4)
    printed[LOST, 5] *= -1
    sigma = STEP_RAD / np.sqrt(12)
    better, agree = unrounded(open_arm("irb120"), printed, p, STEP_M / np.sqrt(12))
    assert agree.all()
    T, T_true = open_arm("irb120").forward(better), open_arm("irb120").forward(q)
    apart = np.linalg.norm(T[:, :3, 3] - T_true[:, :3, 3], axis=1)
    assert apart.max() < STEP_M  # rounding alone moves it by 0.3 mm
    assert np.abs(better - printed).max() < 3 * sigma


@pytest.mark.parametrize("rows", [40, 300])
@pytest.mark.parametrize(("step_deg", "printed_deg"), [(0.1, 1e-6), (360 / 4096, 1e-2), (np.degrees(1e-3), 1e-6)])
def test_the_step_of_each_joint_is_found_in_any_unit(rows: int, step_deg: float, printed_deg: float) -> None:
    q_deg = np.random.default_rng(rows).uniform(-60.0, 60.0, (rows, 4))
    read = np.column_stack(
        [np.round(np.round(q_deg[:, :2] / step_deg) * step_deg / printed_deg) * printed_deg, q_deg[:, 2]]
    )
    chosen = 15.0 * np.round(q_deg[:, 3] / 15.0)
    steps = np.degrees(steps_of(np.radians(np.column_stack([read, chosen]))))
    np.testing.assert_allclose(steps[:2], step_deg, rtol=2e-3)
    assert (steps[2:] < 1e-3).all()  # not rounded, and somebody's poses


@pytest.mark.parametrize("step_rad", [1e-4, 1e-5, np.deg2rad(360 / 4096), np.deg2rad(1e-3), np.deg2rad(1.0)])
def test_no_assumption_of_the_joints_step_decides(step_rad: float) -> None:
    rng, arm = np.random.default_rng(1), open_arm("ur5")
    q = rng.uniform(-1.5, 1.5, (60, 6))
    p = arm.forward(q)[:, :3, 3]
    length, printed = np.linalg.norm(p - [1.2, 0.3, 0.4], axis=1), np.round(q / step_rad) * step_rad
    length += NOISE_M * rng.standard_normal(60)
    off = np.round(p, 6)
    off[[4, 30]] += 0.1
    measured, _, blunders = without_blunders(arm, printed, length, off)
    assert [rows.tolist() for rows, text in blunders if "contradicts" in text] == [[4], [30]]
    good = ~np.isin(np.arange(60), [4, 30])
    better, rounded = (
        np.linalg.norm(arm.forward(each)[good, :3, 3] - p[good], axis=1) for each in (measured.q, printed)
    )
    assert np.median(better) < 0.2 * np.median(rounded)


@pytest.mark.parametrize(
    ("longer_m", "said"), [(1e-3, "0.58 mm as another table"), (0.02, "in 60 of 60 rows: other arm")]
)
def test_positions_of_another_table_are_no_rounding(longer_m: float, said: str) -> None:
    rng, arm = np.random.default_rng(1), open_arm("ur5")
    q = rng.uniform(-1.5, 1.5, (60, 6))
    p = replace(arm, a=arm.a + longer_m * np.eye(6)[1]).forward(q)[:, :3, 3]
    with pytest.raises(InputError, match=said):
        without_blunders(arm, np.round(q, 4), np.linalg.norm(p, axis=1), np.round(p, 6))
