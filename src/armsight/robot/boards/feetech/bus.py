"""Questions to the servos of a bus and their answers; and what is wrong with a bus whose answers do not come.

In: a :class:`~armsight.robot.boards.link.Link` and registers. Out: numbers, or one :class:`~armsight.errors.DeviceError`
that says which id does not answer. A question is asked up to four times, because one disturbed byte spoils it, and waited
for twice as long each time: a servo answers within milliseconds, a program that emulates one when it gets to run. Waits are
counted in polls, so that a host that is late itself takes nothing from the servos' time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NoReturn

from armsight.errors import DeviceError, InputError
from armsight.robot.boards.feetech.packets import Instruction, PacketReader, StatusPacket, packet, sync_read, sync_write
from armsight.robot.boards.feetech.registers import (
    LOCK,
    MODEL,
    POSITION,
    STATE_BYTES,
    STS3215,
    TORQUE,
    Register,
    ServoStates,
    states_of,
)
from armsight.robot.boards.link import Link

BAUD = 1_000_000
#: How long answers may take at each try, s: USB adapters hold bytes back for up to 16 ms; with the last one, the double of
#: an answer's 130 ms on two cores with four busy programs, an unplugged servo is named after 0.45 s.
_WAITS_S = (0.03, 0.06, 0.12, 0.24)
_POLL_S = 0.0005
LOOKED_FOR = range(1, 13)  # ids that are looked for where an expected one does not answer


class ServoBus:
    """The servos on a wire, which :meth:`close` closes; ``name`` and ``baud`` are for errors.

    ``now``: the clock that passes while the link is read, s; ``lost`` counts answers that did not come whole; ``asked_s``
    is when the question was sent that was answered last.
    """

    def __init__(self, link: Link, name: str, baud: int = BAUD, now: Callable[[], float] = time.monotonic) -> None:
        self.name, self.baud, self.now = name, baud, now
        self._link = link
        self._reader = PacketReader()
        self.lost = self._bytes = 0
        self.asked_s = now()

    @property
    def broken(self) -> int:
        """Answers that were broken or did not come."""
        return self._reader.broken + self.lost

    def close(self) -> None:
        """Close the wire."""
        self._link.close()

    def wait(self, wait_s: float) -> None:
        """Let time pass; what comes meanwhile answers nothing."""
        self._link.read(wait_s)

    def read(self, id: int, register: Register) -> int:
        """Return what a register of a servo holds, or raise DeviceError: it does not answer."""
        question = packet(id, Instruction.READ, bytes((register.address, register.width)))
        return register.decode(self._asked(question, [id], register.width)[id].parameters)

    def write(self, id: int, register: Register, value: int) -> None:
        """Write a register of a servo, which acknowledges it, or raise DeviceError: it does not."""
        self._asked(packet(id, Instruction.WRITE, bytes((register.address,)) + register.encode(value)), [id], 0)

    def states(self, ids: Sequence[int]) -> ServoStates:
        """Return the states of servos, all read with one question, or raise DeviceError: one does not answer."""
        answers = self._asked(sync_read(POSITION.address, STATE_BYTES, ids), ids, STATE_BYTES)
        return states_of([answers[id].parameters for id in ids], tuple(answers[id].error for id in ids))

    def write_all(self, register: Register, values: dict[int, bytes]) -> None:
        """Write bytes from a register on to each servo; nobody acknowledges."""
        self._link.write(sync_write(register.address, values))

    def meet(self, ids: Sequence[int]) -> None:
        """Check that all ids answer, each alone as an STS3215; else DeviceError."""
        self.states(ids)
        for id in ids:
            if (model := self.read(id, MODEL)) != STS3215:
                raise DeviceError(f"{self.name}: id {id} is of model {model}; an STS3215 is {STS3215}")

    def unlocked_write(self, id: int, register: Register, value: int) -> None:
        """Write a stored register of a servo whose torque is off (or InputError), and read it back (or DeviceError)."""
        if self.read(id, TORQUE):
            raise InputError(f"{self.name}: the torque of id {id} is on; switch it off first, the arm will sink")
        self.write(id, LOCK, 0)
        try:
            self.write(id, register, value)
            kept = self.read(id, register)
        finally:
            self.write(id, LOCK, 1)
        if kept != value:
            raise DeviceError(f"{self.name}: id {id} keeps {kept} in register {register.address} instead of {value}")

    def _asked(self, question: bytes, ids: Sequence[int], count: int) -> dict[int, StatusPacket]:
        """Ask until all of these ids have answered with ``count`` bytes; say what is wrong where they do not.

        After a try with answers that may be on their way still, nobody knows which try an answer is to: what is late is
        waited for and dropped, and the servos are asked anew.
        """
        late = False
        for wait_s in _WAITS_S:
            broken = self._reader.broken
            answers = self._ask(question, ids, count, wait_s)
            if len(answers) == len(ids):
                break
            late |= len(answers) + self._reader.broken - broken < len(ids)
        if late and len(answers) == len(ids):
            self.wait(wait_s)
            for _ in _WAITS_S:
                answers = self._ask(question, ids, count, _WAITS_S[-1])
                if len(answers) == len(ids):
                    break
        if len(answers) < len(ids):
            self._explain([id for id in ids if id not in answers])
        return answers

    def _ask(self, question: bytes, ids: Sequence[int], count: int, wait_s: float) -> dict[int, StatusPacket]:
        """Ask once and return the whole answers of these ids; without those that came twice."""
        self._link.read(0.0)  # what came late answers nothing
        self._reader.clear()
        self.asked_s = self.now()
        self._link.write(question)
        answers: dict[int, StatusPacket] = {}
        for _ in range(round(wait_s / _POLL_S)):
            data = self._link.read(_POLL_S)
            self._bytes += len(data)
            for answer in self._reader.take(data):
                if answer.id in ids and len(answer.parameters) == count:
                    answers[answer.id] = answer
            if len(answers) == len(ids):
                break
        self.lost += len(ids) - len(answers)
        return answers

    def _heard(self, question: bytes, wait_s: float) -> bytes:
        self._link.read(0.0)
        self._link.write(question)
        for _ in range(round(wait_s / _POLL_S)):
            if data := self._link.read(_POLL_S):
                self._bytes += len(data)
                return data + self._link.read(2 * _POLL_S)
        return b""

    def _explain(self, silent: Sequence[int]) -> NoReturn:
        """Raise what is wrong where these ids did not answer whole."""
        self.wait(_WAITS_S[-1])
        found = {id: self._quality(id, _WAITS_S[-1 if id in silent else 0]) for id in LOOKED_FOR}
        answering = [id for id, whole in found.items() if whole]
        broken = [id for id, whole in found.items() if whole is False]
        if not answering and self._bytes:
            raise DeviceError(
                f"{self.name}: bytes come, but no whole answer: is {self.baud} the servos' baud rate, is the wire sound,"
                " and is this a bus of STS3215 servos?"
            )
        if not answering:
            raise DeviceError(
                f"{self.name}: no servo answers: is their own power supply on, is it the right port, and are they set to"
                f" {self.baud} baud?"
            )
        there = f"found {_listed(answering)}"
        if broken:
            lacking = (
                f" and none answers as {_listed(gone)}" if (gone := [s for s in silent if s not in broken]) else ""
            )
            raise DeviceError(
                f"{self.name}: answers of id {_listed(broken)} collide{lacking}: two servos share an id; connect one"
                f" servo at a time and give each its own ({there})"
            )
        if lost := [id for id in silent if id not in answering]:
            raise DeviceError(
                f"{self.name}: no servo answers as id {_listed(lost)} ({there}): is its cable plugged in, and its id set?"
            )
        raise DeviceError(
            f"{self.name}: id {_listed(silent)} answers now and then only: is a plug loose, the wire disturbed, or this"
            " computer too busy?"
        )

    def _quality(self, id: int, wait_s: float) -> bool | None:
        """Return True where an id gives a whole answer, False where only broken ones, None where none."""
        question = packet(id, Instruction.READ, bytes((POSITION.address, STATE_BYTES)))
        heard = False
        for _ in _WAITS_S:
            data = self._heard(question, wait_s)
            if not data:
                if not heard:
                    return None
                continue
            heard = True
            answers = [each for each in PacketReader().take(data) if each.id == id]
            if len(answers) == 1 and len(answers[0].parameters) == STATE_BYTES:
                return True
        return False


def _listed(ids: Sequence[int]) -> str:
    return ", ".join(map(str, ids))
