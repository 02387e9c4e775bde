"""Poses taken for mistakes: none of a clean recording, all that were planted."""

from dataclasses import replace

import numpy as np
import pytest
from worn_arm import poses, worn

from armsight.geometry.rotation import exp_so3
from armsight.loop.identify.fit import with_joint_noise
from armsight.loop.identify.identify import identify
from armsight.loop.identify.model import Model
from armsight.loop.identify.placement import with_placement


@pytest.fixture(scope="module")
def recorded():
    """30 poses of an arm measured far better than the covariance says, some joints with no known side of their backlash."""
    w, rng = worn(20), np.random.default_rng(520)
    q, sides = poses(w.nominal, 30, rng)
    seen, T = w.seen(q, sides, rng), w.T_rig_body(q, sides)
    known = np.where(rng.uniform(size=sides.shape) < 0.03, 0.0, sides)
    assert (known == 0).any(axis=1).sum() >= 3
    return w.nominal, replace(seen, p_rig=T[:, None, :3, 3], R_rig_body=T[:, :3, :3], approach=known)


def test_no_pose_of_a_clean_recording_is_a_mistake(recorded):
    assert identify(*recorded).left_out.tolist() == []


def test_planted_mistakes_are_found_and_no_others(recorded):
    arm, measured = recorded
    rng = np.random.default_rng(7020)
    rows = rng.choice(30, 5, replace=False)
    p, R = measured.p_rig.copy(), measured.R_rig_body.copy()
    for row in rows:  # 2 to 10 mm and 0.3 to 2 deg: 10 sigmas of the covariance at least
        d = rng.normal(size=3)
        p[row] += d / np.linalg.norm(d) * rng.uniform(2e-3, 10e-3)
        w = rng.normal(size=3)
        R[row] = R[row] @ exp_so3(w / np.linalg.norm(w) * np.deg2rad(rng.uniform(0.3, 2)))
    found = identify(arm, replace(measured, p_rig=p, R_rig_body=R))
    assert found.left_out.tolist() == sorted(rows)
    assert max(found.solution.noise) < 1e-4  # none was added: the covariance is more than there was


def test_a_side_that_is_not_known_is_either_with_the_backlash_that_was_fitted(recorded):
    arm, measured = recorded
    model, x = with_placement(Model.of(arm, measured, backlash=True), measured)
    x[model.names.index("backlash3")] = np.deg2rad(0.2)
    sides = np.ones_like(measured.approach)
    sides[4, 2] = 0.0

    def residuals(side):
        return model.residuals(x, measured, model.feature_values(measured.q, np.where(sides == 0, side, sides)))

    added = with_joint_noise(model, x, replace(measured, approach=sides), np.zeros(6)).cov - measured.cov
    either = 0.5 * (residuals(1.0) - residuals(-1.0))  # from the middle to either side
    # The angle of 0.1 deg is not linear by its square, 3e-6 of 1.7e-3: a part of 2e-3; twice in a square.
    np.testing.assert_allclose(added, either[:, :, None] * either[:, None], rtol=0, atol=4e-3 * np.abs(added).max())
    assert np.abs(added[4]).max() > 0 == np.abs(np.delete(added, 4, axis=0)).max()
