"""When the workcell's cameras look, what a user may ask of them, and where they stand."""

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.geometry.pose import inverse, pose
from armsight.robot.arm_file import open_arm
from armsight.sim.camera.stages import CameraPipeline
from armsight.sim.workcell.cameras import (
    DISTANCE_M,
    RIGS,
    WEBCAMS,
    CameraTiming,
    open_cameras,
    open_rig,
    rig_pose,
    shot_times,
)


def test_shots_come_at_their_rate_and_are_stamped_when_they_came():
    timing = CameraTiming()
    times = [shot_times(timing, 4, k) for k in range(400)]
    left = np.array([t.left_s for t in times])
    assert np.abs(np.diff(left) - 1 / 60).max() < 1e-12
    late = np.array([t.stamp_s for t in times]) - left
    # Middle to end of the exposure, the delay, and a jitter that is cut at three sigma.
    assert np.abs(late - timing.exposure_s / 2 - timing.delay_s).max() <= 3 * timing.jitter_s + 1e-12
    assert late.std() == pytest.approx(timing.jitter_s, rel=0.1)  # 400 samples determine it to 3.5 %


@pytest.mark.parametrize("timing", [CameraTiming(), WEBCAMS])
def test_the_right_camera_is_as_far_off_as_it_says(timing):
    times = [shot_times(timing, 1, k) for k in range(400)]
    apart = np.array([t.right_s - t.left_s for t in times]) - timing.skew_s
    assert np.abs(apart).max() <= timing.sync_s
    assert apart.std() == pytest.approx(timing.sync_s / np.sqrt(3), rel=0.1)


def test_a_shot_is_the_same_whatever_came_before():
    assert shot_times(CameraTiming(), 2, 17) == shot_times(CameraTiming(), 2, 17)
    assert shot_times(CameraTiming(), 2, 17) != shot_times(CameraTiming(), 3, 17)


def test_what_can_be_asked_for():
    assert open_cameras("1280x720@60") == open_cameras("clean") == (CameraTiming(), None)
    fast, _ = open_cameras("1920x1080@120")
    assert (fast.image_size_px, fast.rate_hz, fast.exposure_s) == ((1920, 1080), 120.0, 0.002)
    assert open_cameras("webcams") == (WEBCAMS, None)
    assert WEBCAMS.skew_s > 1e-3
    assert WEBCAMS.row_s > 0
    assert open_cameras("webcams:640x480@15")[0].rate_hz == 15.0
    assert open_cameras("1280x720@400")[0].exposure_s <= 1 / 800


def test_a_preset_brings_its_timing_and_its_stages():
    timing, pipeline = open_cameras("webcam-good-light:640x480@30")
    assert (timing.image_size_px, timing.exposure_s, timing.skew_s) == ((640, 480), 0.008, 0.004)
    assert timing.row_s * 480 == pytest.approx(0.0144)
    assert pipeline == CameraPipeline.load("webcam-good-light")


def test_a_camera_that_is_faster_than_its_preset_gets_less_light():
    timing, pipeline = open_cameras("webcam-poor-light:1280x720@60")
    assert timing.exposure_s == pytest.approx(0.95 / 60)
    assert 1e-3 * pipeline.timing.exposure_ms == timing.exposure_s
    assert pipeline.sensor.white_e == pytest.approx(500 * timing.exposure_s / 0.030)


@pytest.mark.parametrize(
    "spec",
    ["", "1280x720", "1280@60", "1280x720@0", "1280x720@1000", "10x10@60", "9999x9999@60", "usb:1280x720@60", "webcam"],
)
def test_what_cannot_be_is_rejected(spec):
    with pytest.raises(InputError, match="cameras"):
        open_cameras(spec)


def test_rigs_are_parallel_or_verge():
    parallel, verging = (open_rig(name, (1280, 720)) for name in ("parallel", "verging"))
    assert parallel.baseline_m == pytest.approx(0.2)
    assert verging.baseline_m == pytest.approx(0.2)
    assert parallel.convergence_deg < 0.6  # as mounts are
    assert 10 < verging.convergence_deg < 16
    with pytest.raises(InputError, match="known are parallel, verging"):
        open_rig("round", (1280, 720))


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("seed", range(3))
def test_the_cameras_look_at_the_body(name, seed):
    model, rig = open_arm("six_r"), open_rig(name, (1280, 720))
    T_tool_body = pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, 0.03]))
    T_base_rig = rig_pose(model, rig, T_tool_body, seed)
    p = (inverse(T_base_rig) @ model.forward(model.home) @ T_tool_body)[:3, 3]
    assert np.linalg.norm(p) == pytest.approx(DISTANCE_M, abs=0.05)
    for camera, T in ((rig.left, np.eye(4)), (rig.right, inverse(rig.T_left_right))):
        uv = camera.project((T[:3, :3] @ p + T[:3, 3])[None])[0]
        assert (np.abs(uv - (640, 360)) < (350, 160)).all()
    assert T_base_rig[2, 1] < -0.9  # upright
