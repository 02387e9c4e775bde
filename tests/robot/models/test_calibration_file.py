"""Calibration files of single arms: read exactly, written back, and mistakes in them."""

import dataclasses

import numpy as np
import pytest
from makers_chains import CHAINS
from scipy.spatial.transform import Rotation

from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.robot.calibration_file import UR_NAMES, calibration_text, difference, read_calibration, write_calibration
from armsight.robot.models import MODELS

yaml = pytest.importorskip("yaml")
KEYS = ("x", "y", "z", "roll", "pitch", "yaw")


def document(name, seed=None):
    """A file as the makers' tools write it; with a seed off by what single arms are: some 0.1 mm and 0.1 deg."""
    rng = np.random.default_rng(seed)
    names = UR_NAMES if name.startswith("ur") else [f"joint{i + 1}" for i in range(len(CHAINS[name]) - 1)]
    kinematics = {}
    for joint, (xyz, rpy, _) in zip(names, CHAINS[name], strict=False):
        off = rng.normal(0, [2e-4] * 3 + [2e-3] * 3) if seed is not None else np.zeros(6)
        kinematics[joint] = {k: float(v) for k, v in zip(KEYS, np.array([*xyz, *rpy]) + off, strict=True)}
    return {"kinematics": kinematics | ({"hash": "calib_1"} if name.startswith("ur") else {})}


def product(kinematics, names, q):
    """The last joint's frame by the file itself (slow and obvious)."""
    T = np.eye(4)
    for name, angle in zip(names, q, strict=True):
        at = kinematics[name]
        R = Rotation.from_euler("xyz", [at[k] for k in KEYS[3:]]) * Rotation.from_euler("z", angle)
        T = T @ pose(R.as_matrix(), np.array([at[k] for k in KEYS[:3]]))
    return T


@pytest.mark.parametrize("name", ["ur5e", "ur10", "xarm6", "xarm7"])
def test_a_calibration_is_read_exactly_and_written_back(name, tmp_path):
    nominal, path = MODELS[name], tmp_path / "calibration.yaml"
    given = document(name, seed=4)
    path.write_text(yaml.safe_dump(given))
    arm = read_calibration(path, nominal)
    names = [key for key in given["kinematics"] if key != "hash"]
    for q in np.random.default_rng(1).uniform(-2, 2, (10, arm.joints)):
        np.testing.assert_allclose(arm.forward(q), product(given["kinematics"], names, q), atol=1e-9)
    found = difference(nominal, arm)
    assert 1e-4 < found.mean_m < 2e-2
    left = write_calibration(arm, nominal, tmp_path / "again.yaml")
    assert max(left) < 1e-8
    again = read_calibration(tmp_path / "again.yaml", nominal)
    assert difference(arm, again).most_m < 1e-8
    for joint, at in yaml.safe_load((tmp_path / "again.yaml").read_text())["kinematics"].items():
        # The frames are the makers', but for what may be chosen along an axis; the xArm 6 has a rotation about one as well.
        if joint != "hash" and name != "xarm6":
            np.testing.assert_allclose(at["x"], given["kinematics"][joint]["x"], atol=5e-3)


def test_the_nominal_file_is_the_nominal_arm(tmp_path):
    for name in ("ur5e", "xarm7"):
        path = tmp_path / f"{name}.yaml"
        path.write_text(yaml.safe_dump(document(name)))
        found = difference(MODELS[name], read_calibration(path, MODELS[name]))
        assert found.most_m < 1e-12
        text, off_m, off_rad = calibration_text(MODELS[name], MODELS[name])
        assert max(off_m, off_rad) < 1e-12
        for joint, at in yaml.safe_load(text)["kinematics"].items():
            if joint != "hash":
                nominal = document(name)["kinematics"][joint]
                np.testing.assert_allclose([at[k] for k in KEYS[:3]], [nominal[k] for k in KEYS[:3]], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.pop("kinematics"), "expected kinematics"),
        (lambda d: d["kinematics"].pop("forearm"), "forearm is missing; ur5e has shoulder"),
        (lambda d: d["kinematics"]["wrist_2"].update(yaw="a"), "wrist_2: yaw is 'a', must be a number"),
        (lambda d: d["kinematics"]["forearm"].update(x=-425.0), "mm from that of ur5e on the mean: .* or in mm"),
    ],
)
def test_a_file_that_is_none_is_rejected(change, said, tmp_path):
    given, path = document("ur5e"), tmp_path / "calibration.yaml"
    change(given)
    path.write_text(yaml.safe_dump(given))
    with pytest.raises(InputError, match=said):
        read_calibration(path, MODELS["ur5e"])


def test_what_a_file_cannot_hold_is_rejected():
    ur5e = MODELS["ur5e"]
    with pytest.raises(InputError, match="such a file cannot hold"):
        calibration_text(dataclasses.replace(ur5e, direction=-np.ones(6)), ur5e)
    with pytest.raises(InputError, match="7 joints, ur5e 6"):
        calibration_text(MODELS["xarm7"], ur5e)
