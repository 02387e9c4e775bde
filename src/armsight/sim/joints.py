"""Six joints, each a DC motor with a gear and a potentiometer under gravity: an arm a board can drive without a table.

In: duties. Out: counts, currents and the supply, as the board's converters read them. The motor (its inductance left
out, its time constant being far below a millisecond) drives the joint with the torque ``K (u V - K w) / R``; against it
stand gravity, viscous and dry friction, the acceleration of the joint before it, a hand that pushes and, at the end stops,
the stop itself. K is the motor's constant times the gear's ratio, V s/rad and N m/A at once. The potentiometer sits
behind the gear's backlash. Each millisecond is four backward Euler steps, with dry friction solved in the step itself, so
that a joint at rest rests. Nothing but + - * / is used, so that every computer computes the same motion.

What a joint is made of is a :class:`JointModel`; :func:`drawn_model` draws one that is not as its data sheet says.
What lies between motor and joint is a :class:`Transmission`: rigid and even, or a spring (two masses, the
potentiometer on the joint's side) and an eccentric drum; spring and joint are then integrated by symplectic Euler.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.kernels import kernel
from armsight.robot.boards.link import TICK_S, Sensed

JOINTS = 6
_SUBSTEPS = 4
#: One joint of a small arm on 12 V: 5 rad/s at full duty, 30 ms to get there, 2 A and 4.8 N m when held.
RESISTANCE_OHM, CONSTANT_V_S, SUPPLY_V = 6.0, 2.4, 12.0
INERTIA_KG_M2, VISCOUS_N_M_S, DRY_N_M = 0.03, 0.02, 0.2
STALL_N_M = CONSTANT_V_S * SUPPLY_V / RESISTANCE_OHM
STOP_RAD = 2.55
#: Potentiometers: counts at 0 rad and per rad (the factory's table), noise, and the converter's step.
ZERO_COUNTS, COUNTS_PER_RAD = 32767.5, (62258 - 3277) / 5.2
NOISE_COUNTS, STEP_COUNTS = 4.0, 4


class PotFault(IntEnum):
    """What can be wrong with a potentiometer or its motor's leads; ``size`` is that of :meth:`JointPlant.break_pot`."""

    NONE = 0
    OPEN = 1
    SHORT = 2
    #: The converter's reading stands still, to the count.
    FROZEN = 3
    #: The reading is off by ``size`` rad at once.
    JUMP = 4
    INVERTED = 5
    #: The wiper stands still; the converter's noise goes on.
    STUCK = 6
    #: The shaft slips: the wiper goes half the way until it is ``size`` rad behind, and goes along from there on.
    SLIP = 7
    #: The reading drifts by ``size`` rad/s.
    DRIFT = 8
    #: The reading moves ``size`` times as far as the joint.
    SCALED = 9
    #: The reading follows with a time constant of ``size`` s.
    LAG = 10


_USUAL_SIZE = {PotFault.JUMP: 0.35, PotFault.SLIP: 0.3, PotFault.DRIFT: 0.36, PotFault.SCALED: 0.5, PotFault.LAG: 0.2}


@dataclass(frozen=True, eq=False)
class JointModel(Record):
    """What six joints are made of."""

    resistance_ohm: Array  #: (6,) of the windings
    constant_v_s: Array  #: (6,) motor constants at the joint, V s/rad and N m/A
    inertia_kg_m2: Array  #: (6,) at the joint
    viscous_n_m_s: Array  #: (6,) friction that grows with speed, N m s/rad
    dry_n_m: Array  #: (6,) dry friction, N m
    gravity_n_m: Array  #: (6,) gravity's torque at 0 rad, N m; it falls with the angle's cosine
    backlash_rad: Array  #: (6,) between the motor and the joint with its potentiometer, from stop to stop
    coupling: Array  #: (6,) share of a joint's inertia that the acceleration of the joint before it acts on
    noise_counts: Array  #: (6,) standard deviation of a reading
    current_noise_ma: Array  #: (6,) standard deviation of a current's reading
    current_gain: Array  #: (6,) a current's reading over the current
    brake_n_m: Array  #: (6,) what a closed brake holds, N m; 0 where there is none

    def packed(self) -> Array:
        """Return all attributes as rows (12, 6)."""
        return np.array([getattr(self, name) for name in self.__dataclass_fields__])


def plain_model() -> JointModel:
    """Return the joints of the data sheet: no load, no backlash."""
    rows = (RESISTANCE_OHM, CONSTANT_V_S, INERTIA_KG_M2, VISCOUS_N_M_S, DRY_N_M, 0, 0, 0, NOISE_COUNTS, 0, 1, 0)
    return JointModel(*(np.full(JOINTS, float(value)) for value in rows))


def drawn_model(seed: int, *, load: float = 0.6, inertia: float = 6.0, spread: float = 0.15) -> JointModel:
    """Return joints as they come out of a workshop.

    ``load``: greatest gravity load with payload, of the stall torque, either way. ``inertia``: greatest inertia, of the
    data sheet's; the least is half of it. ``spread``: how far resistance and motor constant are off the data sheet, at
    most.
    """
    rng = np.random.default_rng([seed, 20])
    off = rng.uniform(1 - spread, 1 + spread, (2, JOINTS))
    return JointModel(
        resistance_ohm=RESISTANCE_OHM * off[0],
        constant_v_s=CONSTANT_V_S * off[1],
        inertia_kg_m2=INERTIA_KG_M2 * 0.5 * (2 * inertia) ** rng.uniform(0, 1, JOINTS),
        viscous_n_m_s=VISCOUS_N_M_S * rng.uniform(0.5, 2, JOINTS),
        dry_n_m=DRY_N_M * rng.uniform(0.5, 1.5, JOINTS),
        gravity_n_m=load * STALL_N_M * rng.uniform(-1, 1, JOINTS),
        backlash_rad=rng.uniform(0, 0.01, JOINTS),
        coupling=rng.uniform(0, 0.2, JOINTS),
        noise_counts=rng.uniform(3, 20, JOINTS),
        current_noise_ma=rng.uniform(5, 30, JOINTS),
        current_gain=rng.uniform(0.97, 1.03, JOINTS),
        brake_n_m=np.zeros(JOINTS),
    )


@dataclass(frozen=True, eq=False)
class Transmission(Record):
    """What lies between the motors of six joints and what they drive."""

    stiffness_n_m: Array  #: (6,) of the spring between them, N m/rad, where the joint is at 0 rad; 0: rigid
    damping_n_m_s: Array  #: (6,) of the spring, N m s/rad
    link_share: Array  #: (6,) share of the joint's inertia behind the spring
    pose_share: Array  #: (6,) by which share the stiffness is greater at 1 rad; it changes linearly with the angle
    back_share: Array  #: (6,) stiffness while the joint is ahead of the motor, over that while it is behind
    drum_rad: Array  #: (6,) amplitude by which an eccentric drum leads the joint before and behind the motor
    drum_per_rev: Array  #: (6,) how often it does so in a revolution of the motor, gear included
    drum_phase: Array  #: (6,) its phase at 0 rad, of a cycle

    def packed(self) -> Array:
        """Return all attributes as rows (8, 6)."""
        return np.array([getattr(self, name) for name in self.__dataclass_fields__])


def plain_transmission(**rows: float | Array) -> Transmission:
    """Return a rigid and even one, but for the attributes that are given, for all joints or (6,)."""
    names = Transmission.__dataclass_fields__
    usual = dict.fromkeys(names, 0.0) | {"link_share": 0.5, "back_share": 1.0, "drum_per_rev": 1.0}
    return Transmission(**{name: np.full(JOINTS, 0.0) + rows.get(name, usual[name]) for name in names})


def sprung(model: JointModel, resonance_hz: Array, damping: Array, link_share: Array) -> dict[str, Array]:
    """Return stiffness, damping and link share (6,) of joints that resonate so while both masses are free.

    ``damping`` (6,): of the resonance, of critical, by the spring alone; ``link_share`` (6,): of the inertia behind it.
    """
    w = 2 * np.pi * resonance_hz
    reduced = model.inertia_kg_m2 * link_share * (1 - link_share)
    return {
        "stiffness_n_m": reduced * w * w,
        "damping_n_m_s": 2 * damping * reduced * w,
        "link_share": np.asarray(link_share),
    }


@kernel
def _sine(cycles: float) -> float:
    cycles -= np.floor(cycles + 0.5)
    cycles = 0.5 - cycles if cycles > 0.25 else (-0.5 - cycles if cycles < -0.25 else cycles)
    a = 6.283185307179586 * cycles
    x = a * a
    return a * (1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110 * (1 - x / 156))))))


@kernel
def _spring(q: float, qd: float, link: float, linkd: float, between: Array, half: float) -> tuple[float, float]:
    """Return the drum's ratio at a motor's angle, and the torque, N m, by which its spring pulls what it drives."""
    cycles = between[6] / 6.283185307179586 * q + between[7]
    ratio = 1 + between[5] * between[6] * _sine(cycles + 0.25)
    twist = q + between[5] * _sine(cycles) - link
    twist = twist - half if twist > half else (twist + half if twist < -half else 0.0)
    stiff = between[0] * (1 + between[3] * link) * (between[4] if twist < 0 else 1.0)
    damped = between[1] * (ratio * qd - linkd) if twist != 0 or half == 0 else 0.0
    return ratio, stiff * twist + damped


@kernel(
    "f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8[::1], b1, b1, f8, b1[::1]"
)
def _move(
    q: Array,
    qd: Array,
    link: Array,
    linkd: Array,
    qdd: Array,
    model: Array,
    between: Array,
    hand: Array,
    duty: Array,
    stuck: Array,
    awake: bool,
    braked: bool,
    supply_v: float,
    blocked: NDArray[np.bool_],
) -> None:
    """Move the joints by one tick, in-place: motors q, qd, qdd (6,) rad, rad/s, rad/s^2; what they drive, link, linkd."""
    h = TICK_S / _SUBSTEPS
    before = 0.0
    for i in range(JOINTS):
        own, constant = model[2, i], model[1, i]
        conductance = constant / model[0, i] if awake else 0.0
        dry = model[4, i] + (model[11, i] if braked else 0.0)
        stiffness, half = between[0, i], 0.5 * model[6, i]
        mass = own if stiffness == 0 else own * (1 - between[2, i])
        inertia = mass + h * (model[3, i] + conductance * constant)
        grip = h * dry / inertia
        x = link[i] * link[i]
        cosine = 1 - x / 2 * (1 - x / 12 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90))))
        load = hand[i] - model[5, i] * cosine - model[7, i] * own * before
        share = duty[i] if stuck[i] == 0.0 else stuck[i]
        push = h * (conductance * share * supply_v + (load if stiffness == 0 else 0.0))
        start, drum, cycles_per_rad = qd[i], between[5, i], between[6, i] / 6.283185307179586
        for _ in range(_SUBSTEPS):
            torque = 0.0
            if stiffness > 0:
                ratio, pull = _spring(q[i], qd[i], link[i], linkd[i], between[:, i], half)
                torque = ratio * pull
                linkd[i] = 0.0 if blocked[i] else linkd[i] + h * (pull + load) / (own - mass)
                link[i] += h * linkd[i]
                if abs(link[i]) >= STOP_RAD:
                    link[i] = STOP_RAD if link[i] > 0 else -STOP_RAD
                    linkd[i] = 0.0
            free = (mass * qd[i] + push - h * torque) / inertia
            qd[i] = 0.0 if blocked[i] or abs(free) <= grip else (free - grip if free > 0 else free + grip)
            q[i] += h * qd[i]
            if stiffness == 0 and abs(q[i]) >= STOP_RAD:
                q[i] = STOP_RAD if q[i] > 0 else -STOP_RAD
                qd[i] = 0.0
        before = qdd[i]
        qdd[i] = (qd[i] - start) / TICK_S
        if stiffness == 0:
            led = q[i] + drum * _sine(cycles_per_rad * q[i] + between[7, i])
            link[i] = min(max(link[i], led - half), led + half)


@kernel
def _normal(s: np.uint64) -> tuple[np.uint64, float]:
    """Return the next state of a xorshift generator and a nearly normal number: the sum of four uniform ones."""
    total = np.int64(0)
    for _ in range(4):
        s ^= s << np.uint64(13)
        s ^= s >> np.uint64(7)
        s ^= s << np.uint64(17)
        total += np.int64((s >> np.uint64(40)) & np.uint64(0xFFFF)) - 32768
    # Four uniform numbers of +-32768 have a standard deviation of 32768 sqrt(4/3).
    return s, total / 37837.2


@kernel("f8[::1], f8[::1], f8[::1], f8[:, ::1], u8[::1], i8[::1], f8[:, ::1], u4[::1], i4[::1]")
def _read(
    link: Array,
    current_a: Array,
    offset_a: Array,
    model: Array,
    noise: NDArray[np.uint64],
    fault: NDArray[np.int64],
    broken: Array,
    counts: NDArray[np.uint32],
    current_ma: NDArray[np.int32],
) -> None:
    """Write what the converters read into ``counts`` and ``current_ma`` (6,).

    ``noise`` (6,) are generators' states; ``broken`` (3, 6): true counts when a potentiometer broke, the fault's size in
    counts (a factor, ticks for some), and what it remembers.
    """
    for i in range(JOINTS):
        s, normal = _normal(noise[i])
        true = ZERO_COUNTS + COUNTS_PER_RAD * link[i]
        kind, kept, size = fault[i], broken[0, i], broken[1, i]
        if kind == 4:
            true += size
        elif kind == 5:
            true = 2 * kept - true
        elif kind == 6:
            true = kept
        elif kind == 7:
            true -= min(max(0.5 * (true - kept), -size), size)
        elif kind == 8:
            broken[2, i] += size * TICK_S
            true += broken[2, i]
        elif kind == 9:
            true = kept + size * (true - kept)
        elif kind == 10:
            broken[2, i] += (true - broken[2, i]) / size
            true = broken[2, i]
        reading = np.int64(np.floor((true + model[8, i] * normal) / STEP_COUNTS)) * STEP_COUNTS
        if kind == 1:
            reading = np.int64(65535)
        elif kind == 2:
            reading = np.int64(0)
        elif kind == 3:
            reading = np.int64(counts[i])
        counts[i] = np.uint32(0 if reading < 0 else 65535 if reading > 65535 else reading)
        noise[i], normal = _normal(s)
        seen_a = model[10, i] * current_a[i] + offset_a[i]
        current_ma[i] = np.int32(np.floor(1e3 * seen_a + model[9, i] * normal + 0.5))


class JointPlant:
    """Six joints behind the contract :class:`~armsight.robot.boards.link.Plant`; what breaks on them is set here.

    Args:
        q: (6,) where the joints are at first, rad.
        seed: of the converters' noise.
        model: what they are made of; the data sheet's without.
        transmission: what lies between motors and joints; rigid and even without.

    Attributes:
        q: (6,) true angles of the motors, rad, at the joint.
        qd: (6,) their speeds, rad/s.
        link: (6,) true angles of the joints, rad: the motors' but for backlash, twist and drum.
        stuck: (6,) share of the supply, -1 to 1, that a broken bridge puts out while it is awake, whatever its duty; 0
            where it is sound.
        offset_a: (6,) offset of the current's sensor, A.
    """

    def __init__(
        self,
        q: Array | None = None,
        *,
        seed: int = 1,
        model: JointModel | None = None,
        transmission: Transmission | None = None,
    ) -> None:
        start = np.zeros(JOINTS) if q is None else np.array(q, dtype=float)
        if start.shape != (JOINTS,) or not (np.abs(start) <= STOP_RAD).all():
            raise InputError(f"q must be six angles within the stops at +-{STOP_RAD} rad; {start} was given")
        self.q, self.qd, self.link = start, np.zeros(JOINTS), start.copy()
        self.model = plain_model() if model is None else model
        self._model = self.model.packed()
        self.transmission = plain_transmission() if transmission is None else transmission
        self._between, self._linkd = self.transmission.packed(), np.zeros(JOINTS)
        self.meet()
        self.hand_n_m = np.zeros(JOINTS)  #: (6,) torque with which a hand pushes, N m
        self.supply_mv = round(1e3 * SUPPLY_V)  #: motor supply, mV
        self.stop_pressed = False  #: whether the emergency stop is pressed
        self.blocked = np.zeros(JOINTS, dtype=bool)  #: (6,) joints that something holds fast
        self.stuck, self.offset_a = np.zeros(JOINTS), np.zeros(JOINTS)
        self._qdd, self._current_a = np.zeros(JOINTS), np.zeros(JOINTS)
        self._noise = np.random.default_rng(seed).integers(1, 1 << 63, JOINTS, dtype=np.uint64)
        self._fault, self._broken = np.zeros(JOINTS, np.int64), np.zeros((3, JOINTS))
        self._counts, self._current_ma = np.zeros(JOINTS, np.uint32), np.zeros(JOINTS, np.int32)

    def meet(self) -> None:
        """Put the motors where even drums have the joints (what a drum leads by is found by iteration), at rest."""
        between = self.transmission
        for _ in range(60):
            cycles = between.drum_per_rev * self.q / (2 * np.pi) + between.drum_phase
            self.q[:] = self.link - between.drum_rad * np.sin(2 * np.pi * cycles)
        self.qd[:] = self._linkd[:] = 0.0

    def put_link(self, joint: int, angle_rad: float) -> None:
        """Put what an elastic joint drives to an angle, rad, at rest, as a firm hand does."""
        self.link[joint], self._linkd[joint] = angle_rad, 0.0

    def break_pot(self, joint: int, fault: PotFault, size: float | None = None) -> None:
        """Break a joint's (0 to 5) potentiometer from its next reading on; :attr:`PotFault.NONE` repairs it.

        ``size``: how much, as :class:`PotFault` says; a usual one without.
        """
        given = _USUAL_SIZE.get(fault, 0.0) if size is None else size
        unit = {PotFault.SCALED: 1.0, PotFault.LAG: 1 / TICK_S}.get(fault, COUNTS_PER_RAD)
        true = ZERO_COUNTS + COUNTS_PER_RAD * self.link[joint]
        if fault == PotFault.JUMP and size is None and true > ZERO_COUNTS:
            unit = -unit  # towards the middle, where there is room
        self._fault[joint] = fault
        self._broken[:, joint] = true, given * unit, true if fault == PotFault.LAG else 0.0

    def sense(self) -> Sensed:
        """Return what the converters read now."""
        _read(
            self.link,
            self._current_a,
            self.offset_a,
            self._model,
            self._noise,
            self._fault,
            self._broken,
            self._counts,
            self._current_ma,
        )
        return Sensed(self._counts.copy(), self._current_ma.copy(), self.supply_mv, self.stop_pressed)

    def step(self, duty: Array, awake: bool, braked: bool = False) -> None:
        """Let 1 ms pass with these duties (6,)."""
        supply_v = self.supply_mv * 1e-3
        duty = np.asarray(duty, dtype=float)
        state = (self.q, self.qd, self.link, self._linkd, self._qdd)
        given = (self._model, self._between, self.hand_n_m, duty, self.stuck)
        _move(*state, *given, awake, braked, supply_v, self.blocked)
        if awake:
            duty = np.where(self.stuck != 0.0, self.stuck, duty)
            self._current_a[:] = (duty * supply_v - self._model[1] * self.qd) / self._model[0]
        else:
            self._current_a[:] = 0
