"""Six independent joints, each a DC motor with a gear and a potentiometer: the simplest arm a board can drive.

In: duties. Out: counts, currents and the supply, as the board's converters read them. The motor (its inductance left
out, its time constant being far below a millisecond) drives the joint with the torque ``K (u V - K w) / R``; against it
stand viscous and dry friction and, at the end stops, the stop itself. K is the motor's constant times the gear's ratio,
V s/rad and N m/A at once. Each millisecond is four backward Euler steps, with dry friction solved in the step itself, so
that a joint at rest rests. Nothing but + - * / is used, so that every computer computes the same motion.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.errors import InputError
from armsight.kernels import kernel
from armsight.robot.boards.link import Sensed

JOINTS = 6
_SUBSTEPS = 4
_TICK_S = 0.001
#: One joint of a small arm on 12 V: 5 rad/s at full duty, 30 ms to get there, 2 A and 4.8 N m when held.
RESISTANCE_OHM, CONSTANT_V_S = 6.0, 2.4
INERTIA_KG_M2, VISCOUS_N_M_S, DRY_N_M = 0.03, 0.02, 0.2
STOP_RAD = 2.55
#: Potentiometers: counts at 0 rad and per rad (the factory's table), noise, and the converter's step.
ZERO_COUNTS, COUNTS_PER_RAD = 32767.5, (62258 - 3277) / 5.2
NOISE_COUNTS, STEP_COUNTS = 4.0, 4


class PotFault(IntEnum):
    """What can be wrong with a potentiometer or its motor's leads."""

    NONE = 0
    OPEN = 1
    SHORT = 2
    FROZEN = 3
    JUMP = 4
    INVERTED = 5


#: How far a jumping potentiometer jumps: 0.35 rad.
_JUMP_COUNTS = 4000


@kernel("f8[::1], f8[::1], f8[::1], b1, f8, b1[::1]")
def _move(q: Array, qd: Array, duty: Array, drives_on: bool, supply_v: float, blocked: NDArray[np.bool_]) -> None:
    """Move the joints by one tick, in-place: q, qd (6,) rad, rad/s."""
    h = _TICK_S / _SUBSTEPS
    conductance = CONSTANT_V_S / RESISTANCE_OHM if drives_on else 0.0
    inertia = INERTIA_KG_M2 + h * (VISCOUS_N_M_S + conductance * CONSTANT_V_S)
    grip = h * DRY_N_M / inertia
    for i in range(JOINTS):
        push = h * conductance * duty[i] * supply_v
        for _ in range(_SUBSTEPS):
            free = (INERTIA_KG_M2 * qd[i] + push) / inertia
            qd[i] = 0.0 if blocked[i] or abs(free) <= grip else (free - grip if free > 0 else free + grip)
            q[i] += h * qd[i]
            if abs(q[i]) >= STOP_RAD:
                q[i] = STOP_RAD if q[i] > 0 else -STOP_RAD
                qd[i] = 0.0


@kernel("f8[::1], u8[::1], i8[::1], i8[::1], u4[::1]")
def _read(
    q: Array, noise: NDArray[np.uint64], fault: NDArray[np.int64], kept: NDArray[np.int64], counts: NDArray[np.uint32]
) -> None:
    """Write what the converters read into ``counts`` (6,); ``noise`` (6,) are the states of xorshift generators."""
    for i in range(JOINTS):
        total = np.int64(0)
        for _ in range(4):  # the sum of four uniform numbers is near enough to a normal one
            s = noise[i]
            s ^= s << np.uint64(13)
            s ^= s >> np.uint64(7)
            s ^= s << np.uint64(17)
            noise[i] = s
            total += np.int64((s >> np.uint64(40)) & np.uint64(0xFFFF)) - 32768
        # Four uniform numbers of +-32768 have a standard deviation of 32768 sqrt(4/3).
        true = ZERO_COUNTS + COUNTS_PER_RAD * q[i] + NOISE_COUNTS * total / 37837.2
        reading = np.int64(np.floor(true / STEP_COUNTS)) * STEP_COUNTS
        if fault[i] == 1:
            reading = np.int64(65535)
        elif fault[i] == 2:
            reading = np.int64(0)
        elif fault[i] == 3:
            reading = kept[i]
        elif fault[i] == 4:
            reading += _JUMP_COUNTS if kept[i] < 32768 else -_JUMP_COUNTS
        elif fault[i] == 5:
            reading = 2 * kept[i] - reading
        counts[i] = np.uint32(0 if reading < 0 else 65535 if reading > 65535 else reading)


class JointPlant:
    """Six joints behind the contract :class:`~armsight.robot.boards.link.Plant`; what breaks on them is set here.

    Args:
        q: (6,) where the joints are at first, rad.
        seed: of the potentiometers' noise.

    Attributes:
        q: (6,) true angles, rad.
        qd: (6,) true speeds, rad/s.
        supply_mv: motor supply, mV.
        stop_pressed: whether the emergency stop is pressed.
        blocked: (6,) joints that something holds fast.
    """

    def __init__(self, q: Array | None = None, *, seed: int = 1) -> None:
        start = np.zeros(JOINTS) if q is None else np.array(q, dtype=float)
        if start.shape != (JOINTS,) or not (np.abs(start) <= STOP_RAD).all():
            raise InputError(f"q must be six angles within the stops at +-{STOP_RAD} rad; {start} was given")
        self.q, self.qd = start, np.zeros(JOINTS)
        self.supply_mv = 12000
        self.stop_pressed = False
        self.blocked = np.zeros(JOINTS, dtype=bool)
        self._noise = np.random.default_rng(seed).integers(1, 1 << 63, JOINTS, dtype=np.uint64)
        self._fault, self._kept = np.zeros(JOINTS, np.int64), np.zeros(JOINTS, np.int64)
        self._counts, self._current_ma = np.zeros(JOINTS, np.uint32), np.zeros(JOINTS, np.uint32)

    def break_pot(self, joint: int, fault: PotFault) -> None:
        """Break a potentiometer (0 to 5) from its next reading on; :attr:`PotFault.NONE` repairs it."""
        self._fault[joint], self._kept[joint] = fault, self._counts[joint]

    def sense(self) -> Sensed:
        """Return what the converters read now."""
        _read(self.q, self._noise, self._fault, self._kept, self._counts)
        return Sensed(self._counts.copy(), self._current_ma.copy(), self.supply_mv, self.stop_pressed)

    def step(self, duty: Array, drives_on: bool) -> None:
        """Let 1 ms pass with these duties (6,)."""
        supply_v = self.supply_mv * 1e-3
        duty = np.asarray(duty, dtype=float)
        _move(self.q, self.qd, duty, drives_on, supply_v, self.blocked)
        if drives_on:
            self._current_ma[:] = np.abs(duty * supply_v - CONSTANT_V_S * self.qd) * (1e3 / RESISTANCE_OHM)
        else:
            self._current_ma[:] = 0
