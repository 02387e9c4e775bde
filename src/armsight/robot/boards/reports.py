"""What a board says of itself, as frozen records made of the wire's messages."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from armsight.data import Array, Record
from armsight.robot.boards import codes
from armsight.robot.boards.wire import Message

_NO_JOINT = 255


@dataclass(frozen=True)
class BoardAbilities:
    """What a board has for joints."""

    joints: int  #: how many
    sensors: tuple[codes.SensorKind, ...]  #: the kinds of sensors it reads
    quadrature_inputs: int  #: how many quadrature encoders it counts: inputs 1 to so many


@dataclass(frozen=True)
class Welcome:
    """The identity of a board."""

    board: str  #: its name
    firmware: str  #: its firmware's version
    ticks_per_s: int  #: how many ticks its clock has a second; 0 where it has none and the host stamps its readings
    baud: int  #: bits a second on its wire
    config_source: codes.ConfigSource | None  #: where its configuration came from; None where it has none of ours
    crash: tuple[int, ...] | None = None  #: where the firmware crashed before it started: exception, pc, lr and CFSR
    abilities: BoardAbilities | None = None  #: what it has for joints; None where it does not say


@dataclass(frozen=True)
class JointFault:
    """A latched fault."""

    fault: codes.Fault | codes.Alarm  #: which
    joint: int | None = None  #: of which joint, from 0; None where it belongs to none

    def __str__(self) -> str:
        where = "" if self.joint is None else f"joint {self.joint + 1}: "
        return where + self.fault.text


@dataclass(frozen=True)
class BoardStatus:
    """The status of a board; what it does not count is 0."""

    t_s: float  #: when, s on the board's clock
    state: codes.BoardState  #: what it does with its drives
    faults: tuple[JointFault, ...]  #: all that are latched
    first_fault: JointFault | None  #: the one that came first since the last clear
    supply_v: float  #: motor supply, V; NaN where nobody measures it
    acknowledged_sequence: int  #: number of the last command acknowledged
    acknowledged_count: int  #: how many were
    rejected_sequence: int = 0  #: number of the last command rejected
    rejected_count: int = 0  #: how many were
    rejection: codes.Rejection = codes.Rejection.NONE  #: why that one was
    crc_errors: int = 0  #: messages from the host that were broken
    lost_bytes: int = 0  #: bytes from the host that belonged to no message
    overrun_bytes: int = 0  #: bytes from the host for which there was no room
    stale_commands: int = 0  #: commands dropped because a newer one had come already
    lost_messages: int = 0  #: messages from the host that are missing in the count of the frames
    config_stored: int = 0  #: configurations stored since the start
    not_homed: int = 0  #: joints whose encoder counts from an unknown zero, a bit each

    @property
    def joints_not_homed(self) -> list[int]:
        """Those joints, from 1."""
        return [k + 1 for k in range(self.not_homed.bit_length()) if self.not_homed >> k & 1]

    @property
    def drives_on(self) -> bool:
        """Whether the motors are driven."""
        return self.state in (codes.BoardState.ENABLED, codes.BoardState.STOPPING, codes.BoardState.HOLDING)


@dataclass(frozen=True, eq=False)
class JointReport(Record):
    """How the joints are driven."""

    t_s: float  #: when, s on the board's clock
    speed_rad_s: Array  #: (n,) measured speeds, filtered
    reference_rad: Array  #: (n,) where the joints are to be
    reference_rad_s: Array  #: (n,) how fast they are to move
    duty: Array  #: (n,) to the motors, -1 to 1
    limited: tuple[codes.Limited, ...]  #: what holds each joint back without being a fault
    temperature_c: Array | None = None  #: (n,) of the motors, degrees Celsius; None where nothing measures it


@dataclass(frozen=True, eq=False)
class SensorReadings(Record):
    """What a board's converters read over some time."""

    t_s: Array  #: (n,) when, s on the board's clock
    counts: Array  #: (n, 6) potentiometers, 16-bit fractions of their supply
    current_a: Array  #: (n, 6) motor currents, A, positive where a positive duty drives them
    duty: Array  #: (n, 6) to the motors while this was read, -1 to 1


def welcome_of(message: Message) -> Welcome:
    """Return what a WELCOME says."""
    sensors = tuple(kind for kind in codes.SensorKind if message.sensors >> kind & 1)
    return Welcome(
        board=_text(message.board),
        firmware=_text(message.firmware),
        ticks_per_s=message.ticks_per_s,
        baud=message.baud,
        config_source=codes.ConfigSource(message.config_source),
        crash=tuple(map(int, message.crash)) if any(message.crash) else None,
        abilities=BoardAbilities(message.joints, sensors, message.quadrature_inputs) if sensors else None,
    )


def status_of(message: Message, t_s: float) -> BoardStatus:
    """Return what a BOARD_STATUS says."""
    first = None
    if message.first_fault:
        joint = None if message.first_joint == _NO_JOINT else message.first_joint
        first = JointFault(codes.Fault(message.first_fault), joint)
    names = [each.name for each in fields(BoardStatus)]
    return BoardStatus(
        t_s,
        codes.BoardState(message.state),
        _faults(message.faults, message.joint_faults),
        first,
        message.supply_mv * 1e-3,
        rejection=codes.Rejection(message.rejection),
        **{name: getattr(message, name) for name in names[names.index("supply_v") + 1 :] if name != "rejection"},
    )


def joints_of(message: Message, t_s: float) -> JointReport:
    """Return what a JOINTS says."""
    speed, reference, reference_speed, duty = (
        np.array(each) for each in (message.speed_rad_s, message.reference_rad, message.reference_rad_s, message.duty)
    )
    return JointReport(t_s, speed, reference, reference_speed, duty, tuple(map(codes.Limited, message.limited)))


def readings_of(messages: list[Message], times_s: list[float]) -> SensorReadings:
    """Return what SENSED messages say."""
    counts, current_ma, duty = (
        np.array([getattr(each, name) for each in messages], dtype=float).reshape(-1, 6)
        for name in ("counts", "current_ma", "duty")
    )
    return SensorReadings(np.array(times_s), counts, 1e-3 * current_ma, duty)


def _faults(bits: int, joint_bits: list[int]) -> tuple[JointFault, ...]:
    of_joints = [JointFault(fault, j) for j, own in enumerate(joint_bits) for fault in codes.faults_in(own)]
    of_named_joints = {each.fault for each in of_joints}
    return tuple(of_joints + [JointFault(fault) for fault in codes.faults_in(bits) if fault not in of_named_joints])


def _text(field: object) -> str:
    """Return a name as the dialect's decoder gives it: text, or bytes padded with zeros."""
    raw = field if isinstance(field, bytes) else str(field).encode()
    return raw.rstrip(b"\0").decode("ascii", "replace")
