"""Transforms of other libraries against the libraries themselves; messages of ROS by their fields."""

import ctypes
from array import array
from types import SimpleNamespace

import numpy as np
import pinocchio
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from armsight import as_transform, handeye, ros_fields
from armsight.errors import InputError
from armsight.geometry.check import checked
from armsight.geometry.convert import as_transforms
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
        "SciPy's rotation": (Rotation.from_matrix(T[:3, :3]), T[:3, 3]),
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


def test_a_list_of_any_of_them_or_one_object_of_many_is_read():
    found = as_transforms(list(forms().values()))
    np.testing.assert_allclose(found, np.tile(T, (len(forms()), 1, 1)), rtol=0, atol=1e-15)
    Ts = exp_se3(np.random.default_rng(1).normal(size=(5, 6)))
    rotations = Rotation.from_matrix(Ts[:, :3, :3])
    pairs = list(zip(rotations, Ts[:, :3, 3], strict=True))
    many = [
        RigidTransform.from_matrix(Ts),
        (rotations, Ts[:, :3, 3]),
        SimpleNamespace(A=list(Ts)),
        pairs,
        Ts,
        Ts.tolist(),
    ]
    for given in many:
        np.testing.assert_allclose(as_transforms(given), Ts, atol=1e-14)
    np.testing.assert_allclose(
        as_transforms((pairs[0], pairs[1])), Ts[:2], atol=1e-14
    )  # two of them, and no pair itself


def test_ros_has_the_quaternion_as_x_y_z_w():
    q = ros_fields(T)["rotation"]
    np.testing.assert_allclose([q["x"], q["y"], q["z"], q["w"]], pinocchio.Quaternion(T[:3, :3]).coeffs(), atol=1e-15)


class ByColumns:
    """A pose as robodk 6.0.2's Mat: [i, j] is row i, column j, and iterating gives columns; here one without a position."""

    def __init__(self, T):
        self.rows = T.tolist()

    def __len__(self):
        return 4

    def __iter__(self):
        return iter(list(map(list, zip(*self.rows, strict=True))))

    def __getitem__(self, index):
        row, column = index if isinstance(index, tuple) else (slice(None), index)
        return np.array(self.rows)[row, column].tolist()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (np.eye(3), "a rotation without a translation: give the pair"),
        (Rotation.identity(), "a rotation without a translation"),
        (np.tile(np.eye(4), (3, 1, 1)), "holds 3 transforms; expected one"),
        ((Rotation.identity(), np.zeros(2)), r"expected \(3,\), m"),
        ("pose", "expected a 4x4 matrix"),
        (
            ByColumns(np.kron([[1, 0], [0, 0]], [[0.0, -1], [1, 0]]) + np.diag([0, 0, 1.0, 1])),
            "transposed; give its rows as a list",
        ),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "no rigid transform"),
        (T.T, "no rigid transform"),
        ((Rotation.identity(), ["a", "b", "c"]), r"needs a translation of numbers: expected \(3,\), m"),
        ((Rotation.identity(), Rotation.identity()), "expected a 4x4 matrix"),
        (
            message({"translation": dict.fromkeys("xyz", "a"), "rotation": dict.fromkeys("xyzw", 1.0)}),
            "expected numbers",
        ),
        (2 * T, "no rigid transform"),
        (np.full((4, 4), np.nan), "no rigid transform"),
        (message({"position": dict.fromkeys("xyz", 0.0), "orientation": dict.fromkeys("xyzw", 0.0)}), "never set"),
    ],
)
def test_what_is_none_is_rejected(given, words):
    with pytest.raises(InputError, match=words):
        as_transform(given)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([T, np.tile(T, (2, 1, 1))], "holds 2 transforms; expected one"),
        ([Rotation.identity(), Rotation.identity()], "a rotation without a translation"),
        ([T, np.full((4, 4), np.nan)], "no rigid transform"),
        ([T, 2 * T], "no rigid transform"),
        (np.array([T, 2 * T]), "no rigid transform"),
        ([T, "pose"], "expected a 4x4 matrix"),
        ([ByColumns(T), ByColumns(T)], "transposed; give its rows as a list"),
    ],
)
def test_an_entry_that_is_none_is_rejected(given, words):
    with pytest.raises(InputError, match=f"^entry [01]: .*{words}"):
        as_transforms(given)


def test_matrices_of_five_decimals_are_read():
    Ts = exp_se3(np.random.default_rng(3).normal(size=(50, 6)))
    np.testing.assert_allclose(as_transforms(list(np.round(Ts, 5))), Ts, atol=6e-6)


def test_handeye_rejects_an_entry_that_holds_two():
    with pytest.raises(InputError, match="holds 2 transforms; expected one"):
        handeye([T, np.tile(T, (2, 1, 1))], [T, T])


@pytest.mark.parametrize("given", [ByColumns(T), [ByColumns(T)] * 2, ([ByColumns(T)],)])
def test_what_would_be_read_transposed_is_rejected_at_any_depth(given):
    with pytest.raises(InputError, match="x must be numbers: a ByColumns may be read transposed"):
        checked(given, (None, 4), "x")


def test_arrays_of_c_and_of_the_standard_library_are_numbers():
    rows = (ctypes.c_double * 4 * 4)(*map(tuple, T.tolist()))
    np.testing.assert_array_equal(as_transform(rows), T)
    np.testing.assert_array_equal(checked([array("d", row) for row in T], (4, 4), "x"), T)
