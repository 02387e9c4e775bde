"""``references.toml``: a table a reference, and the recordings that it names.

[imu]
kind = "inertial"
source = "imu.csv"          # CSV or JSON lines: t_s, gyro_x_rad_s .., accelerometer_x_m_s2 ..; a bag of ROS, a run
live = "udp:5005"           # where `armsight run` reads it, JSON lines of the same keys; or serial:PORT
class = "mpu-6050"          # what is not known is left out
rate_hz = 100.0
delay_s = 0.004
sigma_delay_s = 0.001
parameters = { rotation_x_rad = 0.01, .. }   # as `armsight references calibrate` writes them
covariance = [[..], ..]
"""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.files import read_text, read_toml
from armsight.geometry.check import checked
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3
from armsight.loop.references.inertial import Inertial
from armsight.tables.columns import Columns
from armsight.vision.sources.bag.reader import S_NS, SUFFIXES, Bag, BagMessage

#: Keys of a reference's table.
_KEYS = ("kind", "source", "live", "class", "rate_hz", "delay_s", "sigma_delay_s", "parameters", "covariance")
#: The columns of an inertial unit's recording.
INERTIAL_COLUMNS = tuple(
    f"{sensor}_{axis}_{unit}" for sensor, unit in (("gyro", "rad_s"), ("accelerometer", "m_s2")) for axis in "xyz"
)
FIELD_COLUMNS = ("field_x_t", "field_y_t", "field_z_t")  # of a magnetometer's, T
_MOST_MB = 200  # of a recording
#: ROS's messages: columns of a table with the same, bytes of the numbers at the end, where among them a reading stands.
IMU, FIELD = "sensor_msgs/Imu", "sensor_msgs/MagneticField"
_MESSAGES = {IMU: (INERTIAL_COLUMNS, 37 * 8, np.r_[13:16, 25:28]), FIELD: (FIELD_COLUMNS, 12 * 8, np.r_[0:3])}


@dataclass(frozen=True, eq=False)
class Entry(Record):
    """A reference of the file.

    Attributes:
        sensor_class: what it is like.
        live: where it is read in a run; None where that is not said.
        rate_hz: readings a second, as the file says; None where it does not.
        calibrated: whether the file has its parameters.
    """

    reference: Inertial
    kind: str
    sensor_class: str
    source: Path | None
    live: str | None
    rate_hz: float | None
    calibrated: bool


def read_references(path: Path) -> list[Entry]:
    """Read ``references.toml``.

    Raises:
        InputError: the table, what was found and what is expected.
    """
    tables = read_toml(path)
    if not tables or not all(isinstance(table, dict) for table in tables.values()):
        raise InputError(f"{path}: expected a table a reference, such as [imu] with kind and source")
    return [_entry(path, name, table) for name, table in tables.items()]


def entries_of(text: str, where: Path) -> list[Entry]:
    """Return the references of the text of such a file, which a run keeps; ``where``: the run's file, for messages."""
    return [_entry(where, name, table) for name, table in tomllib.loads(text).items()]


def _entry(path: Path, name: str, table: dict[str, Any]) -> Entry:
    where = f"{path}: [{name}]"
    if unknown := [key for key in table if key not in _KEYS]:
        raise InputError(f"{where}: unknown key {unknown[0]!r}; known are {', '.join(_KEYS)}")
    if table.get("kind") != "inertial":
        raise InputError(f"{where}: kind is {table.get('kind')!r}; known is inertial")
    for key in ("rate_hz", "delay_s", "sigma_delay_s"):
        value = table.get(key, 1.0)
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise InputError(f"{where}: {key} is {value!r}; expected a number")
        # The poses' clock may be the later one: then a delay is below zero.
        if value < {"rate_hz": 1e-3, "delay_s": -np.inf, "sigma_delay_s": 0.0}[key]:
            raise InputError(f"{where}: {key} is {value:g}; expected more")
    for key in ("source", "live", "class"):
        if not isinstance(table.get(key, ""), str):
            raise InputError(f"{where}: {key} is {table[key]!r}; expected a text")
    kind = table.get("class", "mpu-6050")
    sensor = Inertial.of(name, kind)
    late = table.get("delay_s", 0.0), table.get("sigma_delay_s", sensor.sigma_delay_s)
    sensor = replace(sensor, delay_s=float(late[0]), sigma_delay_s=float(late[1]))
    if "parameters" in table:
        sensor = _known(where, sensor, table["parameters"], table.get("covariance"))
    source = path.parent / table["source"] if "source" in table else None
    return Entry(sensor, "inertial", kind, source, table.get("live"), table.get("rate_hz"), "parameters" in table)


def _known(where: str, sensor: Inertial, given: object, covariance: object) -> Inertial:
    """Return a sensor with parameters of the file."""
    names = list(sensor.parameters)
    if not isinstance(given, dict) or list(given) != names:
        raise InputError(f"{where}: parameters are not those of an inertial unit; calibrate it again")
    try:
        values, cov = np.array(list(given.values()), float), np.array(covariance, float)
    except (TypeError, ValueError):
        raise InputError(f"{where}: parameters and covariance must be numbers; calibrate it again") from None
    checked(values, (len(names),), f"{where}: parameters")
    checked(cov, (len(names), len(names)), f"{where}: covariance")
    T = pose(exp_so3(values[:3]), values[3:6])
    return replace(sensor, T_tool_sensor=T, values=values[3:], cov=cov)


def written(entry: Entry, folder: Path) -> str:
    """Return the table of a reference as text, for a file in a folder."""
    sensor, lines = entry.reference, [f"[{json.dumps(entry.reference.name)}]", f'kind = "{entry.kind}"']
    if entry.source is not None:
        lines.append(f"source = {json.dumps(os.path.relpath(entry.source, folder))}")
    if entry.live is not None:
        lines.append(f"live = {json.dumps(entry.live)}")
    lines.append(f'class = "{entry.sensor_class}"')
    if entry.rate_hz is not None:
        lines.append(f"rate_hz = {entry.rate_hz:g}")
    lines += [f"delay_s = {sensor.delay_s:.9g}", f"sigma_delay_s = {sensor.sigma_delay_s:.9g}"]
    lines.append("parameters = { " + ", ".join(f"{k} = {float(v):.12g}" for k, v in sensor.parameters.items()) + " }")
    rows = ",\n".join("  [" + ", ".join(f"{float(v):.9g}" for v in row) + "]" for row in sensor.cov)
    return "\n".join([*lines, f"covariance = [\n{rows}\n]"]) + "\n"


def read_recording(path: Path, kind: str = IMU) -> tuple[Array, Array]:
    """Return times (N,), s, and values of a recording: of an IMU (N, 6), rad/s and m/s2, of a FIELD (N, 3), T.

    Raises:
        InputError: the file, the line and what was expected.
    """
    if path.is_dir() or path.suffix.lower() in SUFFIXES:
        return _of_bag(Bag(path), kind)
    names = _MESSAGES[kind][0]
    columns = Columns.of_csv(path) if path.suffix.lower() not in (".jsonl", ".ndjson") else _json_lines(path, names)
    return columns.numbers(["t_s"])[:, 0], columns.numbers(names)


def _of_bag(bag: Bag, kind: str) -> tuple[Array, Array]:
    """Return the readings of a recording of ROS, or of a run.mcap: of its one topic of a kind."""
    topics = [topic.name for topic in bag.of_kind(kind)]
    if len(topics) != 1:
        listed = ", ".join(topics) or bag.holds()
        raise InputError(f"{bag.path}: expected one topic of {kind}; there are {len(topics)}: {listed}")
    found = [reading_of(message, kind) for message in bag.messages(topics)]
    return np.array([t for t, _ in found]), np.array([z for _, z in found])


def reading_of(message: BagMessage, kind: str = IMU) -> tuple[float, Array]:
    """Return the time, s, and the reading of a message: (6,), rad/s and m/s2, or of a field (3,), T.

    Raises:
        InputError: it is too short.
    """
    _, size, rows = _MESSAGES[kind]
    stamp = message.stamp_ns() or message.arrival_ns
    if len(message.data) < size:
        raise InputError(f"{message.topic}: message {message.index + 1} is cut short: {len(message.data)} bytes")
    order = ">" if message.encoding == "cdr" and not message.data[1] & 1 else "<"
    values = np.frombuffer(message.data[-size:], f"{order}f8").astype(float)
    return stamp / S_NS, values[rows]


def _json_lines(path: Path, names: Sequence[str]) -> Columns:
    """Return the columns of a file of one JSON object a line."""
    rows = list[tuple[int, list[str]]]()
    head = ["t_s", *names]
    for line, text in enumerate(read_text(path, _MOST_MB).splitlines(), 1):
        if not text.strip():
            continue
        try:
            record = json.loads(text)
        except ValueError as error:
            raise InputError(f"{path}: line {line}: not JSON: {error}") from None
        missing = head if not isinstance(record, dict) else [name for name in head if name not in record]
        if missing:
            raise InputError(f"{path}: line {line}: expected an object with {', '.join(head)}; {missing[0]} is missing")
        rows.append((line, [str(record[name]) for name in head]))
    if not rows:
        raise InputError(f"{path}: is empty")
    return Columns(path, head, rows)
