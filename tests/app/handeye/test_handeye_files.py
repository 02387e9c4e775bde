"""Hand-eye calibration of files as other programs save them, and what is said of columns in another order."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cli_runs import assert_has

DATA = Path(__file__).parents[2] / "tables" / "data"
TRUTH = ([30, -60, 90], [3, -5, 88])


@pytest.mark.parametrize(
    "given",
    [
        ("--robot", DATA / "samples.yaml"),
        ("--robot", DATA / "samples.yaml", "--seen", DATA / "samples.yaml"),
        ("--robot", DATA / "samples.yaml", "--seen", DATA / "seen_xyzw.csv", "--columns", "seen:rotation=xyzw"),
        ("--robot", DATA / "matrices.json", "--seen", DATA / "seen_xyzw.csv", "--columns", "seen:rotation=xyzw"),
        *(
            (
                "--robot",
                DATA / name,
                "--columns",
                "rotation=xyz",
                "--columns",
                "units=mm",
                "--seen",
                DATA / "seen_xyzw.csv",
                "--columns",
                "seen:rotation=xyzw",
            )
            for name in ("poses.json", "poses.txt")
        ),
        ("--robot", DATA / "poses.mod", "--seen", DATA / "seen_xyzw.csv", "--columns", "seen:rotation=xyzw"),
        (
            *(
                "--robot",
                DATA / "rotation_first_robot.csv",
                "--columns",
                "rotation=rotvec",
                "--columns",
                "rx,ry,rz,x,y,z",
            ),
            *(
                "--seen",
                DATA / "rotation_first_seen.csv",
                "--columns",
                "seen:rotation=rotvec",
                "--columns",
                "seen:rx,ry,rz,x,y,z",
            ),
        ),
    ],
)
def test_hand_eye_of_samples_that_other_programs_saved(armsight, given):
    said = armsight("handeye", "--eye", "in-hand", "--json", *given).done()
    T = np.array(json.loads(said.out)["T_flange_rig"])
    np.testing.assert_allclose(1e3 * T[:3, 3], TRUTH[0], atol=0.6)  # three sigma of 20 poses that are 0.7 mm off
    np.testing.assert_allclose(Rotation.from_matrix(T[:3, :3]).as_euler("xyz", degrees=True), TRUTH[1], atol=0.05)


@pytest.mark.parametrize(
    ("robot", "both"), [("rotation_first_robot.csv", True), ("rotation_first_robot_xyz_first.csv", False)]
)
def test_a_rotation_before_the_position_is_named_as_such(armsight, robot, both):
    said = armsight(
        *(
            "handeye",
            "--robot",
            DATA / robot,
            "--columns",
            "rotation=rotvec",
            "--seen",
            DATA / "rotation_first_seen.csv",
        ),
        *("--columns", "seen:rotation=rotvec", "--eye", "in-hand"),
    )
    assert said.code == 2
    assert_has(said.err, "the rotation comes before the position", "--columns seen:rx,ry,rz,x,y,z")
    assert ("--columns rx,ry,rz,x,y,z" in said.err) == both
    assert "half of the rows then within 0.6 mm" in said.err
