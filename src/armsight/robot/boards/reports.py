"""What a board says of itself, as frozen records made of the wire's messages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armsight.data import Array, Record
from armsight.robot.boards.codes import (
    ALARM_TEXTS,
    FAULT_TEXTS,
    Alarm,
    BoardState,
    ConfigSource,
    Fault,
    Limited,
    Rejection,
    SensorKind,
    faults_in,
)
from armsight.robot.boards.wire import Message

_NO_JOINT = 255


@dataclass(frozen=True)
class BoardAbilities:
    """What a board has for joints.

    Attributes:
        joints: how many.
        sensors: the kinds of sensors it reads.
        quadrature_inputs: how many quadrature encoders it counts: inputs 1 to so many.
    """

    joints: int
    sensors: tuple[SensorKind, ...]
    quadrature_inputs: int


@dataclass(frozen=True)
class Welcome:
    """The identity of a board.

    Attributes:
        board: its name.
        firmware: its firmware's version.
        ticks_per_s: how many ticks its clock has a second; 0 where it has none and the host stamps its readings.
        baud: bits a second on its wire.
        config_source: where its configuration came from; None where it has none of ours.
        crash: where the firmware crashed before it started: exception, pc, lr and CFSR; None where it did not.
        abilities: what it has for joints; None where it does not say.
    """

    board: str
    firmware: str
    ticks_per_s: int
    baud: int
    config_source: ConfigSource | None
    crash: tuple[int, ...] | None = None
    abilities: BoardAbilities | None = None


@dataclass(frozen=True)
class JointFault:
    """A latched fault.

    Attributes:
        fault: which.
        joint: of which joint, from 0; None where it belongs to none.
    """

    fault: Fault | Alarm
    joint: int | None = None

    def __str__(self) -> str:
        where = "" if self.joint is None else f"joint {self.joint + 1}: "
        return where + (ALARM_TEXTS[self.fault] if isinstance(self.fault, Alarm) else FAULT_TEXTS[self.fault])


@dataclass(frozen=True)
class BoardStatus:
    """The status of a board.

    Attributes:
        t_s: when, s on the board's clock.
        state: what it does with its drives.
        faults: all that are latched.
        first_fault: the one that came first since the last clear; None without.
        acknowledged_sequence: number of the last command acknowledged.
        acknowledged_count: how many were.
        rejected_sequence: number of the last command rejected.
        rejected_count: how many were.
        rejection: why that one was.
        supply_v: motor supply, V.
        crc_errors: messages from the host that were broken.
        lost_bytes: bytes from the host that belonged to no message.
        overrun_bytes: bytes from the host for which there was no room.
        stale_commands: commands dropped because a newer one had come already.
        lost_messages: messages from the host that are missing in the count of the frames.
        config_stored: configurations stored since the start.
    """

    t_s: float
    state: BoardState
    faults: tuple[JointFault, ...]
    first_fault: JointFault | None
    acknowledged_sequence: int
    acknowledged_count: int
    rejected_sequence: int
    rejected_count: int
    rejection: Rejection
    supply_v: float
    crc_errors: int
    lost_bytes: int
    overrun_bytes: int
    stale_commands: int
    lost_messages: int
    config_stored: int

    @property
    def drives_on(self) -> bool:
        """Whether the motors are driven."""
        return self.state in (BoardState.ENABLED, BoardState.STOPPING, BoardState.HOLDING)


@dataclass(frozen=True, eq=False)
class JointReport(Record):
    """How the joints are driven.

    Attributes:
        t_s: when, s on the board's clock.
        speed_rad_s: (n,) measured speeds, filtered.
        reference_rad: (n,) where the joints are to be.
        reference_rad_s: (n,) how fast they are to move.
        duty: (n,) to the motors, -1 to 1.
        limited: what holds each joint back without being a fault.
        temperature_c: (n,) of the motors, degrees Celsius; None where nothing measures it.
    """

    t_s: float
    speed_rad_s: Array
    reference_rad: Array
    reference_rad_s: Array
    duty: Array
    limited: tuple[Limited, ...]
    temperature_c: Array | None = None


@dataclass(frozen=True, eq=False)
class SensorReadings(Record):
    """What a board's converters read over some time.

    Attributes:
        t_s: (n,) when, s on the board's clock.
        counts: (n, 6) potentiometers, 16-bit fractions of their supply.
        current_a: (n, 6) motor currents, A, positive where a positive duty drives them.
        duty: (n, 6) to the motors while this was read, -1 to 1.
    """

    t_s: Array
    counts: Array
    current_a: Array
    duty: Array


def plain_status(
    t_s: float, state: BoardState, faults: tuple[JointFault, ...], supply_v: float, sent: int
) -> BoardStatus:
    """Return the status of a controller that keeps none of our firmware's counts.

    Args:
        t_s: when, s.
        state: of its drives.
        faults: all that stand.
        supply_v: motor supply, V; NaN where nobody measures it.
        sent: commands sent, which count as acknowledged.
    """
    return BoardStatus(
        t_s=t_s,
        state=state,
        faults=faults,
        first_fault=faults[0] if faults else None,
        acknowledged_sequence=sent,
        acknowledged_count=sent,
        rejected_sequence=0,
        rejected_count=0,
        rejection=Rejection.NONE,
        supply_v=supply_v,
        crc_errors=0,
        lost_bytes=0,
        overrun_bytes=0,
        stale_commands=0,
        lost_messages=0,
        config_stored=0,
    )


def welcome_of(message: Message) -> Welcome:
    """Return what a WELCOME says."""
    return Welcome(
        board=_text(message.board),
        firmware=_text(message.firmware),
        ticks_per_s=message.ticks_per_s,
        baud=message.baud,
        config_source=ConfigSource(message.config_source),
        crash=tuple(map(int, message.crash)) if any(message.crash) else None,
        abilities=_abilities_of(message) if message.sensors else None,
    )


def _abilities_of(message: Message) -> BoardAbilities:
    sensors = tuple(kind for kind in SensorKind if message.sensors >> kind & 1)
    return BoardAbilities(int(message.joints), sensors, int(message.quadrature_inputs))


def status_of(message: Message, t_s: float) -> BoardStatus:
    """Return what a BOARD_STATUS says."""
    first = None
    if message.first_fault:
        first = JointFault(
            Fault(message.first_fault), None if message.first_joint == _NO_JOINT else message.first_joint
        )
    return BoardStatus(
        t_s=t_s,
        state=BoardState(message.state),
        faults=_faults(message.faults, message.joint_faults),
        first_fault=first,
        acknowledged_sequence=message.acknowledged_sequence,
        acknowledged_count=message.acknowledged_count,
        rejected_sequence=message.rejected_sequence,
        rejected_count=message.rejected_count,
        rejection=Rejection(message.rejection),
        supply_v=message.supply_mv * 1e-3,
        crc_errors=message.crc_errors,
        lost_bytes=message.lost_bytes,
        overrun_bytes=message.overrun_bytes,
        stale_commands=message.stale_commands,
        lost_messages=message.lost_messages,
        config_stored=message.config_stored,
    )


def joints_of(message: Message, t_s: float) -> JointReport:
    """Return what a JOINTS says."""
    return JointReport(
        t_s=t_s,
        speed_rad_s=np.array(message.speed_rad_s),
        reference_rad=np.array(message.reference_rad),
        reference_rad_s=np.array(message.reference_rad_s),
        duty=np.array(message.duty),
        limited=tuple(Limited(bits) for bits in message.limited),
    )


def readings_of(messages: list[Message], times_s: list[float]) -> SensorReadings:
    """Return what SENSED messages say."""
    return SensorReadings(
        t_s=np.array(times_s),
        counts=np.array([each.counts for each in messages], dtype=float).reshape(-1, 6),
        current_a=1e-3 * np.array([each.current_ma for each in messages], dtype=float).reshape(-1, 6),
        duty=np.array([each.duty for each in messages], dtype=float).reshape(-1, 6),
    )


def _faults(bits: int, joint_bits: list[int]) -> tuple[JointFault, ...]:
    """Return the latched faults, those of the joints first."""
    of_joints = [JointFault(fault, j) for j, own in enumerate(joint_bits) for fault in faults_in(own)]
    of_named_joints = {each.fault for each in of_joints}
    return tuple(of_joints + [JointFault(fault) for fault in faults_in(bits) if fault not in of_named_joints])


def _text(field: object) -> str:
    """Return a name as the dialect's decoder gives it: text, or bytes padded with zeros."""
    raw = field if isinstance(field, bytes) else str(field).encode()
    return raw.rstrip(b"\0").decode("ascii", "replace")
