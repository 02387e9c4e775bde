"""A board's configuration as the host edits it: gains, limits and tables of all joints, with the ranges of each.

A :data:`Configuration` is a structured numpy array of shape () laid out as ``core_config`` in ``firmware/core/types.h``, so
that its bytes are the board's bytes::

    config = board.configuration()
    config["joint"]["soft_max_rad"][2] = 1.2        # third joint
    config["joint"]["gains"]["kp_per_rad"] = 5.0    # all joints
    board.store(config)
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.errors import InputError
from armsight.robot.boards import headers
from armsight.robot.boards.codes import Reaction, SensorKind
from armsight.robot.boards.tuning import GAIN_RANGES, MotorFigures, tuned_gains

Configuration = NDArray[np.void]
JOINTS, POT_NODES = headers.number("JOINTS"), headers.number("POT_NODES")
ENCODER_REV = headers.number("ENCODER_REV")  # counts of an absolute encoder's revolution
#: Layout of the configuration this armsight knows: ``firmware/core/config.h``.
CONFIG_VERSION = headers.number("CONFIG_VERSION")
#: Part of a configuration -> its record; a joint is the parts and its own numbers.
_RECORDS = {
    "gains": "joint_gains",
    "pot": "pot_config",
    "motor": "motor_config",
    "encoder": "encoder_config",
    "transmission": "transmission_config",
    "joint": "joint_config",
    "arm": "core_config",
}
GAINS, POT, MOTOR, ENCODER, TRANSMISSION, JOINT, CONFIG = map(headers.record, _RECORDS.values())
#: Part -> name -> smallest and largest value.
_RANGES = {part: headers.ranges(record) for part, record in _RECORDS.items()}
#: All of them by name; no name stands for two things.
RANGES: Mapping[str, tuple[float, float]] = {name: each for of in _RANGES.values() for name, each in of.items()}
#: What of an encoder's configuration each kind of sensor needs beside the kind itself.
ENCODER_FIELDS: Mapping[SensorKind, tuple[str, ...]] = {
    SensorKind.POTENTIOMETER: (),
    SensorKind.QUADRATURE: ("input", "counts_per_rev", "direction", "home_rad"),
    SensorKind.ABSOLUTE: ("counts_per_rev", "direction", "zero_counts", "home_rad"),
}

#: Pins as ``sync_led_pin`` has them, 0 for none: 16 (port + 1) + pin.
PIN_NUMBERS = (16, 143)
NO_PIN, _PIN_FORM = "none", "none or a pin such as PB13 is allowed"
#: How long each bit of the sync LED's code lasts by default, ticks: no divisor of the usual periods of cameras.
SYNC_LED_TICKS = 3
#: Pins of a board that have another use, docs/reference/nucleo_pins.md and blackpill.md; its debugger's too.
USED_PINS: Mapping[str, frozenset[str]] = {
    "nucleo-f446re": frozenset(
        [f"PA{pin}" for pin in (*range(11), 13, 14, 15)]
        + [f"PB{pin}" for pin in (*range(11), 12, 14, 15)]
        + [f"PC{pin}" for pin in range(13)]
    ),
    "blackpill-f411ce": frozenset(
        [f"PA{pin}" for pin in (*range(12), 13, 14, 15)] + [f"PB{pin}" for pin in (*range(11), *range(12, 16))]
    ),
}


def pin_name(number: int) -> str:
    """Return the name of a pin, such as PB13; "none" for 0."""
    return f"P{chr(ord('A') + number // 16 - 1)}{number % 16}" if number else NO_PIN


def pin_number(name: object) -> int:
    """Return a pin as the configuration has it: 0 for "none", or raise InputError: it is no pin's name."""
    match = re.fullmatch(r"P([A-H])(\d|1[0-5])", name) if isinstance(name, str) else None
    if name != NO_PIN and match is None:
        raise InputError(f"sync_led_pin is {name!r}; {_PIN_FORM}")
    return 0 if match is None else 16 * (ord(match[1]) - ord("A") + 1) + int(match[2])


def check_pin(config: Configuration, board: str) -> None:
    """Check that the sync LED's pin exists and has no other use on a board of this name; else InputError."""
    name = pin_name(int(config["sync_led_pin"]))
    used = USED_PINS.get(board)
    if used is not None and name != NO_PIN and (name in used or name[1] > "C"):
        use = "has another use" if name in used else "is not led out"
        free = next(pin for pin in ("PB13", "PA12") if pin not in used)
        raise InputError(
            f"sync_led_pin is {name}, which {use} on {board}: take a free one, such as {free}"
            " (docs/reference/nucleo_pins.md has the table); nothing was changed"
        )


#: The simulated arm's motors (:mod:`armsight.sim.joints`), and how stiffly they are driven.
_LAB_MOTOR, _LAB_SUPPLY_V, _LAB_BANDWIDTH_RAD_S = MotorFigures(6.0, 2.4, 0.03, 0.02, 0.2), 12.0, 24.0
#: At most 10 mrad of backlash; it and five sigma of 20 counts of noise.
LAB_BACKLASH_RAD, _LAB_APART_RAD = 0.01, 0.02


def put_values(record: Configuration, **values: object) -> None:
    """Put values into a part of a configuration, in-place."""
    for name, value in values.items():
        record[name] = value


def lab_configuration() -> Configuration:
    """Return a configuration for the simulated arm: firm gains, +-2.4 rad, 2 rad/s, 12 V, host silent after 100 ms."""
    config = np.zeros((), CONFIG)
    joint, pot = config["joint"], config["joint"]["pot"]
    joint["gains"] = np.array(tuple(tuned_gains(_LAB_MOTOR, _LAB_SUPPLY_V, _LAB_BANDWIDTH_RAD_S)), GAINS)
    motor = (_LAB_MOTOR.resistance_ohm, _LAB_MOTOR.constant_v_s, _LAB_APART_RAD, LAB_BACKLASH_RAD)
    joint["motor"] = np.array(motor, MOTOR)
    put_values(pot, node_count=2, short_counts=1000, open_counts=64500, direction=1)
    put_values(pot, jump_rad=0.02, frozen_rad=0.02, inverted_rad=0.15)
    pot["counts"][:, :2], pot["angle_rad"][:, :2] = (3277, 62258), (-2.6, 2.6)
    put_values(joint, soft_min_rad=-2.4, soft_max_rad=2.4, speed_limit_rad_s=2.0, deceleration_rad_s2=10.0)
    put_values(joint, acceleration_rad_s2=10.0, jerk_rad_s3=1000.0, gravity_slew_per_s=5.0, duty_limit=0.8)
    put_values(joint, duty_slew_per_s=500.0, current_cut_per_a_s=5.0, following_rad=0.3, stall_duty=0.5)
    put_values(joint, stall_rad=0.01, current_limit_ma=1600, motor_direction=1)
    put_values(config, joint_count=JOINTS, supply_min_mv=10000, supply_max_mv=14000, supply_ticks=5, pot_ticks=5)
    put_values(config, supply_nominal_mv=round(1e3 * _LAB_SUPPLY_V), overload_ticks=200, following_ticks=20)
    put_values(
        config, stall_ticks=200, silence_ticks=100, silence_reaction=Reaction.HOLD, sync_led_ticks=SYNC_LED_TICKS
    )
    return config


def gains_array(config: Configuration) -> Array:
    """Return a configuration's gains: (6, 8), a row per joint: kp, ki, kd, kv, ka, kf, derivative filter, anti-windup."""
    gains = config["joint"]["gains"]
    return np.stack([gains[name].astype(float) for name in GAIN_RANGES], axis=1)


def check_gains(gains: Array, count: int = JOINTS) -> Array:
    """Return a gain set (6, 8); InputError names the gain and the joint, of the first ``count``, that is out of range."""
    values = np.asarray(gains, dtype=float)
    if values.shape != (JOINTS, len(GAIN_RANGES)):
        raise InputError(
            f"gains are of shape {values.shape}; (6, 8) is needed: a row per joint of {', '.join(GAIN_RANGES)}"
        )
    for column, (name, (low, high)) in enumerate(GAIN_RANGES.items()):
        for joint in range(count):
            if not low <= values[joint, column] <= high:
                raise InputError(
                    f"joint {joint + 1}: {name} is {values[joint, column]:g}; {low:g} to {high:g} is allowed;"
                    " nothing was changed"
                )
    return values


def check_configuration(config: Configuration) -> None:
    """Check a configuration that the board would reject as a whole; InputError says what is wrong with it."""
    if config.dtype != CONFIG or config.shape != ():
        raise InputError("this is no configuration: begin with board.configuration() and change what is to change")
    for problem in _problems(config):
        raise InputError(f"configuration: {problem}; nothing was changed")


def _problems(config: Configuration) -> Iterator[str]:
    yield from _outside(config, _RANGES["arm"])
    joints, count = config["joint"], min(int(config["joint_count"]), JOINTS)
    check_gains(gains_array(config), count)
    for j in range(count):
        for values, ranges in _ranged(joints[j]):
            yield from (f"joint {j + 1}: {text}" for text in _outside(values, ranges))
        yield from (f"joint {j + 1}: {text}" for text in _joint_problems(joints[j]))
    inputs: dict[int, int] = {}
    for j in range(count):
        encoder = joints[j]["encoder"]
        if encoder["sensor"] == SensorKind.QUADRATURE and (taken := inputs.setdefault(int(encoder["input"]), j)) != j:
            yield f"joints {taken + 1} and {j + 1} are both on encoder input {encoder['input']}; each timer counts for one"
    if config["supply_min_mv"] >= config["supply_max_mv"]:
        yield "supply_min_mv must be below supply_max_mv"
    if config["supply_min_mv"] < config["supply_nominal_mv"] // 2:
        yield f"supply_min_mv is {config['supply_min_mv']}; half of supply_nominal_mv or more is needed, in millivolts"
    if config["sync_led_pin"] and not PIN_NUMBERS[0] <= config["sync_led_pin"] <= PIN_NUMBERS[1]:
        yield f"sync_led_pin is {config['sync_led_pin']}; {_PIN_FORM}"
    if config["silence_reaction"] not in tuple(Reaction):
        yield f"silence_reaction is {config['silence_reaction']}; 1 (hold) or 2 (release) is allowed"


def _ranged(joint: Configuration) -> Iterator[tuple[Configuration, Mapping[str, tuple[float, float]]]]:
    """Yield each part of a joint with the ranges that count for its sensor."""
    sensor = int(joint["encoder"]["sensor"])
    yield joint, _RANGES["joint"]
    for part in ("motor", "transmission"):
        yield joint[part], _RANGES[part]
    table = "" if sensor == SensorKind.POTENTIOMETER else "node_count"
    yield joint["pot"], {name: each for name, each in _RANGES["pot"].items() if name != table}
    needed = ENCODER_FIELDS[SensorKind(sensor)] if sensor in tuple(SensorKind) else ()
    yield joint["encoder"], {name: each for name, each in _RANGES["encoder"].items() if name in needed}


def _outside(values: Configuration, ranges: Mapping[str, tuple[float, float]]) -> Iterator[str]:
    for name, (low, high) in ranges.items():
        if not np.float32(low) <= values[name] <= np.float32(high):
            yield f"{name} is {values[name]:g}; {low:g} to {high:g} is allowed"


def _joint_problems(joint: Configuration) -> Iterator[str]:
    sensor = int(joint["encoder"]["sensor"])
    if sensor not in tuple(SensorKind):
        kinds = ", ".join(f"{each.value} ({each.name.lower()})" for each in SensorKind)
        yield f"sensor is {sensor}; {kinds} are allowed"
    yield from _table_problems(joint) if sensor == SensorKind.POTENTIOMETER else _encoder_problems(joint)
    if joint["soft_min_rad"] >= joint["soft_max_rad"]:
        yield "soft_min_rad must be below soft_max_rad"
    if joint["motor_direction"] not in (1, -1):
        yield f"motor_direction is {joint['motor_direction']}; 1 or -1 is allowed"
    if joint["stall_duty"] > joint["duty_limit"]:
        yield "stall_duty must not be beyond duty_limit"
    if joint["motor"]["backlash_rad"] >= joint["motor"]["apart_rad"]:
        yield "backlash_rad must be below apart_rad, which is backlash and noise"
    if np.float32(joint["speed_limit_rad_s"]) * np.float32(1e-3) >= joint["pot"]["jump_rad"]:
        yield "jump_rad must be further than the joint moves in a tick at its speed limit"


def _encoder_problems(joint: Configuration) -> Iterator[str]:
    encoder, pot = joint["encoder"], joint["pot"]
    if encoder["direction"] not in (1, -1):
        yield f"direction of the encoder is {encoder['direction']}; 1 or -1 is allowed"
    # float32 in the board's own order, so that both say the same
    step = np.float32(2 * np.pi) / encoder["counts_per_rev"]
    half = np.float32(ENCODER_REV // 2 - 1) * step
    low, high = encoder["home_rad"] - half, encoder["home_rad"] + half
    absolute = encoder["sensor"] == SensorKind.ABSOLUTE
    if absolute and (joint["soft_min_rad"] < low or joint["soft_max_rad"] > high):
        yield f"the soft limits must lie within the encoder's revolution, {low:.4g} to {high:.4g} rad"
    for name in ("jump_rad", "frozen_rad"):
        if step > np.float32(0.5) * pot[name]:
            yield f"{name} must be two counts of the encoder or more, {2 * step:.2g} rad"


def _table_problems(joint: Configuration) -> Iterator[str]:
    pot = joint["pot"]
    n = int(pot["node_count"])
    counts, angles = np.diff(pot["counts"][:n].astype(int)), np.diff(pot["angle_rad"][:n].astype(float))
    if (counts <= 0).any():
        yield "the counts of the potentiometer's table must rise"
    if not ((angles > 0).all() or (angles < 0).all()) or not (np.abs(pot["angle_rad"][:n]) <= 13.0).all():
        yield "the angles of the potentiometer's table must rise or fall throughout, within -13 to 13 rad"
    if pot["short_counts"] >= pot["open_counts"]:
        yield "short_counts must be below open_counts"
    if pot["direction"] not in (1, -1):
        yield f"direction is {pot['direction']}; 1 or -1 is allowed"
    table = int(pot["direction"]) * pot["angle_rad"][:n]
    if joint["soft_min_rad"] < table.min() or joint["soft_max_rad"] > table.max():
        yield "the soft limits must lie within the potentiometer's table"
    if not pot["short_counts"] < pot["counts"][0] or not pot["counts"][n - 1] < pot["open_counts"]:
        yield "the potentiometer's table must lie between short_counts and open_counts"
