"""Hand-eye calibration from one recording: images, /tf and /joint_states; at rest at each shot, and in motion."""

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, log_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.loop.handeye.recording import Seen, at_shots, links_of, paired, robot_in_recording
from armsight.robot.arm_file import open_arm
from armsight.sim.example_rig import board_poses, example_rig
from armsight.sim.render.optics import Optics, Sensor
from armsight.sim.render.render import render_pair
from armsight.sim.render.scene import PosedBody, chessboard
from armsight.tables.poses import PoseTable
from bag_files import EPOCH_NS, Joints, Pixels, Sent, Transforms, write_bag
from cli_runs import assert_rejected

SIZE, SPEC = (480, 360), "chessboard:8x5:30mm"
T_BASE_RIG = pose(exp_so3(np.array([1.2, -0.9, 0.4])), np.array([0.5, -0.2, 0.6]))
T_FLANGE_BODY = pose(exp_so3(np.array([0.3, 0.2, -0.5])), np.array([0.04, -0.02, 0.08]))
T_TOOL_FLANGE = pose(exp_so3(np.array([0.1, 0.2, 0.3])), np.array([0.0, 0.0, 0.1]))
SECOND_NS = 1_000_000_000


@lru_cache
def cameras():
    """The rig, and the board's pattern."""
    return example_rig(SIZE, focal_px=420.0), chessboard(8, 5, 0.03)


def sent_at(t_s, T_rig_body, seed, left_s=0.0):
    """The pair of images of a pose, and T_base_flange of it; stamped at t_s + left_s."""
    rig, pattern = cameras()
    images = render_pair(
        rig.cameras, rig.T_left_right, [PosedBody((pattern,), T_rig_body)],
        optics=Optics(psf_sigma_px=0.7), sensor=Sensor(), rng=np.random.default_rng(seed),
    )  # fmt: skip
    stamp = EPOCH_NS + int((t_s + left_s) * SECOND_NS)
    pair = [
        Sent(f"/{side}/image_raw", stamp, Pixels(image)) for side, image in zip(("left", "right"), images, strict=True)
    ]
    return pair, T_BASE_RIG @ T_rig_body @ inverse(T_FLANGE_BODY)


def moved(t_s, T_base_flange):
    """The message of the transform, by way of the tool's frame."""
    T = T_base_flange @ inverse(T_TOOL_FLANGE)
    return Sent("/tf", EPOCH_NS + int(t_s * SECOND_NS), Transforms([("base_link", "tool0", T)]))


STATIC = Sent("/tf_static", EPOCH_NS, Transforms([("tool0", "flange", T_TOOL_FLANGE)]))


@pytest.fixture(scope="module")
def at_rest(tmp_path_factory):
    """A recording of an arm that rests at each of 14 shots, a second apart, and its rig."""
    folder = tmp_path_factory.mktemp("rest")
    rig, pattern = cameras()
    sent, joints = [STATIC], np.random.default_rng(5).uniform(-0.5, 0.5, (14, 6))
    for k, T in enumerate(board_poses(np.random.default_rng(3), rig, pattern, 14)):
        pair, T_base_flange = sent_at(1.0 + k, T, k)
        sent += [*pair, *(moved(1.0 + k + dt, T_base_flange) for dt in (-0.2, 0.0, 0.2))]
        names = [
            "wrist_3_joint",
            "shoulder_pan_joint",
            "shoulder_lift_joint",
            "elbow_joint",
            "wrist_1_joint",
            "wrist_2_joint",
        ]
        sent.append(Sent("/joint_states", pair[0].stamp_ns, Joints(names, joints[k][[5, 0, 1, 2, 3, 4]])))
    pair, _ = sent_at(30.0, T, 30)  # after the last transform
    sent = sorted([*sent, *pair], key=lambda each: each.stamp_ns)
    rig.save(folder / "rig.json")
    return write_bag(folder / "run", "mcap", sent), folder / "rig.json", joints


def options(bag, rig, *more):
    """The command line."""
    source = ("--eye", "to-hand", "--rig", rig, "--source", f"bag:{bag}", "--target", SPEC)
    return ("handeye", "--robot", f"bag:{bag}", *source, "--json", *more)


def test_poses_at_the_times_of_the_shots(armsight, at_rest):
    bag, rig, _ = at_rest
    said = armsight(*options(bag, rig, "--columns", "frames=base_link:flange")).done()
    document = json.loads(said.out)
    off = log_se3(inverse(T_BASE_RIG) @ np.array(document["T_base_rig"]))
    assert np.linalg.norm(off[:3]) < 5e-4
    assert np.linalg.norm(off[3:]) < 2e-3
    off = log_se3(inverse(T_FLANGE_BODY) @ np.array(document["T_flange_body"]))
    assert np.linalg.norm(off[:3]) < 5e-4
    assert np.linalg.norm(off[3:]) < 2e-3
    assert len(document["poses"]) == 14
    assert "1 images without a row" in said.err  # the one after the last transform
    assert "the arm moves" not in said.err


def test_joints_are_read_by_their_names(at_rest):
    bag, _, joints = at_rest
    arm = open_arm("ur3e")
    table = robot_in_recording(bag, None, arm)
    np.testing.assert_allclose(table.q, joints, atol=1e-12)
    np.testing.assert_allclose(table.Ts, arm.forward(joints), atol=1e-12)


def stream(t_s, Ts, **more):
    """A recording's poses."""
    n = len(t_s)
    given = {
        "numbers": np.zeros((n, 0)),
        "written": np.zeros((n, 0)),
        "q": None,
        "names": None,
        "notes": (),
        "of_joints": False,
    } | more
    return PoseTable(
        path=Path("a.bag"), lines=np.arange(n), Ts=Ts, convention="", t_s=np.asarray(t_s, float), unit_m=1.0,
        missed=("",) * n, **given,
    )  # fmt: skip


def shots(t_s):
    """Shots of a target."""
    n = len(t_s)
    names = tuple(str(k) for k in range(n))
    return Seen(np.tile(np.eye(4), (n, 1, 1)), np.zeros((n, 6, 6)), names, ("",) * n, np.array(t_s), np.zeros(3))


def test_shots_in_a_gap_in_which_the_arm_moved_get_no_pose():
    there = np.tile(np.eye(4), (6, 1, 1))
    there[3:, 0, 3] = 0.3
    times = [0.0, 0.1, 0.2, 30.0, 30.1, 40.0]  # it rested from 30.1 to 40 s
    found = at_shots(stream(times, there), shots([0.15, 15.0, 30.05, 35.0]))
    assert found.names == ("0", "2", "3")
    assert any("1 shots are in gaps" in note for note in found.notes)
    with pytest.raises(InputError, match="the images have none"):
        at_shots(stream(times, there), replace(shots([0.1]), t_s=None))
    with pytest.raises(InputError, match="two recordings, or clocks that differ"):
        at_shots(stream(times, there), shots([99.0]))


def test_a_log_that_stopped_is_named():
    poses = np.array([exp_se3(np.array([0.01 * k, 0.02 * k, 0.5, 0.1 * k, -0.1 * k, 0.05])) for k in range(14)])
    moved, stopped = replace(shots(np.arange(14.0)), Ts=poses), poses.copy()
    stopped[9:] = stopped[8]
    assert len(paired(stream(np.arange(14.0), poses), moved, True, None).rows) == 14
    table = stream(np.arange(14.0), stopped)
    with pytest.raises(InputError, match="lines 8 to 13: 6 rows hold the very same pose"):
        paired(table, moved, True, None)


def test_poses_of_a_tcp_beside_the_joints_are_those_of_the_tcp():
    arm, q = open_arm("ur3e"), np.random.default_rng(2).uniform(-1, 1, (12, 6))
    T_flange_tcp = pose(exp_so3(np.array([0.5, 0.0, 0.0])), np.array([0.0, 0.0, 0.15]))
    table = stream(np.arange(12.0), arm.forward(q) @ T_flange_tcp, q=q)
    recording = paired(table, shots(np.arange(12.0)), True, arm)
    assert any("are of a TCP at [0.0 0.0 150.0] mm" in note for note in recording.notes)
    own = paired(replace(table, Ts=np.asarray(arm.forward(q)), of_joints=True), shots(np.arange(12.0)), True, arm)
    assert not any("TCP" in note for note in own.notes)
    levers = [links_of(one.robot, arm, np.arange(12.0))(np.zeros(1))[0, 0, :3, 3] for one in (recording, own)]
    assert np.linalg.norm(levers[0] - levers[1]) == pytest.approx(0.15, abs=1e-6)


def test_what_a_recording_lacks_is_said(armsight, at_rest, tmp_path):
    bag, rig, _ = at_rest
    assert_rejected(armsight(*options(bag, rig)), "needs --columns frames=BASE:FLANGE")
    assert_rejected(armsight(*options(bag, rig, "--columns", "frames=base_link")), "two frames are needed, such as")
    assert_rejected(
        armsight(*options(bag, rig, "--columns", "frames=base_link:ee")), "no frame 'ee'", "base_link, flange, tool0"
    )
    assert_rejected(armsight(*options(bag, rig, "--columns", "frames=tool0:flange")), "fixed transform")
    assert_rejected(armsight(*options(bag, rig, "--model", "iiwa")), "holds the joints")
    assert_rejected(
        armsight(*options(bag, rig, "--columns", "frames=base_link:flange", "--columns", "units=mm")),
        "belongs to tables",
    )
    (tmp_path / "poses.csv").write_text("x_m\n")
    table = options(bag, rig, "--columns", "frames=base_link:flange")
    assert_rejected(armsight(*table[:2], tmp_path / "poses.csv", *table[3:]), "--columns frames= belongs to recordings")
    assert_rejected(armsight(*table[:2], tmp_path / "none.bag", *table[3:]), "no such recording")


def test_an_arm_in_motion_and_images_that_come_late(armsight, tmp_path):
    rig, pattern = cameras()
    middle = board_poses(np.random.default_rng(8), rig, pattern, 1, fill=(0.5, 0.6), tilt_deg=5.0)[0]

    def T_rig_body(t):
        swing = np.array([0.05 * np.sin(1.1 * t), 0.04 * np.sin(1.7 * t + 1.0), 0.05 * np.sin(0.9 * t)])
        return middle @ exp_se3(
            np.array([*swing, *(0.4 * np.sin(np.array([1.3, 0.8, 1.9]) * t + np.array([0.0, 2.0, 1.0])))])
        )

    sent = [STATIC]
    for k in range(38):
        pair, _ = sent_at(0.5 + k / 5, T_rig_body(0.5 + k / 5), k, left_s=0.06)
        sent += pair
    for k in range(430):
        sent.append(moved(k / 50, T_BASE_RIG @ T_rig_body(k / 50) @ inverse(T_FLANGE_BODY)))
    bag = write_bag(tmp_path / "run", "ros1", sorted(sent, key=lambda each: each.stamp_ns))
    rig.save(tmp_path / "rig.json")
    frames = ("--columns", "frames=base_link:flange")
    said = armsight(*options(bag, tmp_path / "rig.json", *frames))
    assert "images come later than their stamps say: --streams" in said.err
    said = armsight(*options(bag, tmp_path / "rig.json", *frames, "--streams")).done()
    document = json.loads(said.out)
    assert document["clock_offset_s"] == pytest.approx(-0.06, abs=1e-3)
    off = log_se3(inverse(T_BASE_RIG) @ np.array(document["T_base_rig"]))
    assert np.linalg.norm(off[:3]) < 1e-3
    assert np.linalg.norm(off[3:]) < 3e-3
