#!/bin/sh
# Robotic_Arm 1.1.6 (RealMan's SDK): a pose taken from the base to a work frame is always that of the work frame itself.
#
# Algo.rm_algo_base2workframe(matrix, pose_in_base), "matrix of the work frame in the base", passes both to the C function
# rm_algo_matrix2pos, which takes a matrix alone: what comes back is the matrix as a pose, whatever the pose was. ctypes lets an
# argument too many pass. The C library's own rm_algo_base2workframe(matrix, pose) is another thing, too: the product of matrix
# and pose, which leads from the work frame to the base, and rm_algo_workframe2base is the inverse of the matrix
# times the pose, which leads from the base to the work frame. Each is what the other one's name says; Python's
# rm_algo_workframe2base is the C one. Nothing needs an arm: the algorithms run on the computer.
#
# Work frame at 0.3 0.1 0.2 m, rotated by 90 degrees about z; a pose at 0.5 0.0 0.4 m, 0.1 0.2 0.3 rad in the base is at
# -0.1 -0.2 0.2 m, 0.1 0.2 -1.271 rad in it.
#
# Seen: Python's base2workframe 0.3 0.1 0.2, 0 0 1.571, of any pose; workframe2base of the pose in the base -0.1 -0.2 0.2,
# 0.1 0.2 -1.271; of the pose in the work frame -0.3 0.4 0.0, not 0.5 0.0 0.4; C's base2workframe of that one 0.5 0.0 0.4.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 scipy==1.16.3 Robotic_Arm==1.1.6
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
from Robotic_Arm import rm_ctypes_wrap as c
from Robotic_Arm.rm_robot_interface import Algo, rm_force_type_e, rm_robot_arm_model_e
from scipy.spatial.transform import Rotation

algo = Algo(rm_robot_arm_model_e.RM_MODEL_RM_65_E, rm_force_type_e.RM_MODEL_RM_B_E)


def matrix(numbers):
    """Return the transform (4, 4) of x y z, m, and angles about the fixed x, y and z, rad."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", numbers[3:]).as_matrix(), numbers[:3]
    return T


def numbers(T):
    return np.r_[T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_euler("xyz")]


def pose(values):
    """Return the SDK's record of a pose, with both of its orientations."""
    made = c.rm_pose_t()
    made.position, made.euler = c.rm_position_t(*values[:3]), c.rm_euler_t(*values[3:])
    made.quaternion = c.rm_quat_t(*Rotation.from_euler("xyz", values[3:]).as_quat(scalar_first=True))
    return made


def by_c(function, *given):
    found = function(*given)
    return [found.position.x, found.position.y, found.position.z, found.euler.rx, found.euler.ry, found.euler.rz]


def check(name, found, expected):
    print(f"{name:42} {np.round(found, 3) + 0.0}")
    assert np.allclose(found, expected, atol=1e-5)


work, base = np.array([0.3, 0.1, 0.2, 0.0, 0.0, np.pi / 2]), np.array([0.5, 0.0, 0.4, 0.1, 0.2, 0.3])
inside = numbers(np.linalg.inv(matrix(work)) @ matrix(base))
given = algo.rm_algo_pos2matrix(work.tolist())
held = np.reshape(list(given.data), (4, 4))
assert np.allclose(held, matrix(work), atol=1e-6)  # angles and matrices are as assumed
check("true pose in the work frame", inside, [-0.1, -0.2, 0.2, 0.1, 0.2, 0.3 - np.pi / 2])
check("Python, base2workframe", algo.rm_algo_base2workframe(given, pose(base)), work)
check("Python, base2workframe, another pose", algo.rm_algo_base2workframe(given, pose(np.zeros(6))), work)
check("Python, workframe2base, pose in base", algo.rm_algo_workframe2base(given, pose(base)), inside)
wrong = numbers(np.linalg.inv(matrix(work)) @ matrix(inside))
check("Python, workframe2base, pose in work frame", algo.rm_algo_workframe2base(given, pose(inside)), wrong)
assert np.allclose(wrong[:3], [-0.3, 0.4, 0.0])
check("C, base2workframe, pose in work frame", by_c(c.rm_algo_base2workframe, given, pose(inside)), base)
check("C, workframe2base, pose in base", by_c(c.rm_algo_workframe2base, given, pose(base)), inside)
PYTHON
