"""The model against the Arm's own kinematics, and its derivative against differences."""

from dataclasses import replace

import numpy as np
import pytest

from armsight.geometry.rotation import exp_so3
from armsight.loop.identify import model as chain
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import Model
from armsight.robot.arm_file import open_arm
from asserts import assert_jacobian


def case(name, modified, full, points=1, seed=0):
    rng = np.random.default_rng(seed)
    arm = open_arm(name)
    if modified:
        arm = replace(arm, convention="modified", direction=np.array([1, -1, 1, 1, -1, 1.0]))
    q, approach = rng.uniform(-1, 1, (12, 6)), rng.choice([-1.0, 1.0], (12, 6))
    R = exp_so3(rng.normal(0, 1, (12, 3))) if full else None
    measured = Measured(q, rng.normal(size=(12, points, 3)), R, None, approach)
    model = Model.of(arm, measured, backlash=True)
    x = model.nominal() + rng.normal(0, 0.03, len(model.names))
    if full:
        R = model.motion(x, q, model.feature_values(q, approach)).R @ model.T_6_body(x)[:3, :3]
        measured = replace(measured, R_rig_body=R @ exp_so3(rng.normal(0, 1e-4, (12, 3))))
    return model, x, measured


@pytest.mark.parametrize("name", ["six_r", "puma560", "ur10"])
@pytest.mark.parametrize("modified", [False, True])
def test_the_nominal_vector_is_the_nominal_arm(name, modified):
    model, _, measured = case(name, modified, full=True)
    bare = replace(model.arm, T_flange_tool=np.eye(4))
    at = model.tool_in_base(model.nominal(), measured.q, None)
    np.testing.assert_allclose(at, bare.forward(measured.q), atol=1e-12)


def test_a_table_that_is_off_is_an_arm_that_is_off():
    model, x, measured = case("six_r", False, full=True)
    x = x.copy()
    x[model.sources_at :] = 0.0
    table = model.table(x).copy()
    table[:, chain.BETA] = 0.0
    x[model.table_at : model.sources_at] = table.ravel()
    off = replace(
        model.arm, offset=table[:, 0], d=table[:, 1], a=table[:, 2], alpha=table[:, 3], T_flange_tool=model.T_6_body(x)
    )
    np.testing.assert_allclose(model.tool_in_base(x, measured.q, None), off.forward(measured.q), atol=1e-12)


@pytest.mark.parametrize("modified", [False, True])
@pytest.mark.parametrize(("full", "points"), [(False, 1), (False, 3), (True, 1)])
def test_the_derivative_is_the_derivative(modified, full, points):
    model, x, measured = case("six_r", modified, full, points)
    phi = model.feature_values(measured.q, measured.approach)
    _, J = model.linearised(x, measured, phi)
    assert_jacobian(J, lambda y: model.residuals(y, measured, phi), x, 1e-3, rtol=1e-7)


def test_compliance_follows_the_gravity_torque():
    model, _, measured = case("six_r", False, full=False)
    phi = model.feature_values(measured.q, None)
    names = [f.name for f in model.features]
    for n, angles in enumerate(measured.q):
        T = model.arm.links(angles)
        for i in range(6):
            for j in range(i, 6):
                L = T[j + 1, :3, 3] - T[j, :3, 3]
                torque = T[i, :3, 2] @ np.cross(L, [0, 0, -1.0])
                assert phi[n, names.index(f"compliance{i + 1}_{j + 1}")] == pytest.approx(torque, abs=1e-12)
