"""What ``armsight board`` prints: JSON objects in SI units, and text in degrees.

In: records of a board and of a build. Out: for each a function NAME_json and a function NAME_text; gains with changes.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from armsight import firmware
from armsight.app.board.flash import Built
from armsight.app.board.selftest import SelftestResult
from armsight.data import Array, JointStates
from armsight.errors import InputError
from armsight.files import read_text
from armsight.firmware.elf import read_elf
from armsight.robot.boards.codes import STATE_TEXTS, ConfigSource
from armsight.robot.boards.configuration import JOINTS, Configuration
from armsight.robot.boards.contract import MotionBoard
from armsight.robot.boards.tuning import GAIN_RANGES

_SOURCES = {
    ConfigSource.NEWEST: "its newest configuration",
    ConfigSource.OLDER: "the one good copy of its configuration, as the other is empty or broken",
    ConfigSource.FACTORY: "factory values, as none is stored: it cannot be enabled",
}


def package_build() -> Built:
    """Return armsight's own build, as emulated boards run it."""
    elf = read_elf(firmware.image())
    about = json.loads(read_text(firmware.BUILT / "build.json"))
    return Built("pil", about["compiler"], firmware.image(), (), elf.flash_bytes, elf.ram_bytes, elf.hard_float)


def built_json(built: Built) -> dict[str, Any]:
    """Return a build as JSON has it."""
    pieces = [[address, str(piece)] for address, piece in built.pieces]
    return {**dataclasses.asdict(built), "image": str(built.image), "pieces": pieces}


def built_text(built: Built) -> str:
    """Return a build as lines."""
    float_text = "hardware" if built.hard_float else "software"
    lines = [
        f"{built.image}: {built.board}, by {built.compiler}, flash {built.flash_bytes} bytes,"
        f" RAM {built.ram_bytes} bytes, {float_text} floating point"
    ]
    return "\n".join(lines + [f"{piece}: to {address:#010x}" for address, piece in built.pieces])


def welcome_text(board: MotionBoard) -> str:
    """Return a board's name, firmware and configuration, or what it cannot do, in a line."""
    welcome = board.welcome
    text = f"board {welcome.board}, firmware {welcome.firmware}"
    if welcome.config_source is None:
        return "; ".join([f"{text}, {welcome.baud} baud", *board.abilities.missing])
    source = _SOURCES[welcome.config_source]
    text = f"{text}, {welcome.ticks_per_s} ticks/s, {welcome.baud} baud"
    if has := welcome.abilities:
        kinds = [f"{kind.name.lower()}" for kind in has.sensors]
        text = f"{text}, {has.joints} joints by {', '.join(kinds)} (quadrature inputs: {has.quadrature_inputs})"
    return f"{text}, runs on {source}"


def status_json(board: MotionBoard, states: JointStates) -> dict[str, Any]:
    """Return a board's state, faults, newest angles and counters as JSON has them, SI units."""
    status, celsius = board.status, board.joints.temperature_c
    return {
        "t_s": round(status.t_s, 3),
        "state": status.state.name,
        "faults": [{"fault": f.fault.name, "joint": None if f.joint is None else f.joint + 1} for f in status.faults],
        "q_rad": [round(float(q), 5) for q in states.q[-1]] if len(states.q) else None,
        "duty": [round(float(duty), 4) for duty in board.joints.duty],
        "supply_v": None if math.isnan(status.supply_v) else round(status.supply_v, 3),
        "temperature_c": None if celsius is None else [float(each) for each in celsius],
        "readings": len(states.t_s),
        "crc_errors": status.crc_errors,
        "lost_bytes": status.lost_bytes,
        "overrun_bytes": status.overrun_bytes,
        "broken_messages": board.broken_messages,
    }


def status_text(board: MotionBoard, states: JointStates) -> str:
    """Return a board's state, newest angles and faults in a line."""
    status = board.status
    faults = ", ".join(f.fault.name + ("" if f.joint is None else f" joint {f.joint + 1}") for f in status.faults)
    angles = " ".join(f"{np.degrees(q):7.2f}" for q in states.q[-1]) + " deg" if len(states.q) else "no readings"
    state = STATE_TEXTS[status.state].split(":")[0]
    line = f"{status.t_s:8.2f} s  {state:14} {angles}"
    if not math.isnan(status.supply_v):
        line += f"  {status.supply_v:5.2f} V"
    if (celsius := board.joints.temperature_c) is not None:
        line += f"  {celsius.max():.0f} deg C"
    return f"{line}  {faults}" if faults else line


def gains_json(values: Array) -> dict[str, Any]:
    """Return gains (6, 8) as JSON has them: a list of six joints for each gain."""
    return {name: [float(np.float32(each)) for each in values[:, k]] for k, name in enumerate(GAIN_RANGES)}


def gains_text(values: Array) -> str:
    """Return gains (6, 8) as a table."""
    lines = ["joint" + "".join(f"{name:>21}" for name in GAIN_RANGES)]
    lines += [f"{joint + 1:5}" + "".join(f"{value:21.6g}" for value in row) for joint, row in enumerate(values)]
    return "\n".join(lines)


def changed_gains(values: Array, changes: Sequence[str]) -> Array:
    """Return gains (6, 8) with changes of the form ``JOINT:NAME=VALUE``; JOINT is 1 to 6 or ``all``.

    Raises:
        InputError: a change is not of this form.
    """
    changed, names = values.copy(), list(GAIN_RANGES)
    for change in changes:
        joint, _, rest = change.partition(":")
        name, _, text = rest.partition("=")
        known = (*(str(j + 1) for j in range(JOINTS)), "all")
        if joint not in known or name not in names:
            raise InputError(f"{change!r}: JOINT:NAME=VALUE is needed, JOINT 1 to 6 or all, NAME {', '.join(names)}")
        try:
            value = float(text)
        except ValueError:
            raise InputError(f"{change!r}: {text!r} is no number") from None
        changed[slice(None) if joint == "all" else int(joint) - 1, names.index(name)] = value
    return changed


def with_gains(config: Configuration, values: Array) -> Configuration:
    """Return a configuration with other gains (6, 8)."""
    changed = config.copy()
    for k, name in enumerate(GAIN_RANGES):
        changed["joint"]["gains"][name] = values[:, k]
    return changed


def selftest_text(result: SelftestResult) -> str:
    """Return the result of a self-test as lines."""
    lines = [
        f"{name:14} {'failed' if each.problems else 'passed'}  {(each.trace_sha256 or '')[:16]}".rstrip()
        for name, each in result.scenarios.items()
    ]
    lines.append(f"{result.ticks_per_s:.0f} ticks/s, {result.ticks_per_s / 1000:.1f} times real time")
    if result.elf.flash_bytes is not None:
        float_text = "hardware" if result.elf.hard_float else "software"
        lines.append(f"flash {result.elf.flash_bytes}, RAM {result.elf.ram_bytes} bytes, {float_text} floating point")
    return "\n".join(lines)
