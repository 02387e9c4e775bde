"""``armsight references``: what recordings of an inertial unit are like, and its calibration from a sweep."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from armsight.app.references import report
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, log_se3
from armsight.geometry.rotation import quaternion_wxyz
from armsight.loop.estimators.kalman import KalmanEstimator
from armsight.loop.references.calibrate import PosePath
from armsight.loop.references.distance import Distance
from armsight.loop.references.file import COLUMNS, Entry, read_references, written
from armsight.loop.references.heading import Magnetometer
from armsight.loop.references.inertial import Inertial
from armsight.loop.references.reference import ToolMotion
from armsight.loop.running.beside import Ranged
from armsight.robot.arm_file import open_arm
from armsight.sim.references.distance import DrawWire
from armsight.sim.references.heading import MagneticUnit
from cli_runs import hold_keys, run, said_of

HEAD = ["t_s", *COLUMNS[Inertial]]
RATES = np.array([1.1, 1.7, 2.3, 0.9, 1.3, 1.9])


def pose(t_s):
    return exp_se3(np.array([0.2, 0.2, 0.2, 1.0, 1.0, 1.0]) * np.sin(RATES * t_s + np.arange(6)))


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """A folder with the poses of a sweep of 7 s, a recording of a sensor on it, and then 3 s at rest."""
    folder, rng = tmp_path_factory.mktemp("references"), np.random.default_rng(2)
    at = np.arange(0.0, 8.0, 1 / 40)
    Ts = np.array([pose(t) for t in at])
    path = PosePath(at, Ts)
    first = Inertial.of("imu")
    true = replace(first.moved(rng.normal(size=38) * np.sqrt(np.diag(first.cov)) * 0.2), delay_s=0.015)
    rows = []
    for t in np.arange(0.1, 7.0, 0.02):
        m = path(t - true.delay_s)
        rows.append([t, *true.expected(m, 0).z, *true.expected(m, 1).z])
    rest = true.expected(path(7.0)._replace(twist=np.zeros(6), acceleration=np.zeros(6)), 1).z
    rows += [[t, *true.expected(path(7.0)._replace(twist=np.zeros(6)), 0).z, *rest] for t in np.arange(9.0, 12.0, 0.02)]
    values = np.array(rows)
    values[:, 1:4] += rng.normal(0.0, 1e-3, (len(rows), 3))
    values[:, 4:] += rng.normal(0.0, 0.02, (len(rows), 3))
    write(folder / "imu.csv", values)
    quaternions = quaternion_wxyz(Ts[:, :3, :3])
    np.savetxt(
        folder / "poses.csv", np.column_stack([at, Ts[:, :3, 3], quaternions]), "%.9f", ",",
        header="t_s,x_m,y_m,z_m,qw,qx,qy,qz", comments="",
    )  # fmt: skip
    (folder / "references.toml").write_text('[imu]\nkind = "inertial"\nsource = "imu.csv"\nrate_hz = 50.0\n')
    return folder, true, values


def write(path, values):
    np.savetxt(path, values, "%.9f", ",", header=",".join(HEAD), comments="")


def test_check_says_rate_gap_and_noise_beside_that_of_the_class(sweep, capsys):
    folder, _, values = sweep
    said = said_of(capsys, "references", "check", folder / "references.toml", "--json", kind="inertial")
    (found,) = said.lines[0]["references"]
    assert found["rate_hz"] == pytest.approx(50.0)
    assert (found["readings"], found["gaps"], found["saturated"]) == (len(values), 1, [])
    assert found["rest_s"] == pytest.approx(3.0, abs=0.5)
    # 0.02 m/s2 at 50 Hz is 0.0028 m/s2/sqrt(Hz); 0.0039 is usual.
    assert found["accelerometer"]["noise_over_class"] == pytest.approx(0.72, rel=0.25)
    assert np.mean(found["accelerometer"]["random_walk_m_s_per_sqrt_s"]) == pytest.approx(0.0028, rel=0.25)
    assert found["settling"] is None
    (weak,) = said.lines[0]["weak"]
    assert re.fullmatch(
        r"imu: no reading for [\d.]+ s after [\d.]+ s \(gaps: 1\): readings were lost, or its clock jumped", weak
    )
    write(folder / "even.csv", np.column_stack([0.02 * np.arange(len(values)), values[:, 1:]]))
    (folder / "even.toml").write_text('[imu]\nkind = "inertial"\nsource = "even.csv"\nrate_hz = 50.0\n')
    run("references", "check", folder / "even.toml")
    assert capsys.readouterr().out.startswith("Good: what was recorded is as its class is")


def test_json_lines_are_read_as_csv_is_and_oddities_are_said(sweep, capsys, tmp_path):
    _, _, values = sweep
    odd = np.repeat(values[::2], 2, axis=0)
    odd[:, HEAD.index("gyro_z_rad_s")] = 0.0
    lines = (json.dumps(dict(zip(HEAD, map(float, row), strict=True))) for row in odd)
    (tmp_path / "imu.jsonl").write_text("\n".join(lines))
    (tmp_path / "r.toml").write_text('[a]\nkind = "inertial"\nsource = "imu.jsonl"\nrate_hz = 100.0\n')
    said = said_of(capsys, "references", "check", tmp_path / "r.toml").done()
    assert "weak: a: the rate is 25 Hz, not 100 as the file says" in said.out
    assert "a: 50 % of readings repeat the one before: it is read too often" in said.out
    assert "a: gyro_z never changes: it is not read, or broken" in said.out


def test_calibrate_finds_the_sensor_and_writes_what_check_reads(sweep, capsys, tmp_path):
    folder, true, _ = sweep
    out = tmp_path / "calibrated.toml"
    given = "references", "calibrate", folder / "references.toml", "--poses", folder / "poses.csv", "-o", out, "--json"
    said = said_of(capsys, *given, kind="inertial").done()
    (found,) = said.lines[0]["references"]
    assert found["delay_s"] == pytest.approx(0.015, abs=5e-4)
    at, sigma = (np.array(list(found[key].values())) for key in ("parameters", "sigma"))
    miss = at[3:] - np.array(list(true.parameters.values()))[3:]
    assert np.sqrt(np.mean((miss / sigma[3:]) ** 2)) < 2.0
    assert found["left_out_over_sigma"] == pytest.approx(1.0, abs=0.2)
    assert run("references", "check", out) == 0
    (entry,) = read_references(out)
    apart = log_se3(inverse(entry.reference.T_tool_sensor) @ true.T_tool_sensor)
    assert np.degrees(np.linalg.norm(apart[3:])) < 0.2


def test_a_sweep_that_rotates_the_tool_little_is_said(sweep, capsys, monkeypatch):
    folder, _, _ = sweep
    monkeypatch.setattr(report, "SMALL_DEG", 200.0)
    given = "references", "calibrate", folder / "references.toml", "--poses", folder / "poses.csv", "--json"
    (weak,) = said_of(capsys, *given, kind="inertial").lines[0]["weak"]
    assert re.search(
        r"the tool rotates by \d+ deg: the lever of imu may be off by more than sigma; rotate it by 200", weak
    )


@pytest.mark.parametrize(
    ("toml", "change", "said"),
    [
        ("[imu]\nkind = 'compass'", None, r"\[imu\]: kind is 'compass'; known are inertial, magnetometer, range"),
        ("[imu]\nkind = 'inertial'\nrate = 3", None, r"\[imu\]: unknown key 'rate'; known are kind, source"),
        ("[imu]\nkind = 'inertial'\nclass = 'best'", None, "no class of inertial units 'best'; there are icm-42688"),
        ("[m]\nkind = 'magnetometer'\nclass = 'phone'", None, r"\[m\]: class is of an inertial unit"),
        ("[imu]\nkind = 'inertial'\nsource = 'imu.csv'\nrate_hz = 5e4", None, "as if t_s were in ms; give s"),
        ("[imu]\nkind = 'inertial'\nrate_hz = 0", None, "rate_hz is 0; expected more"),
        ("[imu]\nkind = 'inertial'\nsource = 3", None, "source is 3; expected a text"),
        ("[imu]\nkind = 'inertial'", None, r"r\.toml: \[imu\]: no source; name its recording"),
        ("kind = 'inertial'", None, "expected a table a reference"),
        (None, lambda v: v / [1, 1, 1, 1, 9.80665, 9.80665, 9.80665], "reads .* at rest, as if in g; give m/s2"),
        (None, lambda v: v[::-1], "the clock runs backwards by .* at reading 2"),
    ],
)
def test_bad_input_is_one_line(sweep, capsys, tmp_path, toml, change, said):
    _, _, values = sweep
    write(tmp_path / "imu.csv", values if change is None else change(values))
    (tmp_path / "r.toml").write_text(toml or '[imu]\nkind = "inertial"\nsource = "imu.csv"\n')
    got = said_of(capsys, "references", "check", tmp_path / "r.toml")
    assert got.code == 2
    assert len(got.err.splitlines()) == 1

    assert re.search(said, got.err), got.err


def test_gravity_shows_a_tilted_base_and_says_what_is_open(capsys, tmp_path):
    """The nominal arm rests 30 times on a base tilted by 0.5 degrees; the sensor, of unknown mounting, is late."""
    late, rng, arm = 0.3, np.random.default_rng(5), open_arm("six_r")
    q = arm.home + rng.uniform(-1.2, 1.2, (30, 6))
    true = Inertial.of("imu").moved(np.concatenate([[0.1, 0.2, -0.3], np.zeros(33), np.radians([0.5, -0.3])]))
    rows = []
    for k, T in enumerate(arm.forward(q)):
        for t in 2.0 * k + np.arange(-0.3, 0.3, 0.02):
            rows.append(
                [t + late, *rng.normal(0.0, 1e-3, 3), *(true.expected(ToolMotion(T), 1).z + rng.normal(0.0, 0.02, 3))]
            )
    write(tmp_path / "imu.csv", np.array(rows))
    head = "t_s," + ",".join(f"q{k}_deg" for k in range(1, 7))
    rests = np.column_stack([2.0 * np.arange(30), np.degrees(q)])
    np.savetxt(tmp_path / "joints.csv", rests, "%.6f", ",", header=head, comments="")
    (tmp_path / "r.toml").write_text(f'[imu]\nkind = "inertial"\nsource = "imu.csv"\ndelay_s = {late}\n')
    given = "references", "gravity", tmp_path / "r.toml", "--model", "six_r", "--joints", tmp_path / "joints.csv"
    said = said_of(capsys, *given, "--json").done()
    hold_keys(given, said.out)
    np.savetxt(tmp_path / "few.csv", rests[:7], "%.6f", ",", header=head, comments="")
    (tmp_path / "imu.csv").unlink()  # which is not read before
    few = said_of(capsys, *given[:-1], tmp_path / "few.csv")
    assert few.code == 2
    assert "few.csv: 7 rests were given; gravity shows zeros from 8 on" in few.err
    found = {each["name"]: each for each in said.lines[0]["found"]}
    for axis, tilt in (("x", 0.5), ("y", -0.3)):
        tilted = found[f"base tilt about {axis}"]
        assert abs(tilted["value_rad"] - np.radians(tilt)) < 3 * tilted["sigma_rad"] < np.radians(0.6)
    assert {name for name, each in found.items() if each["open"]} >= {"zero 1", "zero 2", "zero 3", "zero 4"}


def test_a_calibration_that_was_written_is_read_whatever_its_name_and_delay(sweep, tmp_path):
    (entry,) = read_references(sweep[0] / "references.toml")
    late = replace(entry, reference=replace(entry.reference, name="my imu", delay_s=-0.03), calibrated=True)
    out = tmp_path / "written.toml"
    out.write_text(written(late, tmp_path))
    (again,) = read_references(out)
    assert again.reference.name == "my imu"
    assert again.reference.delay_s == -0.03
    out.write_text(out.read_text().replace("covariance = [\n  [", 'covariance = [\n  ["x", ', 1))
    with pytest.raises(InputError, match="must be numbers"):
        read_references(out)


def test_a_magnetometer_is_checked_and_calibrated_and_other_units_are_named(capsys, tmp_path, monkeypatch):
    """Beside a motor, as the workcell has one; the poses are those of a sweep."""
    t, rng = np.arange(0.0, 30.0, 0.02), np.random.default_rng(8)
    Ts = np.array([pose(at) for at in t])
    t_s, z = MagneticUnit(rng, 50.0).read(t, Ts)
    rows = np.column_stack([t, Ts[:, :3, 3], quaternion_wxyz(Ts[:, :3, :3])])
    np.savetxt(tmp_path / "poses.csv", rows, "%.9f", ",", header="t_s,x_m,y_m,z_m,qw,qx,qy,qz", comments="")
    head = ",".join(["t_s", *COLUMNS[Magnetometer]])
    for name, scale in (("field", 1.0), ("micro", 1e6)):
        np.savetxt(tmp_path / f"{name}.csv", np.column_stack([t_s, scale * z]), "%.9g", ",", header=head, comments="")
        (tmp_path / f"{name}.toml").write_text(f'[m]\nkind = "magnetometer"\nsource = "{name}.csv"\nrate_hz = 50.0\n')
    (found,) = said_of(capsys, "references", "check", tmp_path / "field.toml", "--json", kind="magnetometer").lines[0][
        "references"
    ]
    assert (found["readings"], found["rate_hz"]) == (1500, pytest.approx(50.0))
    given = "--poses", tmp_path / "poses.csv", "-o", tmp_path / "out.toml", "--json"
    said = said_of(capsys, "references", "calibrate", tmp_path / "field.toml", *given, kind="magnetometer").done()
    (found,) = said.lines[0]["references"]
    assert found["left_out_rms"]["field_t"] < 5e-6
    assert found["left_out_over_sigma"] == pytest.approx(1.0, abs=0.3)
    assert found["noise_factor"]["field"] > 0.9
    assert run("references", "check", tmp_path / "out.toml") == 0
    monkeypatch.setattr(report, "SMALL_DEG", 200.0)
    said = said_of(capsys, "references", "calibrate", tmp_path / "out.toml", *given[:2])
    assert "the iron of m may be off by more than sigma" in said.out + said.err  # it has no lever
    said = said_of(capsys, "references", "calibrate", tmp_path / "micro.toml", *given[:2])
    assert (said.code, len(said.err.splitlines())) == (2, 2)  # and what is fitted
    assert "as if in uT" in said.err
    said = said_of(capsys, "references", "gravity", tmp_path / "out.toml", "--model", "six_r", "--joints", "none.csv")
    assert said.code == 2
    assert "out.toml: [m]: is no inertial unit" in said.err
    rest = np.column_stack([t_s, np.mean(z, axis=0) + rng.normal(0.0, 4e-7, z.shape) + 1e-7 * t_s[:, None]])
    np.savetxt(tmp_path / "field.csv", rest, "%.9g", ",", header=head, comments="")
    said = said_of(capsys, "references", "check", tmp_path / "field.toml", "--json", kind="magnetometer").lines[0]
    (found,) = said["references"]
    assert found["noise_t"] == pytest.approx([4e-7] * 3, rel=0.1)  # not what it drifts by in 30 s
    assert found["drift_t"] == pytest.approx([2.25e-6] * 3, rel=0.1)
    assert "it drifts by 2.3 uT at rest" in said["weak"][0]


def test_a_range_is_checked_and_calibrated_and_what_is_wrong_with_it_is_named(capsys, tmp_path, monkeypatch):
    """A draw-wire 80 mm beside the tool's origin, which hangs and hooks, on an eccentric drum."""
    t, rng = np.arange(0.0, 30.0, 0.02), np.random.default_rng(131)
    Ts = np.array([pose(at) for at in t])
    carried = Ts.copy()
    carried[:, :3, 3] += Ts[:, :3, :3] @ [0.0, 0.05, 0.06]
    wires = [DrawWire(rng, 50.0) for _ in range(2)]
    (t_s, z), (_, other) = (wire.read(t, carried) for wire in wires)
    still = z.copy()
    still[500:900] = z[500]
    hooked = z + np.where((t_s > 12.0) & (t_s < 14.0), 0.005, 0.0)[:, None]
    tables = {"wire": z, "other": other, "mm": 1e3 * z, "still": still, "hooked": hooked, "falls": 2.0 - z}
    tables["coarse"] = np.round(np.append(z[:1000], np.full((500, 1), 1.0)) + rng.normal(0.0, 0.05, 1500), 2)[:, None]
    for name, values in tables.items():
        rows = np.column_stack([t_s, values])
        np.savetxt(tmp_path / f"{name}.csv", rows, "%.9g", ",", header="t_s,range_m", comments="")
        (tmp_path / f"{name}.toml").write_text(f'[{name}]\nkind = "range"\nsource = "{name}.csv"\nrate_hz = 50.0\n')
    for name, flat in (("poses", 1.0), ("plane", 0.0)):
        rows = np.column_stack([t, Ts[:, :3, 3] * [1.0, 1.0, flat], quaternion_wxyz(Ts[:, :3, :3])])
        head = "t_s,x_m,y_m,z_m,qw,qx,qy,qz"
        np.savetxt(tmp_path / f"{name}.csv", rows, "%.9f", ",", header=head, comments="")

    def calibrate(name, poses="poses", **others):
        given = "--poses", tmp_path / f"{poses}.csv", *(part for each in others.items() for part in each)
        return said_of(capsys, "references", "calibrate", tmp_path / f"{name}.toml", *given, "--json", kind="range")

    assert said_of(capsys, "references", "check", tmp_path / "wire.toml", "--json", kind="range").code == 0
    (tmp_path / "joints.csv").write_text("t_s,q1_deg,q2_deg\n0,1,2\n1,2,3\n")
    assert "holds joint angles alone, no poses of the tool" in calibrate("wire", "joints").err
    for name in ("wire", "other"):
        said = calibrate(name, **{"-o": tmp_path / f"{name}_found.toml"}).done()
        (found,) = said.lines[0]["references"]
        assert found["left_out_rms"]["range_m"] < 2e-4
        assert found["left_out_over_sigma"] == pytest.approx(1.0, abs=0.3)
        (entry,) = read_references(tmp_path / f"{name}_found.toml")
        assert 8e-5 < entry.noise_m < 3e-4
        off = entry.reference.anchors[0] - wires[name == "other"]._anchor
        assert np.linalg.norm(off) < 2e-3
    assert run("references", "check", tmp_path / "wire_found.toml") == 0
    both = "".join((tmp_path / f"{name}_found.toml").read_text() for name in ("wire", "other"))
    swapped = both.replace("wire.csv", "that.csv").replace("other.csv", "wire.csv").replace("that.csv", "other.csv")
    (tmp_path / "swapped.toml").write_text(swapped)
    monkeypatch.setattr(report, "SMALL_DEG", 200.0)
    (tmp_path / "both.toml").write_text(both)
    (weak, *_) = calibrate("both").done().lines[0]["weak"]
    assert "the tool's point of wire and the tool's point of other may be off" in weak
    monkeypatch.undo()
    assert "12.1 to 13.9 s" in calibrate("hooked").done().lines[0]["weak"][0]
    for given, text in (
        (("swapped",), "[wire]: its readings fit the anchor of"),
        (("mm",), "while the tool moves by 0.92 m: give m, not mm"),
        (("still",), "stands still from 10.10 to 17.90 s"),
        (("falls",), "fall as the tool moves away"),
        (("wire", "plane"), "wire: the tool moves in a plane"),
    ):
        said = calibrate(*given)
        assert said.code == 2
        assert text in said.err
    with (tmp_path / "coarse.toml").open("a") as file:
        file.write("noise_m = 0.05\n")
    said = said_of(capsys, "references", "check", tmp_path / "coarse.toml", "--json", kind="range").lines[0]
    assert said["weak"] == []  # at rest a step of 10 mm repeats, and a noise of 50 mm is no drift
    assert said["references"][0]["drift_m"][0] > report.RESTS["range"][2]
    said = said_of(capsys, "references", "check", tmp_path / "mm.toml")
    assert (said.code, "as if in mm; give m" in said.err) == (2, True)


@pytest.mark.parametrize(("rate_hz", "step_m", "ramp_m_s"), [(2.0, 0.02, 0.0), (10.0, 1e-4, 0.02)])
def test_a_range_that_moves_all_the_time_is_not_at_rest(capsys, tmp_path, rate_hz, step_m, ramp_m_s):
    """Jumps from pose to pose, and a slow sweep: blocks of either are as quiet as the quietest."""
    t_s = np.arange(500) / rate_hz
    z = 1.0 + np.random.default_rng(6).normal(0.0, step_m, 500) + ramp_m_s * np.abs((t_s % 20.0) - 10.0)
    np.savetxt(tmp_path / "wire.csv", np.column_stack([t_s, z]), "%.9g", ",", header="t_s,range_m", comments="")
    (tmp_path / "wire.toml").write_text('[wire]\nkind = "range"\nsource = "wire.csv"\n')
    said = said_of(capsys, "references", "check", tmp_path / "wire.toml", "--json", kind="range").lines[0]
    assert said["weak"][0].startswith("wire: never at rest")
    assert said["references"][0]["rest_s"] == 0.0


def recorded_range(folder, rate_hz, anchor, sense, seconds=30.0):
    """Write poses and a range, as a sensor senses distances (N,), that ``wire.toml`` names; return times and distances."""
    at, t_s = np.arange(0.0, seconds, 0.02), np.arange(0.0, seconds - 0.02, 1 / rate_hz)
    Ts = np.array([pose(t) for t in at])
    rows = np.column_stack([at, Ts[:, :3, 3], quaternion_wxyz(Ts[:, :3, :3])])
    np.savetxt(
        folder / "poses.csv", rows, "%.9f", ",", header="t_s,x_m,y_m,z_m,qw,qx,qy,qz", comments=""
    )  # fmt: skip
    far = np.array([np.linalg.norm(T[:3, 3] + T[:3, :3] @ [0.0, 0.05, 0.06] - anchor) for T in map(pose, t_s)])
    np.savetxt(folder / "wire.csv", np.column_stack([t_s, sense(far)]), "%.9g", ",", header="t_s,range_m", comments="")
    (folder / "wire.toml").write_text('[wire]\nkind = "range"\nsource = "wire.csv"\n')
    return t_s, far


def calibrated_range(capsys, folder):
    given = folder / "wire.toml", "--poses", folder / "poses.csv", "-o", folder / "out.toml", "--json"
    return said_of(capsys, "references", "calibrate", *given, kind="range")


class Taking(KalmanEstimator):
    """An estimator that knows the poses, and keeps what it is given."""

    settings, span_s = (None, None, False), (0.0, 30.0)

    def __init__(self):
        self.taken = []

    def track(self, t_s):
        return SimpleNamespace(Ts_base_tool=np.array([pose(t) for t in t_s]))

    def take(self, reference, reading):
        self.taken.append(reading)


def test_the_noise_that_a_run_gives_a_range_is_that_of_what_it_fuses(capsys, tmp_path):
    """White noise of 1 mm a reading at 500 Hz: calibrate's means of 20 ms have 0.32 mm."""
    anchor, rng = np.array([0.8, 0.3, 0.9]), np.random.default_rng(17)
    t_s, far = recorded_range(tmp_path, 500.0, anchor, lambda far: far + rng.normal(0.0, 1e-3, len(far)))
    calibrated_range(capsys, tmp_path).done()
    (entry,) = read_references(tmp_path / "out.toml")
    run_of, estimator = Ranged(entry), Taking()
    z = far + rng.normal(0.0, 1e-3, len(far))
    keep = (t_s < 10.0) | (t_s > 10.5)  # after a gap there is one reading alone
    run_of.give(estimator, t_s[keep], z[keep, None])
    delay_s, taken = entry.reference.delay_s, estimator.taken
    off = [r.z[0] - entry.reference.expected(ToolMotion(pose(r.t_s - delay_s)), 0).z[0] for r in taken]
    assert len(taken) > 140
    assert np.sqrt(np.mean(np.square(off) / [r.cov[0, 0] for r in taken])) == pytest.approx(1.0, abs=0.25)
    assert np.sqrt(np.median([r.cov[0, 0] for r in taken])) == pytest.approx(1e-3 / np.sqrt(10), rel=0.25)
    assert max(r.cov[0, 0] for r in taken) > 9.9 * entry.noise_m**2


def test_a_range_that_sees_nothing_is_a_loss_of_its_own_and_hides_no_frozen_value():
    """As ROS' Range says it, by inf; the sensor repeats one value, and every tenth reading saw nothing."""
    sensor = Distance.of("sonar").moved(np.r_[0, 0.05, 0.06, 0.8, 0.3, 0.9, 0, 0])
    run_of, estimator, t_s = (
        Ranged(Entry(sensor, "mpu-6050", None, None, None, True)),
        Taking(),
        np.arange(0.0, 5.0, 0.02),
    )
    z = np.full((len(t_s), 1), sensor.expected(ToolMotion(pose(0.0)), 0).z[0])
    z[::10], z[5::50] = np.inf, np.nan
    run_of.give(estimator, t_s, z)
    assert not any("not mm" in loss for loss in run_of.losses)
    assert "nothing was seen: its range is inf or NaN (30 times)" in run_of.losses
    assert any("stood still while the tool moved" in loss for loss in run_of.losses)
    assert len(estimator.taken) < 3
