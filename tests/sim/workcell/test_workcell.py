"""The workcell as a whole, with the firmware compiled for this computer."""

from dataclasses import replace

import numpy as np
import pytest

from armsight.data import JointCommand
from armsight.errors import DeviceError, InputError
from armsight.geometry.pose import inverse
from armsight.robot.boards.codes import BoardState
from armsight.robot.trajectories import point_to_point
from armsight.sim.references.inertial import InertialErrors, InertialUnit
from armsight.sim.workcell.workcell import _T_TOOL_UNIT, CHESSBOARD, Workcell
from armsight.vision.markers.board import open_board

pytestmark = pytest.mark.usefixtures("host_firmware")
SMALL = "640x360@60"


@pytest.fixture
def workcell():
    with Workcell.open(arm="worn", cameras=SMALL, seed=3, emulator="host") as made:
        yield made


def go(workcell, q_from, q_to, rest_s=0.4, each=lambda: None):
    """Move from pose to pose as a host does, with a command every 10 ms; return the potentiometers' readings."""
    path = point_to_point(workcell.model, q_from, q_to)
    times, readings = [], []
    for k in range(round((path.duration_s + rest_s) * 100)):
        at = path.at(0.01 * (k + 1))
        workcell.board.send(JointCommand(at.q, at.qd, workcell.gravity_duty(at.q), 0.01))
        states = workcell.board.receive(0.01)
        times.append(states.t_s)
        readings.append(states.q)
        each()
    return np.concatenate(times), np.concatenate(readings)


def test_a_unit_on_the_tool_is_read_as_time_passes(workcell):
    """At rest it reads gravity along what is up in its axes; each reading comes once, none of later than was asked for."""
    unit = InertialUnit(InertialErrors(rate_hz=500.0, noise=np.full(6, 1e-9)), np.random.default_rng(0))
    read = workcell.carry(unit)
    parts = []
    for end_s in workcell.t_s + np.array([0.1, 0.104, 0.2]):
        workcell.advance(end_s + 0.01 - workcell.t_s)
        parts.append(read(end_s))
        assert parts[-1][0][-1] <= end_s
    t_s, z = (np.concatenate(each) for each in zip(*parts, strict=True))
    np.testing.assert_allclose(np.diff(t_s), 2e-3, atol=1e-9)
    R = workcell.truth.T_base_tool[-1, :3, :3] @ _T_TOOL_UNIT[:3, :3]
    np.testing.assert_allclose(z[-10:].mean(axis=0), [0, 0, 0, *(9.80665 * R[2])], atol=0.05)  # held, it still swings


def test_the_arm_follows_and_comes_to_rest(workcell):
    workcell.advance(0.05)
    workcell.board.enable()
    workcell.board.receive()
    q = workcell.poses[0]
    times, readings = go(workcell, workcell.model.home, q)
    assert workcell.board.status.state == BoardState.ENABLED
    assert workcell.board.status.faults == ()
    # At rest the potentiometers say what was asked for, but for their noise and what friction holds.
    assert np.abs(readings[-100:].mean(axis=0) - q).max() < np.deg2rad(0.15)
    truth = workcell.truth
    at_rest = truth.q[-150:]
    assert np.ptp(at_rest, axis=0).max() < np.deg2rad(0.05)
    # A reading stamped k ms is of the shaft as it was at k ms.
    rows = np.rint(times * 1000).astype(int)
    off = readings - truth.shaft[rows] - workcell.plant.pots.error(truth.shaft[rows])
    speed = np.gradient(truth.shaft, 1e-3, axis=0)[rows]
    late = (speed * off).sum(axis=0) / (speed**2).sum(axis=0)
    assert np.abs(late).max() < 1e-4  # s; the noise of some 1000 readings determines it to 2e-5 s


def test_what_the_potentiometers_say_misleads_by_millimetres(workcell):
    workcell.advance(0.05)
    workcell.board.enable()
    workcell.board.receive()
    _, readings = go(workcell, workcell.model.home, workcell.poses[1])
    said, true = workcell.model.forward(readings[-1]), workcell.truth.T_base_tool[-1]
    assert 1e-3 < np.linalg.norm(said[:3, 3] - true[:3, 3]) < 15e-3


def test_shots_come_when_they_should(workcell):
    first = workcell.source.read()
    for _ in range(5):
        shot = workcell.source.read()
    assert int(shot.name) == int(first.name) + 5
    assert 0 <= workcell.t_s - shot.t_s < 1e-3  # handed out in the millisecond in which it came
    assert shot.t_s - workcell.truth.shot_t_s[shot.name] == pytest.approx(
        workcell.timing.exposure_s / 2 + workcell.timing.delay_s, abs=3 * workcell.timing.jitter_s
    )
    assert workcell.poll() is None
    workcell.advance(0.100)
    newest = workcell.poll()
    assert int(newest.name) == int(shot.name) + 6  # those between are gone, as in a camera's queue of one
    assert workcell.poll() is None
    assert newest.left.shape == (360, 640)
    assert newest.left.dtype == np.uint8


def test_the_body_is_in_the_images_where_the_truth_says():
    with Workcell.open(arm="used", cameras="1280x720@30", seed=1, emulator="host") as workcell:
        workcell.board.enable()
        _look_all_the_way(workcell)


def _look_all_the_way(workcell):
    discs, worst = workcell.target.discs, []

    def look():
        shot = workcell.poll()
        if shot is None:
            return
        truth = workcell.truth
        times = workcell.source.taken[shot.name]
        for side, t in (("left", times.left_s), ("right", times.right_s)):
            k = int(t * 1000)
            q = truth.q[k] + (t * 1000 - k) * (truth.q[k + 1] - truth.q[k])
            T = inverse(truth.T_base_rig) @ truth.arm.forward(q) @ truth.T_tool_body
            camera = truth.rig.left if side == "left" else truth.rig.right
            T = T if side == "left" else inverse(truth.rig.T_left_right) @ T
            uv = camera.project(discs.body.points[:5] @ T[:3, :3].T + T[:3, 3])
            found = discs.find(shot.image(side)).uv
            worst.append(np.median(np.linalg.norm(found[:, None] - uv, axis=2).min(axis=0)))

    go(workcell, workcell.model.home, workcell.poses[2], each=look)
    # A disc at a slant is found beside the image of its middle by up to some hundredths of a pixel.
    assert len(worst) > 60
    assert max(worst) < 0.1


def test_a_card_hides_the_body_from_both_cameras(workcell):
    workcell.cover(0.30, 0.40)
    counts = {}
    while workcell.t_s < 0.6:
        shot = workcell.source.read()
        counts[workcell.truth.shot_t_s[shot.name]] = min(
            len(workcell.target.discs.find(shot.image(s)).uv) for s in ("left", "right")
        )
    assert all((n < 3) == (0.30 <= t < 0.40) for t, n in counts.items() if min(abs(t - 0.3), abs(t - 0.4)) > 2e-4)


def test_the_board_is_seen(workcell):
    before = workcell.t_s
    board = open_board(CHESSBOARD)
    for shot in workcell.board_shots(4):
        for side in ("left", "right"):
            assert board.detect(shot.image(side)).problem is None
    assert workcell.t_s == before


def test_cameras_that_are_unplugged_say_so(workcell):
    workcell.source.read()
    gone_s = workcell.t_s + 0.05
    workcell.source.unplug(gone_s)
    while workcell.t_s < gone_s - 1 / 60 - 1e-9:
        workcell.source.read()
    with pytest.raises(DeviceError, match="no frame"):
        workcell.source.read()
    assert workcell.t_s == pytest.approx(gone_s)
    with pytest.raises(DeviceError, match="no frame"):
        workcell.poll()


def test_the_button_stops_the_arm(workcell):
    workcell.advance(0.05)
    workcell.board.enable()
    workcell.plant.stop_pressed = True
    workcell.board.receive(0.05)
    assert workcell.board.status.state == BoardState.STOPPED
    before = workcell.truth.shaft[-1]
    workcell.advance(0.3)
    assert np.abs(workcell.truth.shaft[-1] - before).max() < 1e-5


def test_the_same_seed_gives_the_same_numbers():
    for first, second in zip(_numbers(7), _numbers(7), strict=True):
        assert np.array_equal(first, second)


def _numbers(seed):
    """All that a short run hands out."""
    with Workcell.open(arm="worn", cameras="320x240@120", seed=seed, emulator="host") as workcell:
        workcell.board.enable()
        polled = []
        _, readings = go(workcell, workcell.model.home, workcell.poses[0], 0.0, lambda: polled.append(workcell.poll()))
        shots = [shot for shot in polled if shot is not None]
        images = np.stack([image for shot in shots for image in (shot.left, shot.right)])
        return readings, images, [shot.t_s for shot in shots], workcell.truth.q, next(workcell.board_shots(1)).left


def test_a_picture_of_the_workcell(workcell):
    picture = workcell.picture((320, 180))
    assert picture.shape == (180, 320, 3)
    assert picture.std() > 20
    orange = (picture[..., 2].astype(int) - picture[..., 0] > 60).mean()
    assert 0.01 < orange < 0.6  # the arm and the wood


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"arm": "rusty"}, "nominal, used, worn"),
        ({"cameras": "8k"}, "1280x720@60"),
        ({"emulator": "tape"}, "unicorn"),
        ({"rig": "one"}, "parallel, verging"),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
    ],
)
def test_a_wrong_name_is_reported_with_the_right_ones(given, said):
    with pytest.raises(InputError, match=said):
        Workcell.open(**{"emulator": "host", "cameras": "320x240@60", **given})


def test_what_the_arm_is_accepted_to_be_changes_nothing_of_what_it_is(workcell):
    off = replace(workcell.model, a=workcell.model.a + 0.002, name="accepted")
    with Workcell.open(arm="worn", cameras=SMALL, seed=3, emulator="host", assumed=off) as other:
        assert other.model is off
        for name in ("T_base_rig", "T_tool_body"):
            assert np.array_equal(getattr(other.truth, name), getattr(workcell.truth, name))
        assert np.array_equal(other.plant.arm.table, workcell.plant.arm.table)
        assert np.array_equal(other.gravity_duty(off.home), workcell.gravity_duty(off.home))
        assert other.board.configuration() == workcell.board.configuration()
        assert not np.array_equal(other.poses, workcell.poses)


def test_a_workcell_like_another_sees_the_same_room_at_another_rate():
    with Workcell.open(seed=4, emulator="host", cameras=SMALL) as one:
        with Workcell.open(seed=4, emulator="host", cameras="640x360@120", like=one) as other:
            alone = Workcell.open(seed=4, emulator="host", cameras="640x360@120")
            with alone:
                for workcell in (other, alone):
                    workcell.advance(0.05)
                np.testing.assert_array_equal(other.source.read().left, alone.source.read().left)
        with pytest.raises(InputError, match="like"):
            Workcell.open(seed=5, emulator="host", cameras=SMALL, like=one)


def test_cameras_of_a_preset_give_the_same_images_again():
    def shots(cameras):
        with Workcell.open(seed=4, emulator="host", cameras=cameras) as workcell:
            board = next(workcell.board_shots(1))
            return [board, *(workcell.source.read() for _ in range(3))]

    first, second, clean = (shots(f"{name}320x240@30") for name in ("cheap-webcam:", "cheap-webcam:", ""))
    for one, other, plain in zip(first, second, clean, strict=True):
        np.testing.assert_array_equal(one.left, other.left)
        np.testing.assert_array_equal(one.right, other.right)
        assert (one.left != plain.left).any()
        assert np.corrcoef(one.left.ravel(), plain.left.ravel())[0, 1] > 0.9  # of the same scene
