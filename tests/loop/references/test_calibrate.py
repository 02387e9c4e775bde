"""Calibration of a reference, on a small member of the family whose truth is known: a wire from an anchor to the tool."""

from dataclasses import replace

import numpy as np
import pytest
from wire import Wire

from armsight.errors import InputError
from armsight.geometry.pose import exp_se3
from armsight.loop.references.calibrate import calibrate
from armsight.loop.references.reference import Reading, ToolMotion

SIGMA_M = 1e-3


TRUE = Wire(name="wire", cov=np.eye(5), values=np.array([0.9, -0.2, 0.1, 0.05, 0.0]), delay_s=0.02)
FIRST = replace(TRUE, values=np.array([0.6, 0.1, 0.0, 0.0, 0.0]), delay_s=0.0, sigma_delay_s=0.1)


def motion(t_s):
    """A sweep of 0.6 m in each direction."""
    at = 0.3 * np.sin(np.array([1.3, 1.7, 2.3]) * t_s)
    twist = np.append(0.3 * np.array([1.3, 1.7, 2.3]) * np.cos(np.array([1.3, 1.7, 2.3]) * t_s), np.zeros(3))
    return ToolMotion(exp_se3(np.append(at, np.zeros(3))), twist)


def readings(seed, count=300, blunders=0):
    rng = np.random.default_rng(seed)
    out = []
    for t_s in np.linspace(0.0, 10.0, count):
        z = TRUE.expected(motion(t_s - TRUE.delay_s), 0).z + rng.normal(0.0, SIGMA_M, 1)
        out.append(Reading(float(t_s), 0, z, np.eye(1) * (0.5 * SIGMA_M) ** 2))
    wrong = rng.choice(count, blunders, replace=False)
    for k in wrong:
        out[k] = replace(out[k], z=out[k].z + 0.05)
    return out, wrong


def test_parameters_delay_and_noise_are_found_within_their_sigma():
    off, squares = [], []
    for seed in range(12):
        got = calibrate(FIRST, readings(seed)[0], motion, fit_delay=True)
        miss = np.append(got.reference.values - TRUE.values, got.reference.delay_s - TRUE.delay_s)
        off.append(miss / np.append(np.sqrt(np.diag(got.reference.cov)), got.reference.sigma_delay_s))
        squares.append(got.squares.mean())
        assert got.open == ("idle",)
        # The noise was said to be half of what it is: 300 readings show it to 4 %.
        assert got.noise["length"] == pytest.approx(2.0, rel=0.2)
    off = np.delete(np.array(off), 4, axis=1)
    assert 0.6 < (off**2).mean() < 1.6  # 60 numbers: three sigma of chance
    assert 0.9 < np.mean(squares) < 1.1


def test_blunders_are_named_and_not_used():
    given, wrong = readings(3, blunders=30)
    got = calibrate(FIRST, given, motion, fit_delay=True)
    assert not got.used[wrong].any()
    assert got.used.sum() == len(given) - 30
    assert np.abs(got.reference.values[:4] - TRUE.values[:4]).max() < 2e-3


def test_too_few_readings_are_rejected():
    with pytest.raises(InputError, match="wire: 5 numbers were read, 5 parameters need more of them"):
        calibrate(FIRST, readings(0, count=5)[0], motion, fit_delay=True)
