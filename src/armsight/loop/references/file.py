"""``references.toml``: a table a reference, and the recordings that it names.

[imu]
kind = "inertial"           # or "magnetometer", "range": a wire, bar, laser or radio to one anchor
source = "imu.csv"          # CSV or JSON lines: t_s and its columns, in SI or as gyro_x_deg_s; a bag of ROS, a run
live = "udp:5005"           # where `armsight run` reads it, JSON lines of the same keys; or serial:PORT
class = "mpu-6050"          # of an inertial unit; what is not known is left out
rate_hz = 100.0             # of any kind: `armsight references check` compares it
delay_s = 0.004
sigma_delay_s = 0.001
noise_m = 0.0005            # of a range
parameters = { rotation_x_rad = 0.01, .. }   # as `armsight references calibrate` writes them
covariance = [[..], ..]
"""

from __future__ import annotations

import json
import logging
import os
import re
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import InputError, nearest
from armsight.files import parse_toml, read_text, read_toml
from armsight.geometry.check import checked
from armsight.loop.references.distance import Distance
from armsight.loop.references.heading import Magnetometer
from armsight.loop.references.inertial import Inertial
from armsight.loop.references.reference import STANDARD_GRAVITY_M_S2
from armsight.loop.references.stream import check_seconds
from armsight.tables.columns import Columns
from armsight.tables.lengths import UNITS_M
from armsight.vision.sources.bag.reader import S_NS, SUFFIXES, Bag, BagMessage

_LOG = logging.getLogger(__name__)
#: Keys of a reference's table.
_NUMBERS_LEAST = {"rate_hz": 1e-3, "delay_s": -np.inf, "sigma_delay_s": 0.0, "noise_m": 1e-7}
_KEYS = ("kind", "source", "live", "class", *_NUMBERS_LEAST, "parameters", "covariance")
_MOST_MB = 200  # of a recording
Sensor = Inertial | Magnetometer | Distance  #: what a file can name
#: Their kinds in it, and the columns of their recordings.
KINDS: dict[type[Sensor], str] = {Inertial: "inertial", Magnetometer: "magnetometer", Distance: "range"}
COLUMNS: dict[type[Sensor], tuple[str, ...]] = {
    Inertial: tuple(f"gyro_{a}_rad_s" for a in "xyz") + tuple(f"accelerometer_{a}_m_s2" for a in "xyz"),
    Magnetometer: tuple(f"field_{a}_t" for a in "xyz"),
    Distance: ("range_m",),
}
#: Units that may stand at the end of a column's name, in those of ``COLUMNS``.
_UNITS = {
    "rad_s": {"rad_s": 1.0, "deg_s": np.pi / 180, "dps": np.pi / 180},
    "m_s2": {"m_s2": 1.0, "g": STANDARD_GRAVITY_M_S2, "mg": 1e-3 * STANDARD_GRAVITY_M_S2},
    "t": {"t": 1.0, "mt": 1e-3, "ut": 1e-6, "nt": 1e-9, "gauss": 1e-4, "mgauss": 1e-7},
    "m": {"m": 1.0, "in": UNITS_M["inches"]} | UNITS_M,
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
}
#: Slower readings, Hz, that last long have no times in s; half: 5 kHz in ms pass, double: a unit at 10 Hz is rejected.
_SLOWEST_HZ: dict[type[Sensor], float] = {Inertial: 10.0, Magnetometer: 1.0, Distance: 1.0}
#: Messages of ROS that have them; bytes of the numbers at the end of these, and where among them a reading stands.
RANGE = "sensor_msgs/Range"
MESSAGES: dict[type[Sensor], str] = dict(
    zip(KINDS, ("sensor_msgs/Imu", "sensor_msgs/MagneticField", RANGE), strict=True)
)
_NUMBERS = {MESSAGES[Inertial]: (37 * 8, np.r_[13:16, 25:28]), MESSAGES[Magnetometer]: (12 * 8, np.r_[0:3])}


@dataclass(frozen=True, eq=False)
class Entry(Record):
    """A reference of the file."""

    reference: Sensor
    sensor_class: str  #: what an inertial unit is like
    source: Path | None
    live: str | None  #: where it is read in a run; None where that is not said
    rate_hz: float | None  #: readings a second, as the file says; None where it does not
    calibrated: bool  #: whether the file has its parameters
    where: str = ""  #: the file and the name of its table, for messages
    noise_m: float = 1e-3  #: of a range


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
    return [_entry(where, name, table) for name, table in parse_toml(text).items()]


def _entry(path: Path, name: str, table: dict[str, Any]) -> Entry:
    where = f"{path}: [{name}]"
    if unknown := [key for key in table if key not in _KEYS]:
        raise InputError(f"{where}: unknown key {unknown[0]!r}; known are {', '.join(_KEYS)}")
    if (kind := table.get("kind")) not in KINDS.values():
        raise InputError(f"{where}: kind is {kind!r}; known are {', '.join(KINDS.values())}")
    for key, least in _NUMBERS_LEAST.items():
        value = table.get(key, 1.0)
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise InputError(f"{where}: {key} is {value!r}; expected a number")
        # The poses' clock may be the later one: then a delay is below zero.
        if value < least:
            raise InputError(f"{where}: {key} is {value:g}; expected more")
    for key in ("source", "live", "class"):
        if not isinstance(table.get(key, ""), str):
            raise InputError(f"{where}: {key} is {table[key]!r}; expected a text")
    if kind != KINDS[Inertial] and "class" in table:
        raise InputError(f"{where}: class is of an inertial unit; a {kind} has none: leave it out")
    like = table.get("class", "mpu-6050")
    of: dict[str, Callable[[str], Sensor]] = {KINDS[each]: each.of for each in (Magnetometer, Distance)}
    sensor = of[kind](name) if kind in of else Inertial.of(name, like)
    late = table.get("delay_s", 0.0), table.get("sigma_delay_s", sensor.sigma_delay_s)
    sensor = replace(sensor, delay_s=float(late[0]), sigma_delay_s=float(late[1]))
    if "parameters" in table:
        sensor = _known(where, sensor, table["parameters"], table.get("covariance"))
    source = path.parent / table["source"] if "source" in table else None
    given = table.get("live"), table.get("rate_hz"), "parameters" in table, where, table.get("noise_m", Entry.noise_m)
    return Entry(sensor, like, source, *given)


def _known(where: str, sensor: Sensor, given: object, covariance: object) -> Sensor:
    """Return a sensor, of which nothing is known, with parameters of the file."""
    names = list(sensor.parameters)
    if not isinstance(given, dict) or list(given) != names:
        raise InputError(f"{where}: parameters are not those of its kind; calibrate it again")
    try:
        values, cov = np.array(list(given.values()), float), np.array(covariance, float)
    except (TypeError, ValueError):
        raise InputError(f"{where}: parameters and covariance must be numbers; calibrate it again") from None
    checked(values, (len(names),), f"{where}: parameters")
    checked(cov, (len(names), len(names)), f"{where}: covariance")
    return replace(sensor.moved(values - np.array(list(sensor.parameters.values()))), cov=cov)


def written(entry: Entry, folder: Path) -> str:
    """Return the table of a reference as text, for a file in a folder."""
    sensor = entry.reference
    lines = [f"[{json.dumps(sensor.name)}]", f'kind = "{KINDS[type(sensor)]}"']
    if entry.source is not None:
        lines.append(f"source = {json.dumps(os.path.relpath(entry.source, folder))}")
    if entry.live is not None:
        lines.append(f"live = {json.dumps(entry.live)}")
    if isinstance(sensor, Inertial):
        lines.append(f'class = "{entry.sensor_class}"')
    if isinstance(sensor, Distance):
        lines.append(f"noise_m = {entry.noise_m:.6g}")
    if entry.rate_hz is not None:
        lines.append(f"rate_hz = {entry.rate_hz:g}")
    lines += [f"delay_s = {sensor.delay_s:.9g}", f"sigma_delay_s = {sensor.sigma_delay_s:.9g}"]
    lines.append("parameters = { " + ", ".join(f"{k} = {float(v):.12g}" for k, v in sensor.parameters.items()) + " }")
    rows = ",\n".join("  [" + ", ".join(f"{float(v):.9g}" for v in row) + "]" for row in sensor.cov)
    return "\n".join([*lines, f"covariance = [\n{rows}\n]"]) + "\n"


def read_recording(path: Path, kind: type[Sensor] = Inertial) -> tuple[Array, Array]:
    """Return times (N,), s, and values of a recording, by a reference's columns: of a unit (N, 6), rad/s and m/s2.

    Lines and messages without a finite number in each are left out, and logged.

    Raises:
        InputError: the file, the line and what was expected; most lines are left out.
    """
    if path.is_dir() or path.suffix.lower() in SUFFIXES:
        if kind is not Distance:
            rows = _of_bag(Bag(path), MESSAGES[kind])
            return rows[:, 0], rows[:, 1:]
        topics, t_s, _, z = read_ranges(path)
        if len(topics) > 1:
            raise InputError(f"{path}: expected one topic of {RANGE}; there are {len(topics)}: {', '.join(topics)}")
        return t_s, z[:, None]
    columns = (_json_lines if path.suffix.lower() in (".jsonl", ".ndjson") else Columns.of_csv)(path)
    names, factors = zip(*columns_of(kind, columns.head, str(path)), strict=True)
    rows = _kept(path, columns.numbers(names, text=True) * factors, "line", columns.line)
    check_seconds(rows[:, 0], _SLOWEST_HZ[kind], f"{path}: {names[0]}")
    return rows[:, 0], rows[:, 1:]


def read_lengths(path: Path) -> tuple[Array | None, Array]:
    """Return times (N,), s, None where the table has none, and ranges (N,), m, of a recording of one range."""
    if not path.is_dir() and path.suffix.lower() == ".csv":
        columns = Columns.of_csv(path)
        if not any(_plain(each).startswith(("t_", "time")) for each in columns.head):
            name, factor = _column(columns.head, COLUMNS[Distance][0], str(path))
            return None, factor * columns.numbers([name])[:, 0]
    t_s, z = read_recording(path, Distance)
    return t_s, z[:, 0]


def _kept(path: str | Path, rows: Array, what: str, number: Callable[[int], int]) -> Array:
    """Return the rows (N, k) that are finite; ``number``: of a row, as the file counts its lines or messages."""
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    first = ", ".join(str(number(int(row))) for row in bad[:5]) + " .." * (len(bad) > 5)
    said = f"{path}: {len(bad)} of {len(rows)} {what}s have an empty cell or no finite number ({what} {first})"
    if 2 * len(bad) > len(rows):
        raise InputError(f"{said}: too many to leave out; correct them")
    if len(bad):
        _LOG.warning("%s and are left out", said)
    return np.delete(rows, bad, axis=0)


def columns_of(kind: type[Sensor], head: Sequence[str], where: str) -> list[tuple[str, float]]:
    """Return names in ``head`` of a reference's time and columns, and factors to SI; InputError: one is missing."""
    return [_column(head, name, where) for name in ("t_s", *COLUMNS[kind])]


def _column(head: Sequence[str], name: str, where: str) -> tuple[str, float]:
    there = {_plain(each): each for each in head if each}
    unit = next(each for each in _UNITS if name.endswith(f"_{each}"))
    stem = name.removesuffix(unit)
    known = {stem + each: factor for each, factor in _UNITS[unit].items()}
    if found := next((each for each in known if each in there), None):
        return there[found], known[found]
    like = "time|stamp|^t" if unit == "s" else f"{stem[-2]}(_|$)" if "_" in stem[:-1] else ""
    near = get_close_matches(name, [each for each in there if re.search(like, each)], 1, 0.1)
    meant = f"did you mean {there[near[0]]}? rename it with its unit" if near else "add it"
    missing = f"column {name} is missing, also in another unit ({', '.join(known)})"
    raise InputError(f"{where}: {missing}; there are {nearest(name, [each for each in head if each])}: {meant}")


def _plain(name: str) -> str:
    """Return a column's name in small letters, what separates its words as _: gyro_x_deg_s of Gyro X (deg/s)."""
    name = unicodedata.normalize("NFKC", name.replace("\N{DEGREE SIGN}", "deg").replace("^", "")).lower()
    return re.sub(r"[\W_]+", "_", name.replace("\N{GREEK SMALL LETTER MU}", "u")).strip("_")


def _of_bag(bag: Bag, kind: str) -> Array:
    """Return times and readings (N, 1 + k) of a recording of ROS, or of a run.mcap: of its one topic of a kind."""
    topics = [topic.name for topic in bag.of_kind(kind)]
    if len(topics) != 1:
        listed = ", ".join(topics) or bag.holds()
        raise InputError(f"{bag.path}: expected one topic of {kind}; there are {len(topics)}: {listed}")
    rows = np.array([(t, *z) for t, z in map(reading_of, bag.messages(topics))]).reshape(-1, 1 + len(_NUMBERS[kind][1]))
    return _kept(bag.path, rows, "message", lambda row: row + 1)


def read_ranges(path: Path) -> tuple[tuple[str, ...], Array, NDArray[np.int64], Array]:
    """Return what ``sensor_msgs/Range`` of a bag of ROS measured: topics, a sensor each, in order of their names.

    Then times (N,), s, rising; the topic's number (N,); ranges (N,), m. Those outside of what their message says that the
    sensor measures, infinite ones among them (REP 117), are left out. InputError: the bag has none.
    """
    bag = Bag(path)
    topics = tuple(topic.name for topic in bag.of_kind(RANGE))
    if not topics:
        raise InputError(f"{path}: expected topics of {RANGE}; it holds {bag.holds()}")
    rows = list[tuple[float, int, float]]()
    for message in bag.messages(topics):
        range_ = message.decode()
        if range_.min_range <= range_.range <= range_.max_range and np.isfinite(range_.range):
            rows.append((_time_s(message), topics.index(message.topic), float(range_.range)))
    t_s, channel, z = np.array(sorted(rows)).reshape(-1, 3).T
    return topics, t_s, channel.astype(np.int64), z


def _time_s(message: BagMessage) -> float:
    return (message.stamp_ns() or message.arrival_ns) / S_NS


def reading_of(message: BagMessage) -> tuple[float, Array]:
    """Return a message's time, s, and reading: (6,), rad/s, m/s2, a field (3,), T, a range (1,), m; InputError: short."""
    if message.kind == RANGE:
        return _time_s(message), np.array([message.decode().range], float)
    size, rows = _NUMBERS[message.kind]
    if len(message.data) < size:
        raise InputError(f"{message.topic}: message {message.index + 1} is cut short: {len(message.data)} bytes")
    order = ">" if message.encoding == "cdr" and not message.data[1] & 1 else "<"
    values = np.frombuffer(message.data[-size:], f"{order}f8").astype(float)
    return _time_s(message), values[rows]


def _json_lines(path: Path) -> Columns:
    """Return the columns of a file of one JSON object a line; of other lines empty cells."""
    records, wrong = dict[int, dict[str, Any]](), ""
    for line, text in enumerate(read_text(path, _MOST_MB).splitlines(), 1):
        if not text.strip():
            continue
        try:
            record = json.loads(text)
        except (ValueError, RecursionError) as error:
            record, wrong = None, wrong or f"line {line}: not JSON: {error}"
        records[line] = record if isinstance(record, dict) else {}
    head = list(dict.fromkeys(name for record in records.values() for name in record))
    if not head:
        raise InputError(f"{path}: {wrong or ('expected an object a line' if records else 'is empty')}")
    return Columns(path, head, [(line, [str(each.get(name, "")) for name in head]) for line, each in records.items()])
