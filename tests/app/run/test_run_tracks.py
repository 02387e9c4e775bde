"""A log as tracks: the covariance of a moving tool's poses includes the errors of the time stamps."""

import numpy as np
import pytest

from armsight.app.run.tracks import Tracks, errors
from armsight.data import JointStates, PoseEstimate
from armsight.geometry.pose import exp_se3
from armsight.loop.estimators import Delay, Mounting
from armsight.loop.running.data import NO_POINTS
from armsight.loop.running.log import Log, RunSegment
from armsight.robot.arm_file import open_arm

ARM = open_arm("six_r")
RATE_HZ, SHOTS, DELAY_S = 60.0, 600, 0.02
EXPOSED = 0.5 + np.arange(SHOTS) / RATE_HZ
SIGMA = np.repeat([2e-5, 5e-5], 3)  # of one pose measurement, m and rad


def swinging(t_s):
    """Poses of the tool at times (N,): up to 0.4 m/s and 1 rad/s, reversing every second."""
    swing = np.sin(np.pi * t_s)[:, None] * np.array([0.1, 0.05, -0.06, 0.2, -0.15, 0.2])
    return exp_se3(swing)


def assemble(rng, delay, jitter_s, off_s, exposed=EXPOSED):
    """The vision track and the truth of a run whose stamps scatter, and whose delay is wrong by ``off_s``."""
    stamps = exposed + DELAY_S + off_s + jitter_s * rng.normal(size=len(exposed))
    Ts = swinging(exposed) @ exp_se3(SIGMA * rng.normal(size=(len(exposed), 6)))
    cov = np.diag(SIGMA**2)
    t_s = np.arange(0.0, exposed[-1] + 0.5, 1e-3)
    log = Log(segments=[RunSegment("open_loop", "swing", "joints")])
    log.read(JointStates(t_s, np.tile(ARM.home, (len(t_s), 1))))
    for n in range(len(exposed)):
        log.seen(str(n), stamps[n], PoseEstimate(Ts[n], cov, cov, 0.0, 0.0, 1.0, NO_POINTS))
    mounting = Mounting(np.eye(4), np.eye(4), np.zeros((12, 12)))
    run = Tracks(log, ARM, mounting, delay, (t_s, swinging(t_s))).between()
    return run.vision, run.truth


def nees(track, truth):
    error = errors(track, truth)
    return np.einsum("ni,ni->n", error, np.linalg.solve(track.covs, error[..., None])[..., 0])


def test_jitter_of_the_stamps_is_in_the_covariance():
    rng, jitter_s = np.random.default_rng(0), 2e-4
    found = nees(*assemble(rng, Delay(DELAY_S, 0.0, jitter_s), jitter_s, 0.0))
    # The mean of 600 chi-squares of six: sigma sqrt(12 / 600) = 0.14.
    assert found.mean() == pytest.approx(6.0, abs=0.6)
    unknown = nees(*assemble(rng, Delay(DELAY_S, 0.0), jitter_s, 0.0))
    assert unknown.mean() > 8.0


def test_what_is_not_known_of_the_delay_is_in_it_too():
    rng, sigma_s = np.random.default_rng(1), 2e-4
    found = [nees(*assemble(rng, Delay(DELAY_S, sigma_s), 0.0, sigma_s * rng.normal())).mean() for _ in range(10)]
    # Common to all of a run: from 10 samples the mean square is known to half of one degree of freedom.
    assert np.mean(found) == pytest.approx(6.0, abs=1.4)
    certain = nees(*assemble(rng, Delay(DELAY_S, 0.0), 0.0, 2 * sigma_s))
    assert certain.mean() > 10.0


def test_sparse_shots_gaps_and_doubled_stamps():
    seldom = 0.5 + np.arange(100) / 5.0  # neighbours on both sides, 0.2 s away
    lonely = np.concatenate([0.75 + np.arange(40) * 0.5 + n / RATE_HZ for n in (0, 1)])  # pairs, half a second apart
    for exposed in (seldom, np.sort(lonely)):
        vision, _ = assemble(np.random.default_rng(3), Delay(DELAY_S, 1e-3), 0.0, 0.0, exposed)
        moving = np.abs(np.cos(np.pi * (vision.t_s))) > 0.9
        assert (np.sqrt(vision.covs[moving, 0, 0]) > 5 * SIGMA[0]).all()
    twice = np.repeat(0.5 + np.arange(50) / RATE_HZ, 2)
    vision, _ = assemble(np.random.default_rng(4), Delay(DELAY_S, 1e-3), 0.0, 0.0, twice)
    assert np.isfinite(vision.covs).all()
    single, _ = assemble(np.random.default_rng(5), Delay(DELAY_S, 1e-3), 0.0, 0.0, np.array([0.7]))
    assert single.covs[0] == pytest.approx(np.diag(SIGMA**2))


def test_a_tool_at_rest_has_its_own_covariance_alone():
    vision, _ = assemble(np.random.default_rng(2), Delay(DELAY_S, 1e-3), 0.0, 0.0)
    reversal = np.argmin(np.abs(np.cos(np.pi * vision.t_s)))
    # Within half a shot of the reversal it is slower than pi^2 * 0.1 m * 1 / 120 s: 0.4 of its own sigma at 1 ms.
    assert np.sqrt(np.diag(vision.covs[reversal])) == pytest.approx(SIGMA, rel=0.15)
    assert np.sqrt(vision.covs[:, 0, 0]).max() > 5 * SIGMA[0]
