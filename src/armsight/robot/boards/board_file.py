"""``board.toml``: a board's whole configuration as a file that people edit, with units in the names and ranges beside them.

In: a :data:`~armsight.robot.boards.configuration.Configuration`. Out: TOML text, and back, to the last bit::

    version = 6                  # layout of the configuration
    board = "nucleo-f446re"      # the board it belongs to

    [arm]
    supply_min_mv = 10000

    [joint.1]
    soft_max_rad = 2.4           # -13 to 13

    [joint.1.gains]
    [joint.1.pot]
    [joint.1.motor]
    [joint.1.encoder]
    sensor = "potentiometer"     # or quadrature, or absolute: then with counts_per_rev, direction, zero
    [joint.1.transmission]       # not in files of version 5, which are read as well

Every value must be there, once; a name that is not known is named with the one it was perhaps meant to be.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from armsight.errors import InputError
from armsight.files import read_toml
from armsight.robot.boards.codes import SensorKind
from armsight.robot.boards.configuration import (
    CONFIG,
    CONFIG_VERSION,
    ENCODER_FIELDS,
    JOINTS,
    POT_NODES,
    RANGES,
    Configuration,
    check_configuration,
    check_pin,
    pin_name,
    pin_number,
)

_PARTS = ("gains", "pot", "motor", "encoder", "transmission")  # parts of a joint that are tables of their own
_PIN = "sync_led_pin"  # a name in the file: "PB13", or "none"
#: Version of a file -> what it did not have yet, of every joint: all of it is 0 there.
_NEW_SINCE: Mapping[int, tuple[str, ...]] = {
    5: ("transmission.twist_rad_per_a", "transmission.uneven", "transmission.damping_share"),
    CONFIG_VERSION: (),
}
_TABLES = ("counts", "angle_rad")  # of a potentiometer: as long as its node_count, which they replace

#: What of a potentiometer's configuration an encoder has no use for.
_POT_ONLY = (*_TABLES, "short_counts", "open_counts", "direction")
_SENSORS = {each.name.lower(): each for each in SensorKind}


def entries(config: Configuration) -> Iterator[tuple[str, Any]]:
    """Yield every value of a configuration with its path, such as ``joint.3.pot.jump_rad``; tables as lists."""
    for name in CONFIG.names or ():
        if name != "joint":
            value = config[name].item()
            yield f"arm.{name}", pin_name(value) if name == _PIN else value
    for j, joint in enumerate(config["joint"][: int(config["joint_count"])], start=1):
        for part, names in _named(joint).items():
            for name in names:
                value, path = (
                    (joint[part] if part else joint)[name],
                    ".".join(filter(None, ("joint", str(j), part, name))),
                )
                if name in _TABLES:
                    yield path, [_number(each) for each in value[: int(joint["pot"]["node_count"])]]
                else:
                    yield path, SensorKind(int(value)).name.lower() if name == "sensor" else _number(value)


def _named(joint: Configuration) -> dict[str, list[str]]:
    """Return the names of a joint's own numbers, and of those of each part, that count for its sensor."""
    sensor = SensorKind(int(joint["encoder"]["sensor"]))
    unused = {"node_count", *(() if sensor == SensorKind.POTENTIOMETER else _POT_ONLY)}
    parts = {"": [each for each in joint.dtype.names or () if each not in _PARTS]}
    parts |= {part: list(joint.dtype[part].names or ()) for part in _PARTS}
    parts["encoder"] = [each for each in parts["encoder"] if each in ("sensor", *ENCODER_FIELDS[sensor])]
    parts["pot"] = [each for each in parts["pot"] if each not in unused]
    return parts


def _number(value: Any) -> float | int:  # noqa: ANN401 - a numpy scalar
    """Return a number whose text is the shortest that is read back as the same bits."""
    return float(str(value)) if value.dtype.kind == "f" else int(value)


def configuration_text(config: Configuration, board: str) -> str:
    """Write a configuration of the board of this name as the text of a ``board.toml``."""
    lines, table = [f"version = {CONFIG_VERSION}  # layout of the configuration", f'board = "{board}"', ""], ""
    for path, value in entries(config):
        here, _, name = path.rpartition(".")
        if here != table:
            lines += [""] * bool(table) + [f"[{here}]"]
            table = here
        said = ", ".join(_SENSORS) if name == "sensor" else ""
        if name in RANGES:
            said = "{:g} to {:g}".format(*RANGES[name])
        shown = f'"{value}"' if isinstance(value, str) else value
        lines.append(f"{name} = {shown}" + (f"  # {said}" if said else ""))
    return "\n".join(lines) + "\n"


def read_configuration(path: Path) -> tuple[Configuration, str]:
    """Read a ``board.toml``, configuration and name of the board; InputError names what is missing or out of range."""
    data = read_toml(path)
    if data.get("version") not in list(_NEW_SINCE) or not isinstance(data.get("board"), str):
        raise InputError(
            f"{path}: version is {data.get('version')!r} and board {data.get('board')!r}; version {CONFIG_VERSION} (or"
            f" {min(_NEW_SINCE)}) and a board's name are needed: `armsight board config get` writes such a file"
        )
    given = dict(_flat({name: value for name, value in data.items() if name not in ("version", "board")}))
    config = np.zeros((), CONFIG)
    count = given.get("arm.joint_count")
    if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= JOINTS:
        raise InputError(f"{path}: arm.joint_count is {count!r}; 1 to {JOINTS} is needed: the joints the arm has")
    config["joint_count"], config["joint"]["pot"]["node_count"][:count] = count, 2
    absent = {f"joint.{j + 1}.{name}" for j in range(count) for name in _NEW_SINCE[data["version"]]}
    try:
        _fill(config, given, absent)
        check_configuration(config)
        check_pin(config, data["board"])
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return config, data["board"]


def _fill(config: Configuration, given: Mapping[str, object], absent: Collection[str]) -> None:
    """Put all values of a file into a configuration, but those that a file of its version does not have."""
    for j in range(int(config["joint_count"])):  # first of all: what else there is to say depends on it
        if (sensor := f"joint.{j + 1}.encoder.sensor") in given:
            put(config, sensor, given[sensor])
    known = [name for name, _ in entries(config) if name not in absent]
    if unknown := next((name for name in given if name not in known), None):
        raise InputError(_unknown(unknown, config))
    if missing := next((name for name in known if name not in given), None):
        raise InputError(f"{missing} is missing")
    for name in known:
        put(config, name, given[name])


def _flat(data: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in data.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{path}{name}.")
        else:
            yield f"{path}{name}", value


def _unknown(path: str, config: Configuration) -> str:
    """Return that a configuration has no such path, and which it may be."""
    first, *more = path.split(".")
    count = int(config["joint_count"])
    if first == "joint" and more and more[0] in map(str, range(count + 1, JOINTS + 1)):
        return f"there is {path}, but arm.joint_count is {count}: leave that joint out, or count it"
    near = difflib.get_close_matches(path, dict(entries(config)), 1)
    return f"nothing is called {path}" + (f"; is it {near[0]}?" if near else "")


def put(config: Configuration, path: str, value: object) -> None:
    """Put a value, a number or a potentiometer's table, into a configuration, in-place; InputError without such a path."""
    record, name = _record_of(config, path)
    if name == _PIN:
        record[name] = pin_number(value)
        return
    if name == "sensor":
        if not isinstance(value, str) or value not in _SENSORS:
            raise InputError(f"{path} is {value!r}; there are {', '.join(_SENSORS)}")
        record[name] = _SENSORS[value]
        return
    whole = record.dtype[name].base.kind != "f"
    if name in _TABLES:
        if not isinstance(value, list) or not 2 <= len(value) <= POT_NODES:
            raise InputError(f"{path} is {value}; a list of 2 to {POT_NODES} numbers is needed")
        numbers = [_checked(path, each, whole) for each in value]
        record[name] = numbers + [0] * (POT_NODES - len(numbers))
        record["node_count"] = len(numbers)
    else:
        number = _checked(path, value, whole)
        if whole:
            limits = np.iinfo(record.dtype[name])
            low, high = RANGES.get(name, (limits.min, limits.max))
            if not limits.min <= number <= limits.max:
                raise InputError(f"{path} is {number}; {low:.0f} to {high:.0f} is allowed")
        record[name] = number


def _record_of(config: Configuration, path: str) -> tuple[Configuration, str]:
    """Return the part of a configuration that a path leads to, and the name of its value there."""
    record, names = config, path.split(".")
    if names[0] == "arm":
        names = names[1:]
    elif names[0] == "joint" and len(names) > 2 and names[1] in map(str, range(1, JOINTS + 1)):
        record, names = config["joint"][int(names[1]) - 1], names[2:]
    else:
        raise InputError(
            f"nothing is called {path}; such names are arm.silence_ticks and joint.3.pot.jump_rad, joints 1 to {JOINTS}"
        )
    for name in names[:-1]:
        if name not in _PARTS or name not in (record.dtype.names or ()):
            raise InputError(_unknown(path, config))
        record = record[name]
    if names[-1] not in (record.dtype.names or ()) or names[-1] in ("node_count", "joint", *_PARTS):
        raise InputError(_unknown(path, config))
    return record, names[-1]


def _checked(path: str, value: object, whole: bool) -> float | int:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or (whole and not isinstance(value, int)):
        raise InputError(f"{path} is {value!r}; {'a whole number' if whole else 'a number'} is needed")
    return value
