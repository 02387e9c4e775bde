"""armsight replay and export on a short recording; the estimators of a run are replayed to the last digit."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mcap_protobuf")
pytest.importorskip("foxglove_schemas_protobuf")
pytest.importorskip("rosbags")

from armsight.app.replay.tables import compare
from armsight.app.stream.datum import Published
from armsight.app.stream.mcap_file import McapSink, properties
from armsight.data import JointStates, Missed, PoseEstimate, Shot
from armsight.geometry.pose import exp_se3, inverse, pose
from armsight.loop.estimators import Delay, KalmanEstimator, Mounting
from armsight.loop.running.data import NO_POINTS, EventDatum, JointsDatum, ShotDatum, estimator_event, mounting_event
from armsight.robot.arm_file import open_arm
from armsight.vision.markers.targets import open_target
from armsight.vision.rig import StereoRig
from armsight.vision.sources import open_source
from bag_files import EPOCH_NS, Joints, Pixels, Sent, write_bag
from cli_runs import assert_rejected

BODY = """name = "plate"
[[markers]]
name = "a"
position_mm = [0, 0, 0]
normal = [0, 0, 1]
x_axis = [1, 0, 0]
tag = { family = "tag36h11", id = 1, size_mm = 40 }
"""
ARM = open_arm("six_r")
MOUNTING = Mounting(
    pose(np.eye(3), np.array([0.1, 0.2, 1.0])), pose(np.eye(3), np.array([0.0, 0.0, 0.05])), np.zeros((12, 12))
)


def estimate(T, cov):
    return PoseEstimate(T, cov, 0.9 * cov, 1e-4, 0.1, 1.0, NO_POINTS)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run whose estimator was given joints and poses, some of them missed, one of them far off."""
    return made(tmp_path_factory.mktemp("run"))


def known_unit():
    """The samples of a unit on the tool of the run, and its calibration."""
    from armsight.loop.references.inertial import Inertial
    from armsight.sim.references.inertial import InertialErrors, record

    t_s = 1e-3 * np.arange(700)
    Ts = ARM.forward(ARM.home + 0.3 * np.sin(t_s)[:, None] * np.linspace(0.5, 1, 6))
    errors = InertialErrors(rate_hz=1000.0, bandwidth_hz=400.0, noise=np.full(6, 1e-5), step=np.full(6, 1e-6))
    known = replace(Inertial.of("imu", "icm-42688"), cov=np.diag(np.full(38, 1e-8)), sigma_delay_s=1e-3)
    return *record(t_s, Ts, errors, np.random.default_rng(1)), known


def made(folder, text="", readings=None):
    """Write a run to a folder and return that; with the text of references.toml it had that sensor, these its readings."""
    from armsight.loop.references.file import entries_of
    from armsight.loop.running.beside import fused
    from strategies import ordinary_rig

    stamps, z = readings or known_unit()[:2]
    unit = fused(entries_of(text, folder)[0]) if text else None
    more = {"references.toml": text} if text else {}

    rig = ordinary_rig("brown5")
    rng = np.random.default_rng(7)
    body_file = folder / "body.toml"
    body_file.write_text(BODY)
    published = Published(rig, open_target(str(body_file)).body, ARM, properties(rig, BODY, ARM, **more))
    sink = McapSink(folder / "run.mcap", published)
    sink.start()
    seen = []
    estimator = KalmanEstimator(ARM, delay=Delay(0.02, 0.01))
    sink.put(EventDatum(0.0, estimator_event(estimator, anew=False)))
    batches = []
    for k in range(120):
        if k == 60:
            estimator = KalmanEstimator(ARM, delay=Delay(0.018, 0.001), learns_delay=False)
            sink.put(EventDatum(0.004 * k, estimator_event(estimator, anew=True)))
            waiting = list(seen)
            for states in batches:
                estimator.joints(states)
                while waiting and waiting[0][0] <= states.t_s[-1]:
                    t_s, result = waiting.pop(0)
                    estimator.vision(MOUNTING.pose_measurement(result, t_s))
        t_s = 0.004 * k + 0.001 * np.arange(1, 5)
        q = ARM.home + 0.3 * np.sin(t_s)[:, None] * np.linspace(0.5, 1, 6) + rng.normal(0, 1e-4, (4, 6))
        states = JointStates(t_s, q)
        batches.append(states)
        estimator.joints(states)
        rows = (stamps > t_s[0] - 1e-3) & (stamps <= t_s[-1])
        felt = None if unit is None else unit.give(estimator, stamps[rows], z[rows])
        now = estimator.estimate()
        felt = None if felt is None else (unit.entry.reference.name, felt)
        sink.put(JointsDatum(states, now.T_base_tool, now.cov, now.vision_age_s, felt))
        if k % 4 == 3:
            shot = Shot(f"{k:06d}", None, None, float(t_s[0]))
            if k % 12 == 11:
                sink.put(ShotDatum(shot, Missed("hidden"), float(t_s[-1]), 1e-4))
                continue
            T = (
                inverse(MOUNTING.T_base_rig)
                @ ARM.forward(ARM.home + 0.3 * np.sin(t_s[0] - 0.018) * np.linspace(0.5, 1, 6))  # the camera's delay
                @ MOUNTING.T_tool_body
                @ exp_se3(rng.normal(0, 1e-4, 6))
            )
            result = estimate(T, np.diag([1e-8] * 3 + [1e-7] * 3))
            seen.append((shot.t_s, result))
            if k == 27:
                sink.put(EventDatum(float(t_s[0]), mounting_event(MOUNTING)))
            outcome, T_base_tool = None, None
            if k >= 27:
                measurement = MOUNTING.pose_measurement(result, shot.t_s)
                outcome, T_base_tool = estimator.vision(measurement).value, measurement.T_base_tool
            sink.put(ShotDatum(shot, result, float(t_s[-1]), 1e-4, outcome, MOUNTING.T_base_rig, T_base_tool))
    sink.close()
    assert sink.problem is None
    return folder


def test_the_estimators_of_a_run_are_the_same_to_the_last_digit(armsight, run, tmp_path):
    said = armsight("replay", run, "-o", tmp_path / "again", "--json")
    assert said.code == 0, said
    (answer,) = said.lines
    assert answer["estimates"] == 120
    assert answer["measured"] == 20
    assert answer["differences"] == {"position_m": 0.0, "quaternion": 0.0, "covariance": 0.0}
    assert answer["same"] is True
    said = armsight("replay", run / "run.mcap", "--compare", tmp_path / "again")
    assert "the estimates are those of the run, to the last digit" in said.out
    assert said.out.count("the same to the last digit") == 2


def test_another_arm_or_estimator_changes_the_answers_and_compare_shows_it(armsight, run, tmp_path):
    armsight("replay", run, "-o", tmp_path / "a")
    said = armsight("replay", run, "--estimator", "latest", "--compare", tmp_path / "a", "--json")
    (answer,) = said.lines
    assert answer["same"] is None
    poses, live = answer["compared"]
    assert poses["same"]
    assert not live["same"]
    assert live["position_rms_m"] > 0
    assert live["rows"] == 120
    assert armsight("replay", run, "--arm", "ur5").code == 0


def test_an_inertial_unit_is_fused_and_said_to_agree_or_not(armsight, run, tmp_path):
    from armsight.loop.references.file import COLUMNS, Entry, written
    from armsight.loop.references.inertial import Inertial

    stamps, z, known = known_unit()
    table, file = tmp_path / "imu.csv", tmp_path / "references.toml"
    file.write_text(written(Entry(known, "icm-42688", table, None, None, True), tmp_path))
    for sign, agrees in ((1.0, True), (-1.0, False)):
        rows = np.column_stack([stamps, z * np.repeat([sign, 1.0], 3)])
        np.savetxt(table, rows, delimiter=",", header=",".join(["t_s", *COLUMNS[Inertial]]), comments="")
        said = armsight("replay", run, "--references", file, "--json")
        assert said.code == 0, said
        (answer,) = said.lines
        assert answer["reference"]["agrees"] is agrees
        assert answer["reference"]["windows"] >= 6  # a wrong one is dropped
        assert answer["differences"] is None
        assert 0.2 < answer["reference"]["begin_s"] < 0.3  # the second estimator, which keeps the delay
    slow = np.column_stack([stamps, z])[::50]
    np.savetxt(
        file.with_name("slow.csv"), slow, delimiter=",", header=",".join(["t_s", *COLUMNS[Inertial]]), comments=""
    )
    other = tmp_path / "other.toml"
    other.write_text(file.read_text().replace("imu.csv", "slow.csv"))
    assert_rejected(armsight("replay", run, "--references", other), "imu", "50 ms apart", "at most 30 are integrated")
    slow[:, 0] += 1e3
    np.savetxt(
        file.with_name("slow.csv"), slow, delimiter=",", header=",".join(["t_s", *COLUMNS[Inertial]]), comments=""
    )
    assert_rejected(armsight("replay", run, "--references", other), "imu", "do both have one clock?")
    assert "disagrees with joints and vision" in armsight("replay", run, "--references", file).out
    file.write_text('[imu]\nkind = "inertial"\nsource = "imu.csv"\n')
    assert_rejected(armsight("replay", run, "--references", file), "imu", "has no parameters", "references calibrate")
    said = armsight("replay", run, "--references", file, "--estimator", "latest")
    assert_rejected(said, "--references", "leave out --arm and --estimator")


def test_a_run_with_a_unit_is_the_same_to_the_last_digit_and_holds_ros_messages(armsight, tmp_path):
    """The oracle of the messages is rosbags; the unit changes the estimates, so they are its readings that come back."""
    from armsight.loop.references.file import Entry, read_recording, written
    from armsight.vision.sources.bag import Bag

    stamps, z, known = known_unit()
    text = written(Entry(known, "icm-42688", tmp_path / "run.mcap", None, None, True), tmp_path)
    made(tmp_path, text)
    (answer,) = armsight("replay", tmp_path, "--json").lines
    assert answer["differences"] == {"position_m": 0.0, "quaternion": 0.0, "covariance": 0.0}
    t_s, values = read_recording(tmp_path / "run.mcap")
    given = stamps <= 0.48
    np.testing.assert_array_equal(values, z[given][: len(values)])
    np.testing.assert_allclose(t_s, stamps[given][: len(values)], atol=1e-9)
    (message, *_) = Bag(tmp_path / "run.mcap").messages(["/imu"])
    decoded = message.decode()
    assert decoded.header.frame_id == "imu"
    assert decoded.orientation_covariance[0] == -1.0
    assert message.stamp_ns() == round(1e9 * t_s[0])
    for part, row in ((decoded.angular_velocity, values[0, :3]), (decoded.linear_acceleration, values[0, 3:])):
        assert [part.x, part.y, part.z] == row.tolist()
    (tmp_path / "r.toml").write_text(text)
    (beside,) = armsight("replay", tmp_path, "--references", tmp_path / "r.toml", "--json").lines
    assert beside["reference"]["moved_rms_m"] < 1e-6  # the same readings, given in other batches


def known_field(noise_t=0.3e-6):
    """The readings of a magnetometer on the tool of the run, and its calibration."""
    from armsight.loop.references.heading import Magnetometer
    from armsight.loop.references.reference import ToolMotion

    t_s, rng = 0.02 * np.arange(1, 36), np.random.default_rng(3)
    known = replace(Magnetometer.of("compass").moved(np.r_[0.1, -0.2, 0.3, np.zeros(6), 1e-5, 0, 0, 0, 9e-6, -42e-6]),
                    cov=np.diag(np.full(15, 1e-16)))  # fmt: skip
    Ts = ARM.forward(ARM.home + 0.3 * np.sin(t_s)[:, None] * np.linspace(0.5, 1, 6))
    z = np.array([known.expected(ToolMotion(T), 0).z for T in Ts]) + rng.normal(0.0, noise_t, (len(t_s), 3))
    return t_s, z, known


def test_a_magnetometer_is_recorded_and_compared_and_says_nothing_where_it_cannot(armsight, run, tmp_path):
    from armsight.geometry.rotation import exp_so3
    from armsight.loop.references.file import COLUMNS, Entry, read_recording, written
    from armsight.loop.references.heading import Magnetometer
    from armsight.vision.sources.bag import Bag

    stamps, z, known = known_field()
    table, file = tmp_path / "field.csv", tmp_path / "references.toml"
    text = written(Entry(known, "mpu-6050", table, None, None, True), tmp_path)
    file.write_text(text)
    made(tmp_path, text, (stamps, z))
    assert armsight("replay", tmp_path, "--json").lines[0]["same"] is True
    t_s, values = read_recording(tmp_path / "run.mcap", Magnetometer)
    np.testing.assert_array_equal(values, z[: len(values)])
    (message, *_) = Bag(tmp_path / "run.mcap").messages(["/magnetic_field"])
    at, decoded = message.decode().magnetic_field, message.decode()
    assert [at.x, at.y, at.z] == values[0].tolist()
    assert (decoded.header.frame_id, message.stamp_ns()) == ("compass", round(1e9 * t_s[0]))

    def beside(field):
        rows = np.column_stack([stamps, field])
        np.savetxt(table, rows, delimiter=",", header=",".join(["t_s", *COLUMNS[Magnetometer]]), comments="")
        return armsight("replay", run, "--references", file, "--json", kind="magnetometer")

    answer = beside(z).lines[0]["reference"]
    assert answer["agrees"] is True
    assert abs(answer["heading_off_rad"]) < 3 * answer["sigma_rad"] < np.radians(9)
    rotated = replace(known, field_t=exp_so3(np.array([0.0, 0.0, -0.7])) @ known.field_t)
    file.write_text(written(Entry(rotated, "mpu-6050", table, None, None, True), tmp_path))
    answer = beside(z).lines[0]["reference"]
    assert answer["agrees"] is False
    assert abs(abs(answer["heading_off_rad"]) - 0.7) < 0.1
    file.write_text(text)
    assert beside(known_field(2e-5)[1]).lines[0]["reference"]["agrees"] is None
    answer = beside(z[np.minimum(np.arange(len(z)), 12)]).lines[0]["reference"]
    assert answer["agrees"] is None
    assert "stood still while the tool was rotated" in answer["losses"][0]
    assert "it says nothing" in armsight("replay", run, "--references", file).out
    assert_rejected(beside(z[:1].repeat(len(z), 0)), "[compass]", "two that differ", "stood still")
    for scale in (1e6, 1e7, 1e4):
        assert_rejected(beside(scale * z), "[compass]", "give T, not uT, mG or gauss")


def test_a_range_is_fused_and_recorded_and_said_to_agree_or_not(armsight, run, tmp_path):
    from armsight.loop.references.distance import Distance
    from armsight.loop.references.file import Entry, read_recording, written
    from armsight.loop.references.reference import ToolMotion
    from armsight.vision.sources.bag import Bag

    t_s, rng = 0.02 * np.arange(1, 36), np.random.default_rng(3)
    known = replace(Distance.of("wire").moved(np.r_[0, 0, 0.1, 0.5, 0.4, 1.0, 0.02, 0]), cov=np.diag(np.full(8, 1e-10)))
    Ts = ARM.forward(ARM.home + 0.3 * np.sin(t_s)[:, None] * np.linspace(0.5, 1, 6))
    z = np.array([known.expected(ToolMotion(T), 0).z for T in Ts]) + rng.normal(0.0, 1e-4, (len(t_s), 1))
    table, file = tmp_path / "wire.csv", tmp_path / "references.toml"
    text = written(Entry(known, "mpu-6050", table, None, None, True, noise_m=1e-4), tmp_path)
    file.write_text(text)
    made(tmp_path, text, (t_s, z))
    assert armsight("replay", tmp_path, "--json").done().lines[0]["same"] is True
    (message, *_) = Bag(tmp_path / "run.mcap").messages(["/range"])
    assert message.decode().range == np.float32(z[0, 0])
    values = read_recording(tmp_path / "run.mcap", Distance)[1]
    np.testing.assert_allclose(values, z[: len(values)], atol=1e-6)

    def beside(ranges):
        np.savetxt(table, np.column_stack([t_s, ranges]), delimiter=",", header="t_s,range_m", comments="")
        return armsight("replay", run, "--references", file, "--json", kind="range")

    answer = beside(z).lines[0]["reference"]
    assert answer["agrees"] is True
    assert 0.0 < answer["moved_rms_m"] < 1e-3
    # Joints that change their side count as uncertain until they are learnt anew: one wire does not see all directions.
    assert answer["sigma_rms_m"] < 1.2 * answer["sigma_without_rms_m"]
    assert beside(z + 0.05).lines[0]["reference"]["agrees"] is False
    answer = beside(z[np.minimum(np.arange(len(z)), 12)]).lines[0]["reference"]
    assert "stood still while the tool moved" in answer["losses"][0]
    assert_rejected(beside(1e3 * z), "[wire]", "give m, not mm")


def test_what_a_run_does_not_hold_is_named(armsight, run, tmp_path):
    assert_rejected(armsight("replay", run, "--rig", "r.json"), "needs the images of every shot")
    assert_rejected(armsight("replay", tmp_path), "holds no shots")
    assert_rejected(armsight("export", tmp_path / "no", "--to", "csv", "-o", tmp_path / "o"), "no such file or folder")
    assert_rejected(
        armsight("replay", tmp_path / "none.bag", "--target", "chessboard:9x6:25mm"), "no such file or folder"
    )
    assert_rejected(armsight("replay", run, "--compare", tmp_path), "no poses.csv or live.csv")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("form", ["csv", "parquet", "tum", "mcap", "ros2"])
def test_a_run_is_exported(armsight, run, tmp_path, form):
    out = tmp_path / ("out.mcap" if form == "mcap" else "out")
    (answer,) = armsight("export", run, "--to", form, "-o", out, "--json").lines
    files = [Path(name) for name in answer["files"]]
    if form == "csv":
        assert [file.name for file in files] == ["poses.csv", "live.csv", "joints.csv"]
        header, *rows = files[0].read_text().splitlines()
        assert header.startswith("shot,status,reason,t_s,sigma_t_s,arrival_s,age_s,x_m")
        assert len(rows) == 30
        assert len(files[2].read_text().splitlines()) == 481
    if form == "parquet":
        from pyarrow import parquet

        assert parquet.read_table(files[0]).num_rows == 30
    if form == "tum":
        assert [len(file.read_text().splitlines()) for file in files] == [20, 120]
        assert len(files[1].read_text().splitlines()[0].split()) == 8
    if form == "mcap":
        assert files[0].stat().st_size < (run / "run.mcap").stat().st_size
        assert armsight("replay", out, "--json").lines[0]["same"] is True
    if form == "ros2":
        from rosbags.highlevel import AnyReader

        with AnyReader(files) as reader:
            kinds = {c.topic: c.msgtype for c in reader.connections}
            assert kinds["/odometry"] == "nav_msgs/msg/Odometry"
            assert kinds["/joint_states"] == "sensor_msgs/msg/JointState"
            odometry = next(
                reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages() if c.topic == "/tool/odometry"
            )
            assert odometry.header.frame_id == "base"
    assert_rejected(armsight("export", run, "--to", form, "-o", out), "is there already")


def test_a_recording_of_images_is_measured_again_from_any_container(armsight, rendered, tmp_path):
    """Shots as PNG, and as a bag of raw images with joints: the same poses, to the last digit."""
    arguments = ["--target", rendered.plate, "--rig", rendered.rig]
    source = open_source(str(rendered.folder / "arm"))
    sent, q = [], np.linspace(0, 1, 6)
    for k in range(4):
        shot = source.read()
        t = EPOCH_NS + 250_000_000 * k
        sent += [Sent("/left/image_raw", t, Pixels(shot.left)), Sent("/right/image_raw", t, Pixels(shot.right))]
        sent += [Sent("/joint_states", t - 1_000_000, Joints(list("abcdef"), q + k))]
    sent.append(Sent("/joint_states", t + 1_000_000, Joints(list("abcdef"), q + 4)))
    bag = write_bag(tmp_path / "a", "mcap", sent)
    assert armsight("replay", bag, *arguments, "-o", tmp_path / "bag").code == 0
    rows = (tmp_path / "bag" / "poses.csv").read_text().splitlines()
    assert rows[0].endswith("q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad")
    assert armsight("record", f"bag:{bag}", "-o", tmp_path / "png").code == 0
    assert armsight("replay", tmp_path / "png", *arguments, "-o", tmp_path / "from_png").code == 0
    (poses,) = compare(tmp_path / "bag", tmp_path / "from_png")
    assert poses.rows == 4
    # PNG's index rounds times to a microsecond; everything that was measured is the same.
    assert {name for name, value in poses.largest.items() if value > 0 and name != "took_ms"} <= {"t_s"}
    StereoRig.load(rendered.rig)
    json.dumps(poses.to_json())
