"""A workshop in the evening: an arm whose plugs somebody pushed in, and that somebody's hand and answers.

In: a :class:`~armsight.sim.joints.JointPlant` and how it is wired. Out: a plant for an emulated board, whose motors may be
swapped, dead or the wrong way round and potentiometers swapped, open, bent or worn; and a person who moves joints by hand,
reads a protractor, and, asked to, pushes the plugs in rightly (:class:`WorkshopPerson`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from armsight.data import Array
from armsight.robot.boards.codes import SensorKind
from armsight.robot.boards.link import Sensed
from armsight.sim.encoders import EncodedPlant, Encoders
from armsight.sim.joints import JOINTS, JointModel, JointPlant, drawn_model

_IN_ORDER = tuple(range(JOINTS))
_OPEN_COUNTS = 65535
#: Angles a hand holds joints at, and how fast it moves them there.
MARKS_DEG = (-137.0, -70.0, 0.0, 70.0, 137.0)
_HAND_RAD_S, _HOLD_S = 1.2, 0.25
_PROTRACTOR_RAD = 0.003
_SETTLE_S = 0.6


@dataclass(frozen=True)
class Wiring:
    """How an arm is wired; joints are counted from 0."""

    motors: tuple[int, ...] = _IN_ORDER  #: (6,) which joint the motor output of each joint drives
    potentiometers: tuple[int, ...] = _IN_ORDER  #: (6,) which joint the potentiometer input of each joint reads
    motor_signs: tuple[int, ...] = (1,) * JOINTS  #: (6,) 1 or -1
    potentiometer_signs: tuple[int, ...] = (1,) * JOINTS  #: (6,) 1, or -1 where counts fall with the angle
    dead_motors: frozenset[int] = frozenset()  #: motor outputs without a motor
    open_potentiometers: frozenset[int] = frozenset()  #: inputs whose wiper has no contact
    #: a joint, and from which to which angle, rad, its wiper has no contact; None without
    dead_spot: tuple[int, float, float] | None = None

    def mended(self) -> Wiring:
        """Return the wiring with all plugs where they belong; signs are no mistake."""
        return Wiring(motor_signs=self.motor_signs, potentiometer_signs=self.potentiometer_signs)


def swapped(first: int, second: int) -> tuple[int, ...]:
    """Return six joints in order, but for two that are swapped."""
    order = list(_IN_ORDER)
    order[first], order[second] = second, first
    return tuple(order)


class WorkshopPlant:
    """A wired arm behind the contract :class:`~armsight.robot.boards.link.Plant`, with a hand on it.

    ``wiring`` may be changed at any time; ``bend_counts`` (6,): by how much a potentiometer is off a straight line at most;
    joints with ``encoders`` are wired rightly. ``load_n_m`` (6,): beside gravity and the hand, which brings a joint to an
    angle, rad, by ``hold``. ``drives_s``: for how long the drives were on, ``far_rad`` (6,): how far the joints went since.
    """

    def __init__(
        self, plant: JointPlant, wiring: Wiring, bend_counts: Array | None = None, encoders: Encoders | None = None
    ) -> None:
        self.plant, self.wiring = plant, wiring
        self.encoded = None if encoders is None else EncodedPlant(plant, encoders)
        self._encoded = [] if encoders is None else np.flatnonzero(encoders.kind).tolist()
        self._bend = np.zeros(JOINTS) if bend_counts is None else bend_counts
        self.load_n_m = np.zeros(JOINTS)
        self._target = 0.0
        self.t_s = self.drives_s = 0.0
        self.far_rad = np.zeros(JOINTS)
        self._from_rad = plant.link.copy()
        self.hold: tuple[int, float] | None = None

    def bent(self, counts: Array) -> Array:
        """Return counts (6,) of straight potentiometers as the bent ones read them."""
        return np.asarray(counts + self._bend * np.sin(2 * np.pi * counts / 65536.0))

    def sense(self) -> Sensed:
        """Return what the converters read now."""
        sensed, wiring = self.plant.sense(), self.wiring
        true = self.bent(sensed.counts.astype(float))
        counts = np.clip(np.where(np.array(wiring.potentiometer_signs) > 0, true, 65535.0 - true), 0, 65535)
        if wiring.dead_spot is not None:
            joint, low, high = wiring.dead_spot
            if low <= self.plant.link[joint] <= high:
                counts[joint] = _OPEN_COUNTS
        counts = counts[list(wiring.potentiometers)]
        counts[list(wiring.open_potentiometers)] = _OPEN_COUNTS
        for joint in self._encoded:
            counts[joint] = self.encoded.reading(joint) if self.encoded else 0
        current = (sensed.current_ma * np.array(wiring.motor_signs))[list(wiring.motors)]
        current[list(wiring.dead_motors)] = 0
        return sensed._replace(counts=counts.astype(np.uint32), current_ma=current.astype(np.int32))

    def step(self, duty: Array, awake: bool, braked: bool = False) -> None:
        """Let 1 ms pass with these duties (6,)."""
        joints = np.zeros(JOINTS)
        for output, joint in enumerate(self.wiring.motors):
            if output not in self.wiring.dead_motors:
                joints[joint] = self.wiring.motor_signs[joint] * float(duty[output])
        self._push()
        self.plant.step(joints, awake, braked)
        self.t_s += 1e-3
        if np.any(np.asarray(duty) != 0):
            self.drives_s += 1e-3
            self.far_rad = np.maximum(self.far_rad, np.abs(self.plant.link - self._from_rad))

    def mark(self) -> None:
        """Count ``far_rad`` from here."""
        self._from_rad, self.far_rad = self.plant.link.copy(), np.zeros(JOINTS)

    def _push(self) -> None:
        """Let the hand push its joint to where it brings it, at its own speed."""
        self.plant.hand_n_m[:] = self.load_n_m
        if self.hold is None:
            self._target = np.nan
            return
        joint, goal = self.hold
        if np.isnan(self._target):
            self._target = self._felt(joint)
        self._target += float(np.clip(goal - self._target, -_HAND_RAD_S * 1e-3, _HAND_RAD_S * 1e-3))
        if self.plant.transmission.stiffness_n_m[joint] > 0:  # the hand moves the link, the motor is dragged along
            self.plant.put_link(joint, self._target)
            return
        pull = 400.0 * (self._target - self.plant.q[joint]) - 8.0 * self.plant.qd[joint]
        self.plant.hand_n_m[joint] += float(np.clip(pull, -25.0, 25.0))

    def _felt(self, joint: int) -> float:
        """Return where the hand feels a joint: behind its spring, where it has one."""
        elastic = self.plant.transmission.stiffness_n_m[joint] > 0
        return float(self.plant.link[joint] if elastic else self.plant.q[joint])

    @property
    def arrived(self) -> bool:
        """Whether the hand has its joint where it brings it."""
        return self.hold is not None and abs(self._felt(self.hold[0]) - self.hold[1]) < 0.02 + _PROTRACTOR_RAD


def drawn_wiring(seed: int) -> Wiring:
    """Return a wiring with signs as they happen to come."""
    motors, pots = np.random.default_rng([seed, 21]).choice((-1, 1), (2, JOINTS))
    return Wiring(motor_signs=tuple(map(int, motors)), potentiometer_signs=tuple(map(int, pots)))


def drawn_workshop(seed: int, *, encoders: Encoders | None = None) -> tuple[WorkshopPlant, JointModel]:
    """Return an arm as it hangs on its evening, and what it is made of."""
    rng = np.random.default_rng([seed, 22])
    model = drawn_model(seed)
    plant = JointPlant(-np.sign(model.gravity_n_m) * np.pi / 2, seed=seed, model=model)
    return WorkshopPlant(plant, drawn_wiring(seed), rng.uniform(0, 100, JOINTS), encoders), model


def drawn_encoders(seed: int, kinds: Mapping[int, SensorKind]) -> Encoders | None:
    """Return encoders for these joints as they happen to come: lines, direction and zero; None without any."""
    if not kinds:
        return None
    rng = np.random.default_rng([seed, 24])
    kind = np.array([kinds.get(j, SensorKind.POTENTIOMETER) for j in range(JOINTS)])
    lines, sign = rng.integers(4000, 50000, JOINTS), rng.choice((-1, 1), JOINTS)
    per_rev = sign * np.where(kind == SensorKind.ABSOLUTE, 16384, lines)
    return Encoders(kind, per_rev.astype(float), rng.integers(0, 16384, JOINTS))


class WorkshopPerson:
    """Answers the questions of a bring-up at a :class:`WorkshopPlant`, with readings of a protractor drawn by a seed.

    ``mends``: plugs are pushed in rightly when a problem is named, else a step is skipped; ``say`` is called with every
    line, ``problems`` are all that were named.
    """

    def __init__(
        self, workshop: WorkshopPlant, *, seed: int = 1, mends: bool = True, say: Callable[[str], None] | None = None
    ) -> None:
        self._workshop, self._mends, self._say = workshop, mends, say
        self._rng = np.random.default_rng([seed, 23])
        self._kind, self._joint, self._since_s = "", 0, 0.0
        self._marks: list[float] = []
        self._marked, self._rest_rad, self._returns = -1, 0.0, False
        self._tried: set[str] = set()
        self.problems: list[str] = []

    def say(self, line: str) -> None:
        """Hear a line."""
        if self._say is not None:
            self._say(line)

    def ask(self, kind: str, joint: int | None, text: str) -> None:
        """Hear a question; :meth:`answer` answers it in time."""
        workshop = self._workshop
        if kind == "mark":
            if self._marked != joint:
                self._marked, self._marks = joint or 0, list(np.radians(MARKS_DEG))
                self._rest_rad = float(workshop.plant.link[self._marked])
                if self._rest_rad > 0:
                    self._marks.reverse()
            workshop.hold = (self._marked, self._marks.pop(0) if self._marks else self._rest_rad)
            self._returns = workshop.hold[1] == self._rest_rad
        if kind == "problem":
            self.problems.append(text)
            self.say(text)
        self._kind, self._joint, self._since_s, self._text = kind, joint or 0, workshop.t_s, text

    def answer(self) -> str | None:
        """Return the answer, or None while it is not known yet."""
        workshop = self._workshop
        if self._kind == "mark":
            return self._mark()
        if self._kind == "angle":
            return f"{np.degrees(workshop.plant.link[self._joint] + self._rng.normal(0, _PROTRACTOR_RAD)):.1f}"
        if self._kind == "problem":
            first = self._text not in self._tried
            self._tried.add(self._text)
            if self._mends and first:
                workshop.wiring = workshop.wiring.mended()
                return "r"
            return "s"
        return "y" if self._kind == "yes" else ""

    def _mark(self) -> str | None:
        workshop = self._workshop
        if workshop.hold is None:
            return "" if workshop.t_s - self._since_s > _SETTLE_S else None
        if not workshop.arrived:
            self._since_s = workshop.t_s
        elif self._returns:
            workshop.hold, self._marked = None, -1
            return None
        if workshop.t_s - self._since_s < _HOLD_S:
            return None
        angle = workshop.plant.link[workshop.hold[0]] + self._rng.normal(0, _PROTRACTOR_RAD)
        return f"{np.degrees(angle):.1f}"
