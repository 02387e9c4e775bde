"""Records as people see them: one line, whatever they hold."""

import numpy as np

from armsight.data import Body, Correspondences, Points, PoseEstimate, Shot
from armsight.geometry.pose import pose
from armsight.robot.arm_file import open_arm
from strategies import ordinary_rig


def test_records_print_as_one_line():
    rig = ordinary_rig("brown5")
    shot = Shot("000", np.zeros((480, 640), np.uint8), None, 0.25)
    assert repr(shot) == "Shot(name='000', left=<480 x 640 uint8>, right=None, t_s=0.25, problem=None, encoded=None)"
    assert repr(Body("plate", ("A", "B"), np.eye(3)[:2])) == (
        "Body(name='plate', point_names=('A', 'B'), points=<2 x 3 float64>)"
    )
    width, height = rig.left.image_size_px
    assert repr(rig.left).startswith(f"Camera({width}x{height} px, brown5, fx fy cx cy {rig.left.intrinsics[0]:.6g}, ")
    assert f"baseline {1e3 * rig.baseline_m:.6g} mm" in repr(rig)
    seen = Correspondences(np.arange(40), np.zeros((40, 2, 2)), np.zeros((40, 2, 2, 2)))
    points = Points(np.arange(40), np.zeros((40, 3)), np.zeros((40, 3, 3)), np.zeros((40, 3, 24)), seen)
    T = pose(np.eye(3), np.array([0.1, -0.25, 0.8]))
    estimate = PoseEstimate(T, np.eye(6), np.eye(6), 1e-4, 0.123456789, 1.0, points)
    assert repr(estimate).startswith("PoseEstimate(x 100.000 +- 1000.000, y -250.000 +- 1000.000, z 800.000 ")
    assert "a=[0, " in repr(open_arm("ur10"))
    assert "table" not in repr(ordinary_rig())
    for record in (rig, shot, points, estimate, open_arm("six_r")):
        assert "\n" not in repr(record)
        assert len(repr(record)) < 1000


def test_a_class_may_have_a_text_of_its_own():
    assert repr(ordinary_rig()).startswith("StereoRig(left=Camera(")
