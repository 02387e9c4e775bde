"""A reading into a filter that considers parameters: equal to the joint filter that knows them, its gain of them zero."""

import numpy as np

from armsight.loop.estimators.considered import Shares, gained


def test_a_reading_of_three_numbers_is_the_joint_filter_without_gain_of_the_parameters():
    rng = np.random.default_rng(4)
    K, m, Q = 5, 3, 4
    A = rng.normal(size=(K + Q, K + Q))
    joint = A @ A.T
    P, C, cov = joint[:K, :K], joint[:K, K:], joint[K:, K:]
    H, by, z = rng.normal(size=(m, K)), rng.normal(size=(m, Q)), rng.normal(size=m)
    R = np.diag(rng.uniform(0.1, 1.0, m))
    done = gained(P, z, H, R, {"sensor": Shares(by, cov)}, {"sensor": C}, [])
    both = np.hstack([H, by])
    S = both @ joint @ both.T + R
    gain = (joint @ both.T @ np.linalg.inv(S))[:K]
    step = np.vstack([gain, np.zeros((Q, m))])
    left = np.eye(K + Q) - step @ both
    after = left @ joint @ left.T + step @ R @ step.T  # Joseph: right for any gain
    assert np.allclose(done.S, S)
    assert np.allclose(done.gain, gain)
    assert np.allclose(done.P, after[:K, :K])
    assert np.allclose(done.considered["sensor"], after[:K, K:])
