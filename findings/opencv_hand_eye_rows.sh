#!/bin/sh
# opencv-contrib-python 4.14.0.94 and 5.1.0.95: calibrateHandEye takes translations of shape (1, 3) for zero.
#
# aruco and many wrappers keep a translation as a row, (1, 3). calibrateHandEye accepts rows in place of columns and says
# nothing: it copies each translation into a 4 x 4 matrix, where a row does not fit, and nothing is copied. With Tsai, Park
# and Horaud the rotation is right, for it needs no translation, and the translation is 0, whatever the poses;
# Daniilidis gives NaN. Where only the target's are rows, as aruco's are, and the gripper's columns, the translation looks
# plausible and is wrong by 0.4 m. Shapes (3,) and (3, 1) are right.
#
# calibrateRobotWorldHandEye of 4.14 takes (3,), that of 5.1 raises for it.
#
# Seen, 4.14.0 and 5.1.0, a gripper's camera 391 mm away along its longest axis: (3,) and (3, 1) right, (1, 3) [0 0 0],
# rows of the target alone [0.049 0.105 -0.018] m; world and hand eye with (3,): 4.14 right, 5.1 error.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for version in 4.14.0.94 5.1.0.95; do
    python3 -m venv "$folder/$version"
    "$folder/$version/bin/pip" install --quiet numpy==2.3.5 opencv-contrib-python==$version
    "$folder/$version/bin/python" - <<'PYTHON'
import cv2
import numpy as np

rng = np.random.default_rng(1)


def drawn():
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rng.normal(size=(3, 1)))[0], 0.3 * rng.normal(size=3)
    return T


T_gripper_camera, T_base_target = drawn(), drawn()
Ts_base_gripper = [drawn() for _ in range(12)]
Ts_camera_target = [np.linalg.inv(T @ T_gripper_camera) @ T_base_target for T in Ts_base_gripper]


def parts(Ts, shape):
    return [T[:3, :3] for T in Ts], [T[:3, 3].reshape(shape) for T in Ts]


found = {}
mixed = (*parts(Ts_base_gripper, (3, 1)), *parts(Ts_camera_target, (1, 3)))
R, t = cv2.calibrateHandEye(*mixed)
print(f"{cv2.__version__} rows of the target alone: translation is {np.round(t.ravel(), 3)}")
assert np.allclose(R, T_gripper_camera[:3, :3], atol=1e-6)
assert np.abs(t.ravel() - T_gripper_camera[:3, 3]).max() > 0.4
for method in ("TSAI", "PARK", "HORAUD", "DANIILIDIS"):
    for shape in ((3,), (3, 1), (1, 3)):
        given = (*parts(Ts_base_gripper, shape), *parts(Ts_camera_target, shape))
        R, t = cv2.calibrateHandEye(*given, method=getattr(cv2, f"CALIB_HAND_EYE_{method}"))
        found[method, shape] = R, t.ravel()
        off = 1e3 * np.abs(t.ravel() - T_gripper_camera[:3, 3]).max()
        print(f"{cv2.__version__} {method:11} {shape!s:7} translation off by {off:.0f} mm, it is {np.round(t.ravel(), 3) + 0.0}")
for (method, shape), (R, t) in found.items():
    if shape != (1, 3):
        assert np.allclose(t, T_gripper_camera[:3, 3], atol=1e-6)
    elif method == "DANIILIDIS":
        assert np.isnan(t).all()
    else:
        assert np.allclose(R, T_gripper_camera[:3, :3], atol=1e-6)
        assert np.abs(t).max() < 1e-9

flat = (*parts([np.linalg.inv(T) for T in Ts_camera_target], (3,)), *parts([np.linalg.inv(T) for T in Ts_base_gripper], (3,)))
try:
    cv2.calibrateRobotWorldHandEye(*flat)
    said = "right"
except cv2.error:
    said = "error"
print(f"{cv2.__version__} world and hand eye with (3,): {said}")
assert said == ("right" if cv2.__version__ < "5" else "error")
PYTHON
done
