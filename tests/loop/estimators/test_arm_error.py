"""The model of an arm's errors: against the table, against a slow arm with the same errors, against finite differences."""

import dataclasses

import numpy as np
import pytest
from arm_rig import ARM, MIDDLE, loads, product, sampled, small

from armsight.geometry.pose import inverse, log_se3
from armsight.loop.estimators import PoseMeasurement, armerror
from armsight.loop.estimators.armerror import BASIS, Prior, layout
from armsight.loop.estimators.errormodel import ErrorModel, ErrorState, chi_square
from armsight.loop.estimators.readings import Smoothed
from armsight.robot.models import MODELS
from asserts import numeric_jacobian

_, LINEARITY, BACKLASH, FLOAT, COMPLIANCE, REST, READING, POSE, _, SIZE = layout(6)

ODD = dataclasses.replace(
    MODELS["puma560"],
    name="odd",
    offset=np.linspace(-1, 1, 6),
    direction=np.array([1.0, -1, -1, 1, -1, 1]),
    convention="modified",
    T_base_0=small([0.1, 0.2, 0.3, 0.5, -0.4, 0.3]),
    T_flange_tool=small([0.0, 0.1, 0.1, -0.2, 0.4, 1.0]),
)
ARMS = [*MODELS.values(), ODD]
#: Shapes of a Smoothed of one time.
ONE = ((1, 6),) * 4 + ((1, 3, 6), (1, 6), (1, 2, 6))


def evaluated(arm, x, q, unseen):
    T, H = np.empty((4, 4)), np.empty((6, len(x)))
    armerror.pose_and_derivative(arm.table, x, q, unseen, T, H)
    return T, H


@pytest.mark.parametrize("arm", ARMS, ids=lambda arm: arm.name)
def test_without_errors_it_is_the_arm(arm):
    rng = np.random.default_rng(0)
    for q in rng.uniform(-2, 2, (10, arm.joints)):
        T, _ = evaluated(arm, np.zeros(layout(arm.joints).size), q, np.ones((3, arm.joints)))
        assert np.abs(T - arm.forward(q)).max() < 1e-14 * np.abs(T).max() + 1e-15


@pytest.mark.parametrize("arm", ARMS, ids=lambda arm: arm.name)
def test_the_derivative_is_exact_where_nothing_is_off(arm):
    rng = np.random.default_rng(1)
    q, unseen = rng.uniform(-2, 2, arm.joints), rng.uniform(-1, 1, (3, arm.joints))
    still = np.zeros(layout(arm.joints).size)
    T, H = evaluated(arm, still, q, unseen)
    back = inverse(T)
    numeric = numeric_jacobian(lambda x: log_se3(back @ evaluated(arm, x, q, unseen)[0]), still, 1e-3)
    # A difference over 1e-3 of numbers rounded at 1e-16 times the reach, and step^4 of what is cut off: 1e-12.
    assert np.abs(H - numeric).max() < 3e-12


def test_off_by_as_much_as_arms_are_the_derivative_is_off_by_as_little():
    rng = np.random.default_rng(2)
    x, q, unseen = rng.normal(size=SIZE) * Prior().sigmas(0.0), MIDDLE, np.ones((3, 6))
    T, H = evaluated(ARM, x, q, unseen)
    back = inverse(T)
    # exp(e + d) = exp(e) exp(J_r d), J_r = 1 - ad(e) / 2 ...: relative to the column half of e, 1 deg at most, and some mm.
    numeric = numeric_jacobian(lambda x: log_se3(back @ evaluated(ARM, x, q, unseen)[0]), x, 1e-3)
    assert (np.abs(H - numeric).max(axis=0) <= 1.5e-2 * np.abs(numeric).max(axis=0) + 1e-12).all()


def test_it_is_a_slow_arm_with_the_same_errors():
    rng = np.random.default_rng(3)
    sigmas = Prior().sigmas(0.0)
    sigmas[READING:POSE] = 1e-4  # what smoothing leaves of the readings' noise: no amount of the prior
    x, q, unseen = (rng.normal(size=SIZE) * sigmas, rng.uniform(-1, 1, 6) + MIDDLE, rng.uniform(-1, 1, (3, 6)))
    joints = q.copy()
    for i in range(6):
        c = x[LINEARITY + BASIS * i : LINEARITY + BASIS * (i + 1)]
        joints[i] += c[0] * q[i]
        for k in (1, 2, 3):
            joints[i] += c[2 * k - 1] * np.sin(k * q[i]) + c[2 * k] * np.cos(k * q[i])
    joints += -unseen[0] * x[BACKLASH:FLOAT] / 2 - unseen[1] * x[FLOAT:COMPLIANCE] / 2
    joints += x[COMPLIANCE:REST] * (loads(q[None])[0] + unseen[2]) + x[REST:READING] + x[READING:POSE]
    T = product(joints[None], [small(x[6 * i : 6 * i + 6]) for i in range(7)])[0] @ small(x[POSE : POSE + 6])
    found, _ = evaluated(ARM, x, q, unseen)
    # Half the product of the last motion's rotation (3 sigma: 5e-4) and translation (3e-4) is left out; nothing else is.
    assert np.abs(found - T).max() < 7.5e-8


def test_offsets_are_what_the_joints_are_beyond_their_readings():
    rng = np.random.default_rng(5)
    x, q, unseen = rng.normal(size=SIZE) * Prior().sigmas(0.0), MIDDLE, np.ones((3, 6))
    B = np.empty((6, SIZE))
    armerror.offsets_by(ARM.table, q, unseen, B)
    moved = x.copy()
    moved[LINEARITY:POSE] = 0
    moved[REST:READING] = B @ x  # all of it given as rest instead
    assert np.allclose(evaluated(ARM, moved, q, unseen)[0], evaluated(ARM, x, q, unseen)[0], atol=1e-14)


def test_the_prior_is_what_arms_are_sampled_from():
    rng = np.random.default_rng(6)
    q = MIDDLE[None]
    T, H = evaluated(ARM, np.zeros(SIZE), MIDDLE, np.zeros((3, 6)))
    cov = H @ np.diag(Prior().sigmas(0.0) ** 2) @ H.T
    samples = np.array([log_se3(inverse(T) @ sampled(rng).tool(q)[0]) for _ in range(120)])
    # 720 squares, normalised: 5 sigma of their mean, and 3 % for what is not linear.
    squares = np.einsum("ni,ij,nj->n", samples, np.linalg.inv(cov), samples)
    assert squares.mean() == pytest.approx(6, rel=5 * np.sqrt(2 / 720) + 0.03)


@pytest.mark.parametrize("rotation_rad", [0.0, 1e-9, 1e-3, 0.3, 2.9])
def test_a_tangent_leads_from_one_pose_to_the_other(rotation_rad):
    rng = np.random.default_rng(11)
    for _ in range(20):
        T, axis = small(rng.normal(size=6)), rng.normal(size=3)
        xi, found = np.concatenate([rng.normal(size=3), rotation_rad * axis / np.linalg.norm(axis)]), np.empty(6)
        armerror.tangent(T, T @ small(xi), found)
        assert found == pytest.approx(xi, abs=1e-13 * (1 + 10 * rotation_rad))


def test_half_a_revolution_is_not_taken_for_none():
    found = np.empty(6)
    armerror.tangent(np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0]), found)
    assert np.linalg.norm(found[3:]) == pytest.approx(np.pi)


def test_covariances_are_those_of_the_matrices():
    rng = np.random.default_rng(5)
    model, n = ErrorModel(ARM, Prior(), 2e-4), 4
    root = 1e-3 * rng.normal(size=(SIZE, SIZE))
    joints = Smoothed(
        rng.uniform(-1, 1, (n, 6)),
        np.zeros((n, 6)),
        rng.uniform(0.1, 1, (n, 6)),
        rng.uniform(0.01, 0.1, (n, 6)),
        rng.uniform(-1, 1, (n, 3, 6)),
        rng.uniform(0, 1, (n, 6)),
        rng.uniform(0, 1, (n, 2, 6)),
    )
    state = ErrorState(0.0, np.zeros(SIZE), root @ root.T, Smoothed(*(part[:1] for part in joints)), None)
    step = model.moved(state, joints, np.arange(n) * 1e-3)
    Ts, Hs = model.poses(state.x, joints.q, joints.unseen)
    poses, _, covs = model.tracked(state, step, joints)
    np.testing.assert_array_equal(poses, Ts)
    for n, own in enumerate(covs):
        moved = np.diag(step.kept[n]) @ state.P @ np.diag(step.kept[n]) + np.diag(step.added[n])
        expected = Hs[n] @ moved @ Hs[n].T
        assert np.abs(own - expected).max() < 1e-13 * np.abs(expected).max()


def test_motion_to_and_fro_adds_at_once_what_it_adds_in_many_steps():
    model, joints = ErrorModel(ARM, Prior(), 2e-4), Smoothed(*(np.ones(shape) for shape in ONE))
    rows, variance, parts = slice(model.layout.rest, model.layout.reading), np.zeros(SIZE), 50
    moved = np.full(1, 2.0), np.full((1, 6), 0.2), np.full((1, 2, 6), 6.0)
    at_once = model.carried(*moved, joints.variance, joints)
    for _ in range(parts):
        step = model.carried(*(each / parts for each in moved), joints.variance, joints)
        variance = step.kept[0] ** 2 * variance + step.added[0]
    np.testing.assert_allclose(at_once.added[0, rows], variance[rows], rtol=1e-9)


@pytest.mark.parametrize("learns_delay", [True, False])
def test_a_measurement_changes_state_and_covariance_as_the_textbook_has_it(learns_delay):
    """Joseph's form of the update (Bucy and Joseph, 1968), which holds for every gain."""
    rng = np.random.default_rng(7)
    model, joints = ErrorModel(ARM, Prior(), 2e-4), Smoothed(*(rng.uniform(0.1, 0.2, shape) for shape in ONE))
    root = 1e-4 * rng.normal(size=(SIZE, SIZE))
    state = ErrorState(0.0, 1e-4 * rng.normal(size=SIZE), root @ root.T, joints, None)
    T = model.poses(state.x, joints.q, joints.unseen)[0][0] @ small([1e-5, 2e-5, -1e-5, 1e-5, 3e-5, 2e-5])
    seen = PoseMeasurement(0.05, T, np.diag([1e-10] * 3 + [1e-8] * 3), np.zeros((6, 6)))
    step = model.moved(state, joints._replace(travel=joints.travel + 0.02), np.array([0.01]))
    at, chi = model.predicted(state, step, joints, seen, 1e-4)
    kept, velocity = np.diag(step.kept[0]), -at.H[:, -1]
    P = kept @ state.P @ kept + np.diag(step.added[0])
    np.testing.assert_allclose(at.P, P, rtol=1e-13, atol=0)
    _, (H,) = model.poses(kept @ state.x, joints.q, joints.unseen)
    H[:, -1] = -velocity
    R = seen.cov_noise + 1e-4**2 * np.outer(velocity, velocity)
    S = H @ P @ H.T + R
    assert np.abs(at.S - S).max() < 1e-13 * np.abs(S).max()
    assert chi == pytest.approx(at.z @ np.linalg.solve(S, at.z), rel=1e-9)
    expected = np.linalg.solve(S, H @ P).T
    expected[-1] *= learns_delay
    gain, _, _ = model.updated(at, joints, seen, 1e-4, learns_delay=learns_delay)
    np.testing.assert_allclose(gain, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(at.x, kept @ state.x + expected @ at.z, rtol=0, atol=1e-14)
    left = np.eye(SIZE) - expected @ H
    after = left @ P @ left.T + expected @ R @ expected.T
    np.testing.assert_allclose(at.P, after, rtol=0, atol=1e-9 * np.abs(P).max())


def test_chi_square_is_that_of_the_inverse():
    rng = np.random.default_rng(6)
    for _ in range(20):
        root, z = rng.normal(size=(6, 8)), rng.normal(size=6)
        S = root @ root.T
        assert chi_square(S, z) == pytest.approx(z @ np.linalg.solve(S, z), rel=1e-12 * np.linalg.cond(S))
    assert np.isnan(chi_square(-np.eye(6), np.ones(6)))
