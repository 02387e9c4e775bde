"""What ``armsight board`` prints: JSON objects in SI units, and text in degrees."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from armsight.app.board.flash import Built
from armsight.app.board.selftest import SelftestResult
from armsight.data import Array, JointStates
from armsight.errors import InputError
from armsight.files import as_input_error
from armsight.robot.boards.codes import STATE_TEXTS, ConfigSource
from armsight.robot.boards.configuration import JOINTS, Configuration
from armsight.robot.boards.contract import MotionBoard
from armsight.robot.boards.tuning import GAIN_RANGES

_SOURCES = {
    ConfigSource.NEWEST: "its newest configuration",
    ConfigSource.OLDER: "the one good copy of its configuration, as the other is empty or broken",
    ConfigSource.FACTORY: "factory values, as none is stored: it cannot be enabled",
}


def built_json(built: Built) -> dict[str, Any]:
    """Return a build as JSON has it."""
    pieces = [[address, str(piece)] for address, piece in built.pieces]
    return {**dataclasses.asdict(built), "image": str(built.image), "pieces": pieces}


def built_text(built: Built) -> str:
    """Return a build as lines."""
    sizes = f"flash {built.flash_bytes} bytes, RAM {built.ram_bytes} bytes, {_floats(built.hard_float)}"
    lines = [f"{built.image}: {built.board}, by {built.compiler}, {sizes}"]
    return "\n".join(lines + [f"{piece}: to {address:#010x}" for address, piece in built.pieces])


def _floats(hard: int | None) -> str:
    return f"{'hardware' if hard else 'software'} floating point"


def welcome_text(board: MotionBoard) -> str:
    """Return a board's name, firmware and configuration, or what it cannot do, in a line."""
    welcome = board.welcome
    text = f"board {welcome.board}, firmware {welcome.firmware}"
    if welcome.config_source is None:
        return "; ".join([f"{text}, {welcome.baud} baud", *board.abilities.missing])
    text = f"{text}, {welcome.ticks_per_s} ticks/s, {welcome.baud} baud"
    if has := welcome.abilities:
        kinds = ", ".join(kind.name.lower() for kind in has.sensors)
        text = f"{text}, {has.joints} joints by {kinds} (quadrature inputs: {has.quadrature_inputs})"
    return f"{text}, runs on {_SOURCES[welcome.config_source]}"


def status_json(board: MotionBoard, states: JointStates) -> dict[str, Any]:
    """Return a board's state, faults, newest angles and counters as JSON has them, SI units."""
    status, celsius = board.status, board.joints.temperature_c
    faults = [{"fault": f.fault.name, "joint": None if f.joint is None else f.joint + 1} for f in status.faults]
    found = {"t_s": round(status.t_s, 3), "state": status.state.name, "faults": faults}
    found |= {"not_homed": status.joints_not_homed, "duty": [round(float(duty), 4) for duty in board.joints.duty]}
    found |= {"q_rad": [round(float(q), 5) for q in states.q[-1]] if len(states.q) else None}
    found |= {"supply_v": None if math.isnan(status.supply_v) else round(status.supply_v, 3)}
    found |= {"temperature_c": None if celsius is None else [float(each) for each in celsius]}
    found |= {name: getattr(status, name) for name in ("crc_errors", "lost_bytes", "overrun_bytes")}
    return {**found, "readings": len(states.t_s), "broken_messages": board.broken_messages}


def status_text(board: MotionBoard, states: JointStates) -> str:
    """Return a board's state, newest angles and faults in a line."""
    status, celsius = board.status, board.joints.temperature_c
    faults = ", ".join(f.fault.name + ("" if f.joint is None else f" joint {f.joint + 1}") for f in status.faults)
    angles = " ".join(f"{np.degrees(q):7.2f}" for q in states.q[-1]) + " deg" if len(states.q) else "no readings"
    parts = [f"{status.t_s:8.2f} s", f"{STATE_TEXTS[status.state].split(':')[0]:14} {angles}"]
    parts += [] if math.isnan(status.supply_v) else [f"{status.supply_v:5.2f} V"]
    parts += [] if celsius is None else [f"{celsius.max():.0f} deg C"]
    return "  ".join([*parts, faults] if faults else parts)


def gains_json(values: Array) -> dict[str, Any]:
    """Return gains (6, 8) as JSON has them: a list of six joints for each gain."""
    return {name: [float(np.float32(each)) for each in values[:, k]] for k, name in enumerate(GAIN_RANGES)}


def gains_text(values: Array) -> str:
    """Return gains (6, 8) as a table."""
    lines = ["joint" + "".join(f"{name:>21}" for name in GAIN_RANGES)]
    lines += [f"{joint + 1:5}" + "".join(f"{value:21.6g}" for value in row) for joint, row in enumerate(values)]
    return "\n".join(lines)


def changed_gains(values: Array, changes: Sequence[str]) -> Array:
    """Return gains (6, 8) with changes of the form ``JOINT:NAME=VALUE``; JOINT is 1 to 6 or ``all``."""
    changed, names = values.copy(), list(GAIN_RANGES)
    rows = {**{str(j + 1): slice(j, j + 1) for j in range(JOINTS)}, "all": slice(None)}
    for change in changes:
        joint, _, rest = change.partition(":")
        name, _, text = rest.partition("=")
        if joint not in rows or name not in names:
            raise InputError(f"{change!r}: JOINT:NAME=VALUE is needed, JOINT 1 to 6 or all, NAME {', '.join(names)}")
        with as_input_error(f"{change!r}: {text!r} is no number", ValueError):
            changed[rows[joint], names.index(name)] = float(text)
    return changed


def with_gains(config: Configuration, values: Array) -> Configuration:
    """Return a configuration with other gains (6, 8)."""
    changed = config.copy()
    for k, name in enumerate(GAIN_RANGES):
        changed["joint"]["gains"][name] = values[:, k]
    return changed


def selftest_text(result: SelftestResult) -> str:
    """Return the result of a self-test as lines."""
    each = [(n, "failed" if s.problems else "passed", (s.trace_sha256 or "")[:16]) for n, s in result.scenarios.items()]
    lines = [f"{name:14} {how}  {trace}".rstrip() for name, how, trace in each]
    lines.append(f"{result.ticks_per_s:.0f} ticks/s, {result.ticks_per_s / 1000:.1f} times real time")
    if (sizes := result.elf)["flash_bytes"] is not None:
        lines.append(f"flash {sizes['flash_bytes']}, RAM {sizes['ram_bytes']} bytes, {_floats(sizes['hard_float'])}")
    return "\n".join(lines)
