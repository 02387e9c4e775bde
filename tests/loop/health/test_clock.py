"""A camera's clock that drifts against that of the joints: followed, named, and nothing else is blamed."""

import faults
import numpy as np
import pytest
from faults import AT_S, watched_arm

RATE = 6e-4


@pytest.fixture(scope="module")
def drifting():
    return watched_arm(61, seconds=17.0, late=lambda t_s: RATE * t_s)


def test_the_offset_is_followed_and_named_as_time(drifting):
    (found,) = drifting.monitor.findings()
    assert (found.cause, found.unit) == ("time", "ms")
    true_ms = 1e3 * RATE * (17.0 - AT_S)
    assert abs(found.size - true_ms) < 4 * found.sigma
    assert found.sigma < 1.0
    rate, sigma = drifting.estimator.clock.rate
    assert abs(rate - RATE) < 4 * sigma
    assert AT_S < found.since_s < AT_S + 6.0


def test_poses_in_motion_stay_within_their_covariance_once_it_is_followed(drifting):
    track = drifting.tracked
    rows = np.flatnonzero(track.t_s > drifting.monitor.findings()[0].since_s + 0.5)[::20]
    off = np.linalg.inv(track.Ts_base_tool[rows]) @ drifting.Ts_true[rows]
    shift, cov = off[:, :3, 3], track.covs[rows, :3, :3]
    assert np.mean(np.einsum("ni,nij,nj->n", shift, np.linalg.inv(cov), shift)) < 6.0


def test_the_delay_that_was_measured_stays_where_the_clock_is_right():
    right = watched_arm(62, seconds=10.0)
    assert right.monitor.findings() == ()
    assert right.estimator.clock.since_s is None
    assert right.estimator.clock_offset_s(9.0) == 0.0


def test_an_earlier_state_is_gone_back_to_with_the_clock_of_that_time(drifting):
    """The last test of this run: it takes the clock back."""
    estimator = drifting.estimator
    known, offset_s = estimator.remembered(), estimator.clock_offset_s(17.0)
    estimator.clock._b += 1.0
    estimator.clock._corrected += 1.0
    estimator.restore(known)
    assert estimator.clock_offset_s(17.0) == offset_s
    np.testing.assert_array_equal(estimator.clock.remembered()[:14], known.clock[:14])
    estimator.restore(estimator.nothing_known())
    assert estimator.clock_offset_s(17.0) == offset_s
    assert np.count_nonzero(estimator.clock._V) == 1


def test_stamps_that_run_fast_leave_no_error_in_what_was_learned(monkeypatch):
    monkeypatch.setattr(faults, "AT_S", 10.0)
    fast = watched_arm(63, seconds=20.0, late=lambda t_s: 0.01 * t_s)
    (found,) = fast.monitor.findings()
    assert (found.cause, found.unit) == ("time", "%")
    track = fast.tracked
    rows = np.flatnonzero(track.t_s > 14.0)[::20]
    off = np.linalg.inv(track.Ts_base_tool[rows]) @ fast.Ts_true[rows]
    shift, cov = off[:, :3, 3], track.covs[rows, :3, :3]
    assert np.mean(np.einsum("ni,nij,nj->n", shift, np.linalg.inv(cov), shift)) < 6.0


@pytest.mark.parametrize("delay", [(1e-3, 5e-4), (3e-3, 2e-3)], ids=["of the arm's test", "of the clock's"])
def test_a_delay_that_is_off_by_its_sigma_is_no_fault(delay):
    monitor = watched_arm(7401, seconds=22.0, delay=delay).monitor
    assert monitor.findings() == ()
