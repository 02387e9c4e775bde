"""What a board's numbers mean: its states, faults, rejections and limits, as ``firmware/core/types.h`` lists them.

The texts are the firmware's own; a test reads the header and holds both together.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum, IntFlag


class BoardState(IntEnum):
    """The state of a board and its drives."""

    DISABLED = 0
    ENABLED = 1
    STOPPING = 2
    HOLDING = 3
    FAULTED = 4
    STOPPED = 5


class Fault(IntEnum):
    """What went wrong; bit ``1 << code % 32`` in a set of faults."""

    POT_OPEN = 1
    POT_SHORT = 2
    POT_FROZEN = 3
    POT_JUMP = 4
    POT_INVERTED = 5
    FOLLOWING = 6
    STALL = 7
    HOST_SILENT = 8
    SUPPLY_LOW = 9
    SUPPLY_HIGH = 10
    TICK_MISSED = 11
    TICK_OVERRUN = 12
    WATCHDOG = 13
    CONFIG = 14
    POT_SLIP = 15
    POT_DRIFT = 16
    POT_SCALE = 17
    POT_LAG = 18
    OVERLOAD = 19
    PUSHED = 20
    OVERSPEED = 21
    OSCILLATION = 22
    CURRENT_SENSOR = 23
    OVERCURRENT = 24
    ARITHMETIC = 25
    MEMORY = 26
    TICKS_LOST = 27
    TAKEN_OVER = 28
    CRASH = 29
    ENCODER = 30
    BRIDGE = 31
    MOTOR = 32


class Alarm(IntEnum):
    """What went wrong by the word of a controller that is not our firmware; no number of it is a :class:`Fault`'s."""

    VOLTAGE = 101
    ANGLE_SENSOR = 102
    OVERHEAT = 103
    OVERCURRENT = 104
    OVERLOAD = 105
    EMERGENCY_STOP = 106


class Rejection(IntEnum):
    """Why a command was not acknowledged."""

    NONE = 0
    NOT_FINITE = 1
    OUT_OF_RANGE = 2
    WRONG_STATE = 3
    OUTSIDE_LIMITS = 4
    POT_UNREAD = 5
    FAULT_STANDS = 6
    STOP_PRESSED = 7
    UNKNOWN_COMMAND = 8
    NO_HELLO = 9
    TOO_MANY = 10
    CONFIG_BROKEN = 11
    NOT_OWNER = 12
    NOT_HOMED = 13


class Limited(IntFlag):
    """What holds a joint back without being a fault."""

    DUTY = 1
    SLEW = 2
    CURRENT = 4
    SOFT = 8
    SPEED = 16
    ACCELERATION = 32


class Command(IntEnum):
    """The commands of a board beside motion; the numbers are the wire's."""

    ENABLE = 2
    ENABLE_INWARD = 3
    DISABLE = 4
    CLEAR_FAULTS = 5
    CLEAR_STOP = 6
    HOME = 8


class SensorKind(IntEnum):
    """What reads a joint's angle."""

    POTENTIOMETER = 0
    QUADRATURE = 1
    ABSOLUTE = 2


class Reaction(IntEnum):
    """What an arm does when no command comes from its host."""

    HOLD = 1
    RELEASE = 2


class ConfigSource(IntEnum):
    """Where a board took its configuration from."""

    NEWEST = 0
    OLDER = 1
    FACTORY = 2


STATE_TEXTS: Mapping[BoardState, str] = {
    BoardState.DISABLED: "disabled: drives off",
    BoardState.ENABLED: "enabled: follows the host",
    BoardState.STOPPING: "stopping: a fault slows the arm down to rest",
    BoardState.HOLDING: "holding: the arm is held at rest until it is enabled",
    BoardState.FAULTED: "faulted: a fault stands, drives off",
    BoardState.STOPPED: "emergency stop: drives off until it is cleared",
}
FAULT_TEXTS: Mapping[Fault, str] = {
    Fault.POT_OPEN: "potentiometer open: the reading is above its band",
    Fault.POT_SHORT: "potentiometer short: the reading is below its band",
    Fault.POT_FROZEN: "potentiometer frozen: the reading stands still while the motor rotates",
    Fault.POT_JUMP: "potentiometer jump: the reading moved faster than the joint can",
    Fault.POT_INVERTED: "inverted: the reading moves against the motor",
    Fault.FOLLOWING: "following error: the joint is too far from its reference",
    Fault.STALL: "stall: the motor is driven hard and the joint does not rotate",
    Fault.HOST_SILENT: "host silent: no motion command within the time set",
    Fault.SUPPLY_LOW: "supply too low",
    Fault.SUPPLY_HIGH: "supply too high",
    Fault.TICK_MISSED: "tick missed: the control loop lost time",
    Fault.TICK_OVERRUN: "tick overrun: the control loop took longer than its period",
    Fault.WATCHDOG: "restarted by the watchdog",
    Fault.CONFIG: "no valid configuration: factory values are in use",
    Fault.POT_SLIP: "potentiometer slips: the reading stays behind the motor",
    Fault.POT_DRIFT: "potentiometer drifts: the reading moves by itself",
    Fault.POT_SCALE: "potentiometer scale: the reading moves too far or not far enough",
    Fault.POT_LAG: "potentiometer lags: the reading follows the motor late",
    Fault.OVERLOAD: "overload: the duty is at its limit and the joint does not follow",
    Fault.PUSHED: "pushed: something moves the joint against its motor",
    Fault.OVERSPEED: "overspeed: the joint is faster than its limit",
    Fault.OSCILLATION: "oscillation: the joint swings about its reference; the stored gains are in use again",
    Fault.CURRENT_SENSOR: "current: its sensor shows another one than the voltage must drive, or a lead is broken",
    Fault.OVERCURRENT: "overcurrent: the motor current stays beyond twice its limit",
    Fault.ARITHMETIC: "arithmetic: a duty was no number",
    Fault.MEMORY: "memory: the configuration in use has changed by itself",
    Fault.TICKS_LOST: "ticks lost: the control loop loses time again and again",
    Fault.TAKEN_OVER: "taken over: another host said hello while the arm was driven",
    Fault.CRASH: "restarted after a crash of the firmware",
    Fault.ENCODER: "encoder: no sound reading: its wires, or a magnet too weak or too strong",
    Fault.BRIDGE: "bridge: it drives its motor by itself; all drives sleep",
    Fault.MOTOR: "motor: weak, or a winding shorted: it moves otherwise than its voltage and current say",
}
ALARM_TEXTS: Mapping[Alarm, str] = {
    Alarm.VOLTAGE: "supply outside the servo's limits",
    Alarm.ANGLE_SENSOR: "angle sensor broken",
    Alarm.OVERHEAT: "too hot: let it cool down",
    Alarm.OVERCURRENT: "current too high",
    Alarm.OVERLOAD: "overload: the servo has switched its torque down; take the load off, then enable again",
    Alarm.EMERGENCY_STOP: "the emergency stop was pressed",
}
REJECTION_TEXTS: Mapping[Rejection, str] = {
    Rejection.NONE: "acknowledged",
    Rejection.NOT_FINITE: "a number is NaN or infinite",
    Rejection.OUT_OF_RANGE: "a number is outside its range",
    Rejection.WRONG_STATE: "not in this state",
    Rejection.OUTSIDE_LIMITS: "a joint is outside its soft limits: enable to move back in",
    Rejection.POT_UNREAD: "a potentiometer is not read",
    Rejection.FAULT_STANDS: "the cause of a fault still stands",
    Rejection.STOP_PRESSED: "the emergency stop is still pressed",
    Rejection.UNKNOWN_COMMAND: "unknown command",
    Rejection.NO_HELLO: "no hello of the board's own version came: only STOP is acknowledged",
    Rejection.TOO_MANY: "too many commands at once",
    Rejection.CONFIG_BROKEN: "the configuration came incomplete, or could not be stored",
    Rejection.NOT_OWNER: "another host has the session: say hello again",
    Rejection.NOT_HOMED: "an encoder does not know its zero: bring the arm to its home and give HOME",
}


def faults_in(bits: int) -> tuple[Fault, ...]:
    """Return the faults of a set of bits, by code; bits that belong to no fault are ignored."""
    return tuple(fault for fault in Fault if bits >> fault % 32 & 1) if bits else ()
