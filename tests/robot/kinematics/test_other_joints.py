"""Four, five and seven joints, and motors that move several: what the inverse gives is what forward says."""

import dataclasses

import arms
import numpy as np
import pytest

from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3
from armsight.robot.models import MODELS

SO101, FRANKA = MODELS["so101"], MODELS["franka"]
every = pytest.mark.parametrize("arm", [*arms.OTHERS, arms.FOUR], ids=arms.names([*arms.OTHERS, arms.FOUR]))


def reachable(arm, n, seed=0):
    return arm.forward(np.random.default_rng(seed).uniform(arm.q_min, arm.q_max, (n, arm.joints)))


@every
def test_a_reachable_pose_is_reached_within_the_limits(arm):
    Ts = reachable(arm, 300)
    found = arm.inverse_batch(Ts)
    assert (found.count == 1).all()
    assert found.within_limits.all()
    far, rotated = arms.off(arm.forward(found.q[:, 0]), Ts)
    np.testing.assert_allclose(far, found.residual_m[:, 0], atol=1e-9)
    assert max(far.max(), rotated.max()) < 1e-9
    single = arm.inverse(Ts[0])
    np.testing.assert_array_equal(single.q, found.q[0])
    assert single.reason is None
    assert single.configurations == (None,)
    assert not single.singular.any()


@every
def test_near_chooses_the_solution_that_one_stands_at(arm):
    inner = arm.q_min + 0.1 * (arm.q_max - arm.q_min), arm.q_max - 0.1 * (arm.q_max - arm.q_min)
    for q in np.random.default_rng(1).uniform(*inner, (20, arm.joints)):
        best = arm.inverse(arm.forward(q), near=q).best
        assert best is not None
        # Seven joints may leave it, pushed from the limits; not by much, this far within them.
        assert np.abs(best - q).max() < (0.2 if arm.joints == 7 else 1e-6)


def test_seven_joints_keep_away_from_their_limits():
    Ts = reachable(FRANKA, 500, 3)
    found = FRANKA.inverse_batch(Ts).q[:, 0]
    middle, half = (FRANKA.q_max + FRANKA.q_min) / 2, (FRANKA.q_max - FRANKA.q_min) / 2
    drawn = np.random.default_rng(3).uniform(FRANKA.q_min, FRANKA.q_max, (500, 7))

    def crowded(q):
        return np.abs((q - middle) / half).max(axis=1)

    assert np.median(crowded(found)) < np.median(crowded(drawn)) - 0.05
    # No small motion along the free direction makes the sum of squares smaller, where no limit is near.
    free = np.flatnonzero(crowded(found) < 0.8)
    assert len(free) > 100
    slopes = [abs(np.linalg.svd(FRANKA.jacobian(q))[2][-1] @ ((q - middle) / half**2)) for q in found[free[:50]]]
    assert np.median(slopes) < 1e-3
    assert max(slopes) < 0.1  # a few are still on their way when the steps are used up


def test_five_joints_meet_the_position_then_the_axis():
    rng = np.random.default_rng(5)
    met = 0
    for T in reachable(SO101, 30, 5):
        asked = pose(T[:3, :3] @ exp_so3(rng.normal(0, 0.2, 3)), T[:3, 3])
        found = SO101.inverse(asked)
        if not len(found):
            continue
        met += 1
        at = SO101.forward(found.q[0])
        assert np.linalg.norm(at[:3, 3] - asked[:3, 3]) < 1e-9
        assert "orientation not met: 5 joints" in found.reason
        # No motion that keeps the position brings the axis nearer, but for those that hardly move it.
        J = SO101.jacobian(found.q[0])
        if ((found.q[0] > SO101.q_min + 1e-9) & (found.q[0] < SO101.q_max - 1e-9)).all():
            free = np.linalg.svd(J[:3])[2][3:].T
            across = at[:3, :2].T
            into, moves, _ = np.linalg.svd(across @ J[3:] @ free)
            left = into.T @ across @ np.cross(at[:3, 2], asked[:3, 2])
            assert np.abs(left[moves > 0.11]).max(initial=0.0) < 1e-7
    assert met > 20


def test_a_pose_out_of_reach_has_a_nearest():
    T = FRANKA.forward(FRANKA.home)
    T[:3, 3] *= 4
    found = FRANKA.inverse(T)
    assert len(found) == 0
    assert found.best is None
    assert found.reason.startswith("unreachable")
    assert FRANKA.within_limits(found.nearest.q)
    assert found.nearest.off_m > 0.5


def test_coupled_motors_are_the_joints_behind_a_matrix():
    arm, plain = arms.COUPLED, MODELS["puma560"]
    rng = np.random.default_rng(2)
    for q in rng.uniform(arm.q_min, arm.q_max, (20, 6)):
        joints = q + np.array([0, 0, q[1], 0, 0, 0])  # J3' = J3 + J2
        np.testing.assert_allclose(arm.forward(q), plain.forward(joints), atol=1e-14)
        found = arm.inverse(arm.forward(q), near=q)
        np.testing.assert_allclose(found.best, q, atol=1e-6)
        for other in found.q:
            np.testing.assert_allclose(arm.forward(other), arm.forward(q), atol=1e-9)
    Ts = arm.forward(rng.uniform(arm.q_min, arm.q_max, (5, 6)))
    many = arm.inverse_batch(Ts)
    for k, T in enumerate(Ts):
        np.testing.assert_allclose(many.q[k, : many.count[k]], arm.inverse(T).q, atol=1e-12)
    seven = dataclasses.replace(FRANKA, coupling=np.eye(7) + 0.1 * np.eye(7)[2][:, None] * np.eye(7)[1])
    q = FRANKA.home + 0.1
    np.testing.assert_allclose(seven.forward(seven.inverse(seven.forward(q), near=q).best), seven.forward(q), atol=1e-9)
    with pytest.raises(InputError, match="coupling is singular"):
        dataclasses.replace(arm, coupling=np.zeros((6, 6)))
    with pytest.raises(InputError, match="coupling has shape"):
        dataclasses.replace(arm, coupling=np.eye(5))


@pytest.mark.parametrize("joints", [3, 8])
def test_other_numbers_of_joints_are_rejected(joints):
    with pytest.raises(InputError, match=f"{joints} joints; an arm here has 4 to 7"):
        arms.plain("odd", [0.1] * joints, [0.1] * joints, [90] * joints)
