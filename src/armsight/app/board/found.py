"""What a bring-up found: the records of joints and board, their file, the configuration, the page."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.board.command import STEPS
from armsight.app.show.plotting import BLUE, MUTED, ORANGE, Figure, new_figure
from armsight.app.show.report import Block, Lines, Plot, Report, Section
from armsight.app.show.table import TextTable
from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_json, write_text
from armsight.robot.boards.codes import Reaction, SensorKind
from armsight.robot.boards.configuration import (
    CONFIG_VERSION,
    ENCODER_REV,
    GAINS,
    JOINTS,
    LAB_BACKLASH_RAD,
    POT_NODES,
    Configuration,
    lab_configuration,
)
from armsight.robot.boards.tuning import (
    GAIN_RANGES,
    Elasticity,
    MotorFigures,
    elastic_gains,
    motion_limits,
    quiet_gains,
)

_MARGIN_RAD = 0.05
#: Of an elastic joint: share of stall torque, and acceleration that twist it, rad. Half: slower, double: it rings.
_SUDDEN, _ACCELERATION_TWIST_RAD = 0.2, 0.0025
_MOST_INVERTED_RAD = 1.0
_MOST_UNEVEN = 0.5  # share of a ratio, as config.c holds it


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))


def _is_pair(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))


_POSITIVE = "resistance_ohm constant_v_s inertia_kg_m2 stiffness_n_m"
_NOT_NEGATIVE = (
    "noise_counts breakaway_duty viscous_n_m_s dry_n_m backlash_rad gravity_n_m fit_rms_v following_rms_rad "
    "spring_damping_n_m_s uneven"
)
#: What can have been found of a joint, by name; None where it was not yet.
_POSSIBLE: Mapping[str, Callable[[Any], bool]] = {
    **dict.fromkeys(_POSITIVE.split(), lambda v: _is_number(v) and v > 0),
    **dict.fromkeys(_NOT_NEGATIVE.split(), lambda v: _is_number(v) and v >= 0),
    "link_share": lambda v: _is_number(v) and 0 < v < 1,
    "motor_direction": lambda v: v in (1, -1),
    "sensor": lambda v: v in [kind.name.lower() for kind in SensorKind],
    "encoder_input": lambda v: _is_number(v) and v in range(JOINTS + 1),
    "counts_per_rev": lambda v: _is_number(v) and v != 0,
    "zero_counts": _is_number,
    "marks": lambda v: isinstance(v, list) and all(map(_is_pair, v)),
    "range_counts": lambda v: _is_pair(v) and v[0] < v[1],
}


@dataclass
class JointFound:
    """What was found of a joint; None where it was not yet."""

    noise_counts: float | None = None  #: standard deviation of its sensor at rest
    marks: list[list[float]] = field(default_factory=list)  #: pairs of counts and angle, rad
    range_counts: list[float] | None = None  #: least and greatest reading of the movement by hand
    motor_direction: int | None = None  #: 1 or -1
    breakaway_duty: float | None = None  #: from which duty on the motor moved the joint
    resistance_ohm: float | None = None  #: of the motor, with the current sensor as it reads
    constant_v_s: float | None = None  #: motor constant at the joint, V s/rad
    inertia_kg_m2: float | None = None  #: at the joint
    viscous_n_m_s: float | None = None  #: viscous friction, N m s/rad
    dry_n_m: float | None = None  #: dry friction, N m
    backlash_rad: float | None = None  #: from stop to stop
    gravity_n_m: float | None = None  #: greatest torque of gravity
    stiffness_n_m: float | None = None  #: of the spring between motor and what is read, N m/rad; None: rigid
    spring_damping_n_m_s: float | None = None  #: of that spring, N m s/rad
    link_share: float | None = None  #: share of the inertia behind that spring
    uneven: float | None = None  #: by which share the ratio of its transmission varies with the angle
    fit_rms_v: float | None = None  #: by how much the fit misses the motor's voltage
    following_rms_rad: float | None = None  #: error of the small swing, as read: the sensor's noise is in it
    sensor: str = "potentiometer"  #: what reads it: potentiometer, quadrature or absolute
    encoder_input: int = 0  #: of a quadrature encoder: which
    counts_per_rev: float | None = None  #: of its encoder; negative where counts fall with the angle
    zero_counts: float = 0.0  #: of its encoder at 0 rad; counts go on beyond where a reading wraps
    problems: list[str] = field(default_factory=list)  #: what was named, in order
    traces: dict[str, list[float]] = field(default_factory=dict)  #: lines of figures by name

    @property
    def motor(self) -> MotorFigures | None:
        """Its motor, where it was identified."""
        values = (self.resistance_ohm, self.constant_v_s, self.inertia_kg_m2, self.viscous_n_m_s, self.dry_n_m)
        return None if None in values else MotorFigures(*values)  # type: ignore[arg-type]

    @property
    def elastic(self) -> Elasticity | None:
        """Its spring, where it has one."""
        values = (self.stiffness_n_m, self.spring_damping_n_m_s, self.link_share)
        if None in values:
            return None
        opens = (self.gravity_n_m or 0.0) < 0.5 * (self.backlash_rad or 0.0) * (self.stiffness_n_m or 0.0)
        return Elasticity(*values, opens)  # type: ignore[arg-type]

    @property
    def friction_twist_rad(self) -> float:
        """How far dry friction twists its spring from one way to the other, rad."""
        return 0.0 if self.stiffness_n_m is None else 2 * (self.dry_n_m or 0.0) / self.stiffness_n_m

    @property
    def resonance_hz(self) -> float | None:
        """How fast the joint swings about its motor while that is held."""
        return None if self.elastic is None or self.motor is None else self.elastic.held_hz(self.motor.inertia_kg_m2)

    def done(self, step: str) -> bool:
        """Return whether a step has found what it looks for."""
        return getattr(self, STEPS[step], None) is not None

    def impossible(self) -> str | None:
        """Return the name of a value that cannot have been found, None where all can."""
        unknown = {each.name for each in fields(self) if each.default is None and getattr(self, each.name) is None}
        return next((n for n, holds in _POSSIBLE.items() if n not in unknown and not holds(getattr(self, n))), None)

    @property
    def kind(self) -> SensorKind:
        """What reads it."""
        return SensorKind[self.sensor.upper()]

    def fit_encoder(self) -> float:
        """Fit a line to the angles marked: counts of a revolution and zero; returns the greatest deviation, rad."""
        marks = np.array(self.marks)
        slope, offset = np.polyfit(marks[:, 1], marks[:, 0], 1)
        per_rev = float(2 * np.pi * slope)
        if self.kind == SensorKind.ABSOLUTE:
            if not 0.95 < abs(per_rev) / ENCODER_REV < 1.05:
                must = f"an absolute one must count {ENCODER_REV}. Is its magnet on the joint's own axis?"
                raise InputError(f"its encoder counts {abs(per_rev):.0f} a revolution of the joint; {must}")
            per_rev = float(np.copysign(ENCODER_REV, per_rev))
            offset = np.mean(marks[:, 0] - per_rev / (2 * np.pi) * marks[:, 1])
        self.counts_per_rev, self.zero_counts = float(round(per_rev)), float(offset)
        return float(np.abs(marks[:, 1] - self.encoder_angles(marks[:, 0])).max())

    def encoder_angles(self, counts: Array) -> Array:
        """Return joint angles (n,), rad, of an encoder's counts (n,)."""
        return np.asarray(2 * np.pi / (self.counts_per_rev or 1.0) * (counts - self.zero_counts), dtype=float)

    def pot_table(self) -> tuple[list[int], list[float], int]:
        """Return counts and angles, rad, of the potentiometer's table, and its direction; ends are extrapolated."""
        if self.counts_per_rev is not None and self.range_counts is not None:
            sign = 1 if self.counts_per_rev > 0 else -1
            ends = self.encoder_angles(np.array(self.range_counts))
            return [round(each) for each in self.range_counts], (sign * ends).tolist(), sign
        if self.range_counts is None or len(self.marks) < 2:
            return [2000, 63500], [-2.6, 2.6], 1
        counts, angles = np.array(sorted(self.marks)).T
        direction = 1 if angles[-1] > angles[0] else -1
        low, high = self.range_counts
        if low < counts[0] - 50:
            slope = (angles[1] - angles[0]) / (counts[1] - counts[0])
            counts, angles = np.r_[low, counts], np.r_[angles[0] + slope * (low - counts[0]), angles]
        if high > counts[-1] + 50:
            slope = (angles[-1] - angles[-2]) / (counts[-1] - counts[-2])
            counts, angles = np.r_[counts, high], np.r_[angles, angles[-1] + slope * (high - counts[-1])]
        return [round(float(c)) for c in counts], [float(direction * a) for a in angles], direction

    def angles(self, counts: Array) -> Array:
        """Return joint angles (n,), rad, of counts (n,), straight on beyond the table's ends as on the board."""
        at, angle, direction = self.pot_table()
        if self.kind == SensorKind.ABSOLUTE and self.counts_per_rev is not None:  # within half a revolution
            middle = 0.5 * (at[0] + at[-1])
            counts = middle + (counts - middle + ENCODER_REV / 2) % ENCODER_REV - ENCODER_REV / 2
        node = np.clip(np.searchsorted(at, counts), 1, len(at) - 1)
        c, a = np.array(at, dtype=float), np.array(angle)
        along = (counts - c[node - 1]) / (c[node] - c[node - 1])
        return np.asarray(direction * (a[node - 1] + along * (a[node] - a[node - 1])), dtype=float)

    @property
    def noise_rad(self) -> float:
        """Noise of a reading by the table's mean slope, no less than its rounding; 10 counts where not measured."""
        at, angle, _ = self.pot_table()
        noise = 10.0 if self.noise_counts is None else max(self.noise_counts, 12**-0.5)
        return noise * (angle[-1] - angle[0]) / (at[-1] - at[0])


@dataclass
class Found:
    """What a bring-up found."""

    board: str  #: the board's name
    joints: list[JointFound]  #: of each joint
    supply_v: float = 12.0  #: of the motors
    joint_count: int = JOINTS  #: how many joints the board has
    arm_time_s: float = 0.0  #: time on the board's clock, over all runs
    verified: bool = False  #: whether the small swing went well with what is stored

    @classmethod
    def read(cls, path: Path) -> Found:
        """Read what an earlier run kept, or raise InputError: it is no such file."""
        try:
            data = read_json(path)
            names = {each.name for each in fields(JointFound)}
            joints = data.pop("joints")
            if data.pop("version") not in (5, CONFIG_VERSION) or not isinstance(joints, list) or len(joints) != JOINTS:
                raise ValueError("it is of another version")
            found = cls(joints=[JointFound(**{k: v for k, v in j.items() if k in names}) for j in joints], **data)
            found._check()
            return found
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            mend = "remove it, or name another folder with -o"
            raise InputError(f"{path}: not what a bring-up kept ({error}): {mend}") from None

    def _check(self) -> None:
        """Raise ValueError where a value cannot have been found: its file was changed by hand."""
        if not _is_number(self.supply_v) or self.supply_v < 0:
            raise ValueError(f"supply_v is {self.supply_v!r}")
        if isinstance(self.joint_count, bool) or self.joint_count not in range(1, JOINTS + 1):
            raise ValueError(f"joint_count is {self.joint_count!r}")
        for j, joint in enumerate(self.joints):
            if (wrong := joint.impossible()) is not None:
                raise ValueError(f"joint {j + 1}: {wrong} is {getattr(joint, wrong)!r}")

    def write(self, path: Path) -> None:
        """Keep it."""
        write_text(path, json.dumps({"version": CONFIG_VERSION, **asdict(self)}, indent=1) + "\n")

    def json(self) -> dict[str, Any]:
        """Return what programs read: all but the figures' lines."""
        joints = [{name: value for name, value in asdict(each).items() if name != "traces"} for each in self.joints]
        return {**asdict(self), "joints": joints}

    def configuration(self, most_current_a: float, reaction: Reaction, *, gains: bool) -> Configuration:
        """Return the configuration of what is known; without ``gains`` joints are not controlled and nothing is watched."""
        config, supply = lab_configuration(), self.supply_v
        for name, share in (("nominal", 1.0), ("min", 0.8), ("max", 1.2)):
            config[f"supply_{name}_mv"] = round(1e3 * share * supply)
        _put(config, joint_count=self.joint_count, silence_reaction=reaction)
        for joint, found in zip(config["joint"], self.joints, strict=True):
            _put_sensor(joint, found)
            current_ma = round(1e3 * most_current_a)
            _put(joint, motor_direction=found.motor_direction or 1, current_limit_ma=current_ma)
            if gains and found.motor is not None:
                _put_motor(joint, found, found.motor, supply, most_current_a)
            else:
                _put_free(joint, found)
        return config


def _put(record: Configuration, **values: object) -> None:
    for name, value in values.items():
        record[name] = value


def _put_sensor(joint: Configuration, found: JointFound) -> None:
    counts, angles, direction = found.pot_table()
    low, high = sorted((direction * angles[0], direction * angles[-1]))
    _put(joint, soft_min_rad=low + _MARGIN_RAD, soft_max_rad=high - _MARGIN_RAD)
    joint["pot"]["jump_rad"] = max(0.02, 12 * found.noise_rad)
    if found.kind == SensorKind.POTENTIOMETER:
        spare, known = POT_NODES - len(counts), found.range_counts is not None
        _put(
            joint["pot"],
            node_count=len(counts),
            direction=direction,
            counts=counts + [0] * spare,
            angle_rad=angles + [0.0] * spare,
            # A joint without a table may have an open input: it shall not keep the others from being driven.
            short_counts=max(1, min(1000, counts[0] // 2)) if known else 0,
            open_counts=min(65000, (counts[-1] + 65535) // 2 + 1) if known else 65535,
        )
        return
    per_rev, middle = found.counts_per_rev or float(ENCODER_REV), 0.5 * (low + high)
    absolute, sign = found.kind == SensorKind.ABSOLUTE, 1 if per_rev > 0 else -1
    zero = round(found.zero_counts + middle * per_rev / (2 * np.pi)) % ENCODER_REV if absolute else 0
    joint["encoder"] = (found.kind, found.encoder_input, abs(per_rev), sign, zero, middle if absolute else 0.0)


def _put_motor(
    joint: Configuration, found: JointFound, motor: MotorFigures, supply_v: float, most_current_a: float
) -> None:
    gravity_n_m, elastic = found.gravity_n_m or 0.0, found.elastic
    gains = quiet_gains(motor, supply_v, found.noise_rad, gravity_n_m)
    if elastic is not None:
        soft = elastic_gains(motor, supply_v, elastic, found.noise_rad)
        gains = np.zeros(len(GAIN_RANGES)) if soft is None else soft
    if gains[0] > 0:  # until ki answers a load takes it so far that kp asks for the whole duty
        joint["pot"]["inverted_rad"] = min(joint["pot"]["inverted_rad"] + 1 / gains[0], _MOST_INVERTED_RAD)
        joint["following_rad"] += 1 / gains[0]
    backlash_rad = 1.5 * (LAB_BACKLASH_RAD if found.backlash_rad is None else found.backlash_rad)
    apart_rad = max(0.03, 10 * found.noise_rad + backlash_rad)
    joint["motor"] = (motor.resistance_ohm, motor.constant_v_s, apart_rad, backlash_rad)
    joint["transmission"]["uneven"] = min(found.uneven or 0.0, _MOST_UNEVEN)
    speed, acceleration = motion_limits(motor, supply_v, gravity_n_m)
    if elastic is not None and found.resonance_hz is not None:
        acceleration = min(acceleration, _ACCELERATION_TWIST_RAD * (2 * np.pi * found.resonance_hz) ** 2)
        _put_spring(joint, motor, elastic, supply_v)
    _put(
        joint,
        gains=np.array(tuple(gains), GAINS),
        speed_limit_rad_s=min(speed, 0.9e3 * float(joint["pot"]["jump_rad"])),
        acceleration_rad_s2=acceleration,
        deceleration_rad_s2=acceleration,
        jerk_rad_s3=100 * acceleration,
        duty_limit=1.0,
        stall_duty=0.9,
        current_limit_ma=round(1e3 * min(most_current_a, 0.95 * supply_v / motor.resistance_ohm)),
    )


def _put_spring(joint: Configuration, motor: MotorFigures, elastic: Elasticity, supply_v: float) -> None:
    """Put what the spring between motor and sensor makes of the law and of the motor's testimony."""
    twist_rad_per_a = motor.constant_v_s / elastic.stiffness_n_m
    stalled_rad = supply_v / motor.resistance_ohm * twist_rad_per_a
    _put(joint["transmission"], damping_share=1.0, twist_rad_per_a=min(twist_rad_per_a, 1.0))
    joint["motor"]["apart_rad"] = min(joint["motor"]["apart_rad"] + _SUDDEN * stalled_rad, 1.0)


def _put_free(joint: Configuration, found: JointFound) -> None:
    """Put gains of zero, and let nothing be watched that needs to know the motor."""
    _put(joint, gains=np.array((0, 0, 0, 0, 0, 0, 0.005, 20), GAINS), following_rad=13.0, gravity_slew_per_s=1000.0)
    _put(joint, duty_limit=1.0, stall_duty=1.0)
    joint["motor"]["resistance_ohm"] = 0.0
    _put(joint["pot"], frozen_rad=1.0, inverted_rad=1.0)
    if found.range_counts is None:  # its input may be open
        joint["pot"]["jump_rad"] = 1.0


def put_gentle(joint: Configuration, found: JointFound) -> None:
    """Put gains that move any joint a little: full duty at 30 degrees."""
    friction = 0.5 * (found.breakaway_duty or 0.0)
    gains = np.array((2.0, 2.0, 0.0, 0.0, 0.0, friction, 0.005, 20.0), GAINS)
    _put(joint, gains=gains, acceleration_rad_s2=30.0, jerk_rad_s3=3000.0)


# ---- the page ----

#: What the page shows of a joint: name, title, unit's size, format.
_NUMBERS: tuple[tuple[str, str, float, str], ...] = (
    ("noise_counts", "noise, counts", 1, ".1f"),
    ("motor_direction", "motor direction", 1, ".0f"),
    ("breakaway_duty", "moves from duty, %", 100, ".1f"),
    ("resistance_ohm", "R, ohm", 1, ".2f"),
    ("constant_v_s", "K, V s/rad", 1, ".3f"),
    ("inertia_kg_m2", "inertia, g m²", 1e3, ".1f"),
    ("dry_n_m", "dry friction, N m", 1, ".3f"),
    ("backlash_rad", "backlash, mrad", 1e3, ".1f"),
    ("gravity_n_m", "gravity at most, N m", 1, ".2f"),
    ("resonance_hz", "resonance, Hz", 1, ".1f"),
    ("uneven", "ratio varies by, %", 100, ".0f"),
    ("following_rms_rad", "follows to, as read, mrad RMS", 1e3, ".2f"),
    ("noise_rad", "noise, mrad", 1e3, ".2f"),
)


def report(found: Found, gains: Array) -> Report:
    """Return the page of figures: numbers, gains (n, 8), problems and plots of every joint."""

    def shown(joint: JointFound, name: str, scale: float, form: str) -> str:
        value = None if name == "noise_rad" and joint.range_counts is None else getattr(joint, name)
        return "" if value is None else format(value * scale, form)

    names = tuple(f"joint {j + 1}" for j in range(JOINTS))
    rows = tuple(
        (name, *(shown(joint, key, scale, form) for key, _, scale, form in _NUMBERS))
        for name, joint in zip(names, found.joints, strict=True)
    )
    gain_rows = [(key, *(f"{value:.4g}" for value in row)) for key, row in zip(GAIN_RANGES, gains.T, strict=True)]
    problems = [line for each in found.joints for line in each.problems]
    caption = "For every joint: table of its sensor, motor voltage, following error"
    plots: list[Block] = [Plot("joints", lambda: _figure(found), caption, caption)]
    sections: dict[str, Section] = {
        "joints": ("Joints", [TextTable("", ("", *(title for _, title, _, _ in _NUMBERS)), rows)]),
        "gains": ("Gains", [TextTable("", ("", *names[: len(gains)]), tuple(gain_rows))]),
        "figures": ("Figures", plots),
        "problems": ("Problems on the way", [Lines(problems)]),
    }
    sub = f"board {found.board}, {found.supply_v:g} V, {found.arm_time_s:.0f} s of the board's time"
    return Report("board bringup", "Bring-up of the arm's board", sub, "", sections)


def _figure(found: Found) -> Figure | None:
    shown = [(j, each) for j, each in enumerate(found.joints) if each.range_counts is not None]
    if not shown:
        return None
    figure = new_figure(2.1 * len(shown))
    for (j, each), (left, middle, right) in zip(shown, figure.subplots(len(shown), 3, squeeze=False), strict=True):
        counts, angles, direction = each.pot_table()
        left.plot(counts, np.degrees(direction * np.array(angles)), color=BLUE)
        marks = np.array(each.marks)
        left.plot(marks[:, 0], np.degrees(marks[:, 1]), "o", color=ORANGE, ms=3)
        left.set(title=f"joint {j + 1}: {each.sensor}", xlabel="counts", ylabel="deg")
        lines = each.traces
        if "swing_t_s" in lines:
            middle.plot(lines["swing_t_s"], lines["swing_voltage_v"], color=MUTED, lw=1.5, label="put out")
            middle.plot(lines["swing_t_s"], lines["swing_predicted_v"], color=BLUE, lw=0.8, label="R i + K w")
            middle.legend(loc="upper right", fontsize=7)
        middle.set(title="motor voltage of the swing", xlabel="s", ylabel="V")
        if "verify_t_s" in lines:
            right.plot(lines["verify_t_s"], 1e3 * np.array(lines["verify_error_rad"]), color=BLUE, lw=0.8)
        right.set(title="error of the small swing, with noise", xlabel="s", ylabel="mrad")
    return figure
