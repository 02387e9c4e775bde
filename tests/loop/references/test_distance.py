"""Distances: derivatives, anchors found from the arm's own motion, and folds that ranges do not distinguish."""

from __future__ import annotations

import numpy as np

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
