"""Distances: derivatives, anchors found from the arm's own motion, and folds that ranges do not distinguish."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.geometry.pose import exp_se3
from armsight.loop.references.calibrate import calibrate
from armsight.loop.references.distance import Distance
from armsight.loop.references.reference import Reading, ToolMotion

STEP = 1e-6


def _ranges(seed: int = 0) -> Distance:
    rng = np.random.default_rng(seed)
    anchors = rng.uniform(-1, 1, (3, 3)) + np.array([0.0, 0.0, 1.0])
    return Distance(
        name="ranges",
        cov=np.diag(np.tile(0.02**2, 18)),
        anchors=anchors,
        p_tool=np.array([0.01, -0.02, 0.1]),
        offset=np.array([0.01, -0.02, 0.0]),
        scale=np.array([1.0, 1.01, 0.99]),
    )


def test_derivatives_agree_with_differences() -> None:
    ranges, T = _ranges(), exp_se3(np.array([0.3, 0.2, 0.1, 0.4, -0.3, 0.8]))
    for channel in range(3):
        z, by_tool, by_parameters, *_ = ranges.expected(ToolMotion(T), channel)
        tool = [ranges.expected(ToolMotion(T @ exp_se3(d)), channel).z - z for d in STEP * np.eye(6)]
        own = [ranges.moved(d).expected(ToolMotion(T), channel).z - z for d in STEP * np.eye(18)]
        np.testing.assert_allclose(by_tool.T, np.array(tool) / STEP, atol=1e-5)
        np.testing.assert_allclose(by_parameters.T, np.array(own) / STEP, atol=1e-5)


def test_anchors_are_found_from_the_arms_motion() -> None:
    rng, true, sigma = np.random.default_rng(1), _ranges(), 1e-3
    poses = [exp_se3(0.4 * rng.standard_normal(6)) for _ in range(240)]
    readings = []
    for k, T in enumerate(poses):
        z = true.expected(ToolMotion(T), k % 3).z + sigma * rng.standard_normal(1)
        z += 0.3 * (k % 40 == 7)  # through a wall, longer
        readings.append(Reading(float(k), k % 3, z, np.array([[sigma**2]])))
    off = 0.02 * rng.standard_normal(18)
    found = calibrate(true.moved(off), readings, lambda t: ToolMotion(poses[int(t)]))
    error = np.array(list(found.reference.parameters.values())) - np.array(list(true.parameters.values()))
    assert (np.abs(error) < 4 * np.sqrt(np.diag(found.reference.cov))).all()
    assert [k for k in range(240) if k % 40 == 7] == np.flatnonzero(~found.used).tolist()


def _swept(anchor: list[float], sense: Callable[[np.ndarray], np.ndarray], x_m: float = 0.2) -> Distance:
    """Return where calibrate begins, after a sweep of the tool's point about the origin, at 50 Hz."""
    rates, size = np.array([1.1, 1.7, 2.3, 0.9, 1.3, 1.9]), np.array([x_m, 0.2, 0.2, 1.0, 1.0, 1.0])

    def motion(t: float) -> ToolMotion:
        return ToolMotion(exp_se3(size * np.sin(rates * t + np.arange(6))))

    t_s = np.arange(0.0, 30.0, 0.02)
    Ts = np.array([motion(t).T_base_tool for t in t_s])
    z = sense(np.linalg.norm(Ts[:, :3, 3] + Ts[:, :3, :3] @ [0.0, 0.05, 0.06] - anchor, axis=1))
    readings = [Reading(float(t), 0, np.array([each]), np.eye(1)) for t, each in zip(t_s, z, strict=True)]
    return Distance.of("sonar").begun(readings, motion)


def test_readings_without_an_echo_do_not_change_the_sign() -> None:
    rng = np.random.default_rng(5)

    def sense(far: np.ndarray) -> np.ndarray:
        z = far + rng.normal(0.0, 1e-3, len(far))
        z[rng.choice(len(z), 10, replace=False)] = 65.535
        z[rng.choice(len(z), 30, replace=False)] += 0.5
        return z

    found = _swept([0.8, 0.3, 0.9], sense)
    assert np.linalg.norm(found.anchors[0] - [0.8, 0.3, 0.9]) < 0.05
    with pytest.raises(InputError, match="fall as the tool moves away"):
        _swept([0.8, 0.3, 0.9], lambda far: 2.0 - sense(far))


def test_a_coarse_step_far_away_is_no_frozen_value() -> None:
    """Steps of 10 mm repeat while the tool moves by 0.2 m and more across the line of sight."""
    found = _swept([3.0, 0.0, 0.3], lambda far: np.round(far, 2), x_m=0.02)
    away = found.anchors[0] / np.linalg.norm(found.anchors[0])
    assert away @ [3.0, 0.0, 0.3] > 0.98 * np.linalg.norm([3.0, 0.0, 0.3])
    with pytest.raises(InputError, match=r"stands still from 10\.00 to 15\.9. s, while the range changes by"):
        _swept([0.8, 0.3, 0.9], lambda far: np.where(np.abs(np.arange(len(far)) - 649) < 150, far[500], far))
