"""Recordings of references: lines that are no readings, columns in other units, times that are no seconds."""

import json
import logging

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.loop.references.distance import Distance
from armsight.loop.references.file import COLUMNS, read_recording
from armsight.loop.references.heading import Magnetometer
from armsight.loop.references.inertial import Inertial


def write(path, head, rows):
    path.write_text("\n".join([",".join(head), *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


@pytest.fixture
def wire(tmp_path):
    """A path of a recording that is written with these bad lines, and the rows that are good."""

    def written(bad, suffix="csv", count=200):
        rows = [[f"{0.02 * k:.2f}", f"{1.0 + 0.001 * k:.3f}"] for k in range(count)]
        path = tmp_path / f"wire.{suffix}"
        good = np.array([row for k, row in enumerate(rows) if k not in bad], float)
        if suffix == "csv":
            return write(
                path, ["t_s", "range_m"], [[rows[k][0], *bad[k]] if k in bad else rows[k] for k in range(count)]
            ), good
        lines = [bad.get(k) or json.dumps({"t_s": float(t), "range_m": float(z)}) for k, (t, z) in enumerate(rows)]
        path.write_text("\n".join(lines))
        return path, good

    return written


@pytest.mark.parametrize(
    ("suffix", "bad", "lines"),
    [
        ("csv", {3: [""], 17: ["ERR"], 40: [], 41: ["nan"], 199: ["inf"]}, "line 5, 19, 42, 43, 201"),
        ("csv", {k: ["#"] for k in range(6)}, "line 2, 3, 4, 5, 6 .."),
        (
            "jsonl",
            {3: '{"t_s": 0.06}', 4: '{"t_s": 1, "range_m": null}', 5: "[1]", 199: '{"t_s": 3.9'},
            "line 4, 5, 6, 200",
        ),
    ],
)
def test_lines_that_are_no_readings_are_left_out_and_said_in_one_note(wire, caplog, suffix, bad, lines):
    path, good = wire(bad, suffix)
    with caplog.at_level(logging.WARNING):
        t_s, z = read_recording(path, Distance)
    np.testing.assert_allclose(np.column_stack([t_s, z]), good)
    (said,) = caplog.messages
    assert f"{len(bad)} of 200 lines have an empty cell or no finite number ({lines}) and are left out" in said


def test_a_recording_most_of_whose_lines_are_no_readings_is_rejected(wire):
    path, _ = wire({k: ["ERR"] for k in range(101)})
    with pytest.raises(
        InputError, match=r"101 of 200 lines .*line 2, 3, 4, 5, 6 \.\.\): too many to leave out; correct them"
    ):
        read_recording(path, Distance)


@pytest.mark.parametrize(
    ("kind", "head", "factors"),
    [
        (Distance, "t_s range_mm", [1, 1e-3]),
        (Distance, "t_s range_in", [1, 0.0254]),
        (Distance, "t_ms,Range [cm]", [1e-3, 1e-2]),
        (Magnetometer, "t_us field_x_ut field_y_ut field_z_gauss", [1e-6, 1e-6, 1e-6, 1e-4]),
        (
            Inertial,
            "t_s,Gyro X (deg/s),gyro_y_dps,gyro_z_rad_s,accelerometer_x_g,accelerometer_y_mg,Accelerometer Z (m/s\u00b2)",
            [1, np.pi / 180, np.pi / 180, 1, 9.80665, 9.80665e-3, 1],
        ),
    ],
)
def test_columns_are_read_by_their_unit_whatever_their_order(tmp_path, kind, head, factors):
    head = head.split("," if "," in head else " ")
    values = np.random.default_rng(0).uniform(1.0, 2.0, (30, len(head)))
    values[:, 0] = np.arange(30)
    t_s, z = read_recording(write(tmp_path / "r.csv", head[::-1], values[:, ::-1]), kind)
    np.testing.assert_allclose(np.column_stack([t_s, z]), values * factors)


@pytest.mark.parametrize(
    ("kind", "head", "said"),
    [
        (
            Inertial,
            "timestamp,gx,gy,gz,ax,ay,az",
            r"t_s is missing, also .*\(t_s, t_ms, t_us, t_ns\).*did you mean timestamp\?",
        ),
        (
            Inertial,
            "t_s,ax,ay,az,gx,gy,gz",
            "gyro_x_rad_s is missing, .*gyro_x_deg_s.*did you mean gx? rename it with its unit",
        ),
        (Distance, "t_s,distance", "range_m is missing, .*range_mm.*did you mean distance"),
        (Magnetometer, "t_s,p,q", "field_x_t is missing, .*field_x_ut.*there are t_s, p, q: add it"),
    ],
)
def test_a_missing_column_names_its_units_and_the_nearest(tmp_path, kind, head, said):
    with pytest.raises(InputError, match=said.replace("gx? ", r"gx\? ")):
        read_recording(write(tmp_path / "r.csv", head.split(","), np.ones((3, head.count(",") + 1))), kind)


@pytest.mark.parametrize(
    ("kind", "rate_hz", "unit"),
    [
        (Inertial, 8000.0, "ms"), (Inertial, 1000.0, "us"), (Inertial, 50.0, "ns"), (Magnetometer, 15.0, "ms"),
        (Magnetometer, 8.0, "us"), (Distance, 50.0, "ms"), (Distance, 900.0, "ms"), (Distance, 5.0, "us"),
    ],
)  # fmt: skip
def test_times_in_another_unit_are_rejected_with_it(tmp_path, kind, rate_hz, unit):
    scale = {"ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    t = scale * np.arange(0.0, 4.0, 1 / rate_hz)
    rows = np.column_stack([t, np.ones((len(t), len(COLUMNS[kind])))])
    path = write(tmp_path / "r.csv", ["t_s", *COLUMNS[kind]], rows)
    with pytest.raises(InputError, match=rf"r.csv: t_s looks like {unit}: .* must be seconds: name it t_{unit}"):
        read_recording(path, kind)
    path.write_text(path.read_text().replace("t_s", f"t_{unit}", 1))
    np.testing.assert_allclose(read_recording(path, kind)[0], t / scale)


def test_slow_ranges_of_a_sweep_at_rests_and_long_recordings_are_no_milliseconds(tmp_path):
    for t in (np.arange(0.0, 1200.0, 5.0), np.arange(0.0, 7200.0, 0.5)):
        path = write(tmp_path / "r.csv", ["t_s", "range_m"], np.column_stack([t, np.ones_like(t)]))
        assert len(read_recording(path, Distance)[0]) == len(t)
