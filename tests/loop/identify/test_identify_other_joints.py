"""Arms of five and seven joints, and one whose motors are coupled, are identified as those of six are."""

import dataclasses

import numpy as np
import pytest
from worn_arm import distance_m, poses, worn

from armsight.errors import InputError
from armsight.loop.identify.backlash import joint_backlashes
from armsight.loop.identify.identify import identify
from armsight.loop.identify.measured import Measured, visits
from armsight.loop.identify.model import Model
from armsight.loop.identify.placement import with_placement
from armsight.loop.identify.selection import folds_of
from armsight.robot.models import MODELS


def coupled():
    """A PUMA 560 whose third motor rotates its forearm against the ground."""
    arm = MODELS["puma560"]
    coupling = np.eye(6)
    coupling[2, 1] = 1.0
    return dataclasses.replace(arm, name="coupled", coupling=coupling, home=np.linalg.solve(coupling, arm.home))


@pytest.mark.parametrize(("name", "seed"), [("so101", 1), ("franka", 2)])
def test_a_worn_arm_is_found(name, seed):
    w = worn(seed, MODELS[name], waves=1)
    rng = np.random.default_rng(seed + 100)
    q, approach = poses(w.nominal, 90, rng)
    measured = w.seen(q, approach, rng)
    found = identify(w.nominal, measured)
    q_other, side = poses(w.nominal, 60, rng)
    truth = w.T_rig_body(q_other, side)
    off = distance_m(found.model, found.solution.x, truth, q_other, side)
    as_built = distance_m(found.model, found.nominal, truth, q_other, side)
    assert np.sqrt(np.mean(off**2)) < 5e-4
    assert np.sqrt(np.mean(off**2)) < 0.1 * np.sqrt(np.mean(as_built**2))
    for joint, backlash in enumerate(joint_backlashes(found, measured)):
        if np.isfinite(backlash.value_rad):
            assert abs(backlash.value_rad - w.backlash[joint]) < 4 * backlash.sigma_rad + 1e-4


def test_the_derivatives_of_coupled_motors_are_those_of_the_residuals():
    arm = coupled()
    w = worn(3, arm)
    rng = np.random.default_rng(4)
    q, approach = poses(arm, 6, rng, 0.5)
    measured = w.seen(q, approach, rng)
    model, x = with_placement(Model.of(arm, measured, backlash=True), measured)
    x = x + rng.normal(0, 1e-4, len(model.parameters))
    phi = model.feature_values(measured.q, measured.approach)
    _, J = model.linearised(x, measured, phi)
    for k in rng.permutation(len(x))[:40]:
        step = np.zeros(len(x))
        step[k] = 1e-6
        ahead, behind = (model.residuals(x + s * step, measured, phi) for s in (1, -1))
        np.testing.assert_allclose(J[:, :, k], (ahead - behind) / 2e-6, atol=2e-5 * max(1.0, np.abs(J[:, :, k]).max()))


def test_data_of_another_number_of_joints_are_said():
    w = worn(1, MODELS["so101"])
    rng = np.random.default_rng(1)
    q, approach = poses(w.nominal, 30, rng)
    with pytest.raises(InputError, match="5 joint angles a row, six_r has 6 joints"):
        identify(MODELS["six_r"], w.seen(q, approach, rng))


@pytest.mark.parametrize(("name", "moving"), [("franka", (1, 3)), ("so101", (1, 2)), ("six_r", (0, 4))])
@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_an_arm_of_which_two_joints_move_is_identified_in_what_they_show(name, moving, unit):
    arm = MODELS[name]
    w, rng = worn(7, arm, waves=1), np.random.default_rng(7)
    q = np.tile(arm.home, (40, 1))
    q[:, moving] += rng.uniform(-0.6, 0.6, (40, 2))
    q = np.clip(q, arm.q_min, arm.q_max)
    p = (w.T_rig_body(q, np.zeros_like(q)) @ [0.03, 0.02, 0.05, 1.0])[:, :3] + rng.normal(0, 1e-4, (40, 3))
    measured = Measured(q, unit * p[:, None])
    if unit != 1.0:
        with pytest.raises(InputError):
            identify(arm, measured)
        return
    found = identify(arm, measured)
    fitted = {n for n, free in zip(found.model.names, found.solution.free, strict=True) if free}
    assert (
        len(fitted & {"tool1_x", "tool1_y", "tool1_z"}) < 3
    )  # along the last axis that moves, it is the base's as well
    assert not any(
        p.kind in ("gain", "wave", "ripple") and p.joint not in moving and p.name in fitted
        for p in found.model.parameters
    )
    errors = found.model.residuals(found.solution.x, measured, found.model.feature_values(q, None))
    assert np.sqrt(np.mean(errors**2)) < 2e-4


def test_visits_of_a_pose_are_one_and_stay_in_one_fold():
    rng = np.random.default_rng(0)
    q = rng.uniform(-1, 1, (60, 5))
    q = np.vstack([q, q[:30] + rng.uniform(-1e-3, 1e-3, (30, 5))])
    which = visits(q)
    np.testing.assert_array_equal(which, [*range(60), *range(30)])
    for rows in (q, q[:20], q[np.r_[:8, 60:68]]):
        folds, same = folds_of(rows), visits(rows)
        assert all(len(set(folds[same == k])) == 1 for k in set(same))
    np.testing.assert_array_equal(folds_of(q[:60])[:3], folds_of(q)[:3])  # as many poses, the same folds
