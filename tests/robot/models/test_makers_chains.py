"""Every model that its maker publishes as URDF, against pinocchio on that."""

import makers_chains
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armsight.geometry.pose import pose
from armsight.robot.models import MODELS

pytest.importorskip("pinocchio")

#: What stands otherwise there: our base in theirs, by which sign joints turn, their tool in ours. See the models' texts.
STANDS = {
    "ar4": (
        Rotation.from_euler("z", -90, degrees=True),
        [-1, 1, 1, 1, 1, 1],
        Rotation.from_euler("z", -90, degrees=True),
    ),
    "so101": (Rotation.identity(), [1] * 5, Rotation.from_euler("x", -90, degrees=True)),
}


@pytest.mark.parametrize("name", makers_chains.CHAINS)
def test_a_model_moves_as_its_makers_urdf(name):
    arm, peer = MODELS[name], makers_chains.Peer(name)
    base, way, tool = STANDS.get(name, (Rotation.identity(), np.ones(arm.joints), Rotation.identity()))
    T_theirs_ours, T_tool = pose(base.as_matrix(), np.zeros(3)), pose(tool.as_matrix(), np.zeros(3))
    both = np.kron(np.eye(2), base.as_matrix())
    q = np.random.default_rng(3).uniform(arm.q_min, arm.q_max, (50, arm.joints))
    Ts, Js = arm.forward(q), arm.jacobian(q)
    for k in range(len(q)):
        np.testing.assert_allclose(T_theirs_ours @ Ts[k] @ T_tool, peer.forward(way * q[k]), atol=1e-12)
        np.testing.assert_allclose(both @ Js[k], peer.jacobian(way * q[k]) * way, atol=1e-12)
        np.testing.assert_allclose(arm.forward(q[k]), Ts[k], atol=1e-14)
        np.testing.assert_allclose(arm.jacobian(q[k]), Js[k], atol=1e-14)
