"""Transforms of other libraries against the libraries themselves; messages of ROS by their fields."""

from types import SimpleNamespace

import numpy as np
import pinocchio
import pytest
from scipy.spatial.transform import RigidTransform

from armsight import as_transform, ros_fields
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3

T = exp_se3(np.array([0.1, -0.4, 0.7, 0.5, -1.1, 2.0]))


def message(fields):
    """Return dicts as what has their attributes, as a ROS message has."""
    return SimpleNamespace(**{k: message(v) if isinstance(v, dict) else v for k, v in fields.items()})


def forms():
    """Name -> the transform in that form."""
    fields = ros_fields(T)
    as_pose = {"position": fields["translation"], "orientation": fields["rotation"]}
    return {
        "matrix": T.tolist(),
        "pinocchio": pinocchio.SE3(T),
        "SciPy": RigidTransform.from_matrix(T),
        "spatialmath": SimpleNamespace(A=T),
        "a measured pose": SimpleNamespace(T_left_body=T),
        "Transform": message(fields),
        "TransformStamped": message({"header": {}, "child_frame_id": "tool", "transform": fields}),
        "Pose": message(as_pose),
        "PoseWithCovarianceStamped": message({"header": {}, "pose": {"pose": as_pose, "covariance": 0.0}}),
    }


@pytest.mark.parametrize("name", forms())
def test_transforms_of_others_are_read(name):
    np.testing.assert_allclose(as_transform(forms()[name]), T, rtol=0, atol=1e-15)
    np.testing.assert_allclose(as_transform(message(ros_fields(forms()[name]))), T, rtol=0, atol=1e-15)


def test_ros_has_the_quaternion_as_x_y_z_w():
    q = ros_fields(T)["rotation"]
    np.testing.assert_allclose([q["x"], q["y"], q["z"], q["w"]], pinocchio.Quaternion(T[:3, :3]).coeffs(), atol=1e-15)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (np.eye(3), "expected a 4x4 matrix"),
        ("pose", "expected a 4x4 matrix"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "no rigid transform"),
        (T.T, "no rigid transform"),
        (2 * T, "no rigid transform"),
        (np.full((4, 4), np.nan), "no rigid transform"),
        (message({"position": dict.fromkeys("xyz", 0.0), "orientation": dict.fromkeys("xyzw", 0.0)}), "never set"),
    ],
)
def test_what_is_none_is_rejected(given, words):
    with pytest.raises(InputError, match=words):
        as_transform(given)
