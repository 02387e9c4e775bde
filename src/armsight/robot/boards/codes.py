"""What a board's numbers mean: its states, faults, rejections and limits, as ``firmware/core/types.h`` lists them.

The long lists, and their texts, are the header's own (:mod:`~armsight.robot.boards.headers`).
"""

from __future__ import annotations

from enum import EnumMeta, IntEnum, IntFlag
from typing import TYPE_CHECKING, Any, Self

from armsight.robot.boards import headers


class _Listed(EnumMeta):
    """Of enumerations whose members are read from a header."""

    if TYPE_CHECKING:

        def __getattr__(cls, name: str) -> Any: ...  # noqa: ANN401


class Code(IntEnum, metaclass=_Listed):
    """A number with what it says."""

    text: str

    def __new__(cls, code: int, text: str = "") -> Self:
        """Return the code of this number and text."""
        member = int.__new__(cls, code)
        member._value_, member.text = code, text
        return member


class BoardState(Code):
    """The state of a board and its drives."""

    vars().update(headers.listed("STATE"))


class Fault(Code):
    """What went wrong; bit ``1 << code % 32`` in a set of faults."""

    vars().update(headers.listed("FAULT"))


class Rejection(Code):
    """Why a command was not acknowledged."""

    NONE = 0, "acknowledged"
    vars().update(headers.listed("REJECTION"))


class Alarm(Code):
    """What went wrong by the word of a controller that is not our firmware; no number of it is a :class:`Fault`'s."""

    VOLTAGE = 101, "supply outside the servo's limits"
    ANGLE_SENSOR = 102, "angle sensor broken"
    OVERHEAT = 103, "too hot: let it cool down"
    OVERCURRENT = 104, "current too high"
    OVERLOAD = 105, "overload: the servo has switched its torque down; take the load off, then enable again"
    EMERGENCY_STOP = 106, "the emergency stop was pressed"


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


STATE_TEXTS = {state: state.text for state in BoardState}


def faults_in(bits: int) -> tuple[Fault, ...]:
    """Return the faults of a set of bits, by code; bits that belong to no fault are ignored."""
    return tuple(fault for fault in Fault if bits >> fault % 32 & 1) if bits else ()
