"""What a bring-up found: the records of joints and board, their file, the configuration that follows, the page of figures.

In: what :mod:`armsight.app.board.bringup` measured. Out: ``bringup.json``, a board's configuration, ``report.html``.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.show.page import html_page, picture, table, text
from armsight.app.show.plotting import BLUE, MUTED, ORANGE, drawing, new_figure, png
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
#: Of an elastic joint: its stiffness may be less than found by this factor (another pose, one direction); a sudden load
#: twists it by this share of the motor's stall torque, an acceleration by so much, rad; half: slower, double: it rings.
_SOFTER, _SUDDEN, _ACCELERATION_TWIST_RAD = 1.5, 0.2, 0.0025
_MOST_INVERTED_RAD = 1.0
_MOST_UNEVEN = 0.5  # share of a ratio, as config.c holds it
_POSITIVE = ("resistance_ohm", "constant_v_s", "inertia_kg_m2", "stiffness_n_m")
_NOT_NEGATIVE = (
    *("noise_counts", "breakaway_duty", "viscous_n_m_s", "dry_n_m"),
    *("backlash_rad", "gravity_n_m", "fit_rms_v", "following_rms_rad", "spring_damping_n_m_s", "uneven"),
)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))


def _is_pair(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))


@dataclass
class JointFound:
    """What was found of a joint; None where it was not yet.

    Attributes:
        noise_counts: standard deviation of its potentiometer at rest.
        marks: pairs of counts and angle, rad.
        range_counts: least and greatest reading of the movement by hand.
        motor_direction: 1 or -1.
        breakaway_duty: from which duty on the motor moved the joint.
        resistance_ohm: of the motor, with the current sensor as it reads.
        constant_v_s: motor constant at the joint, V s/rad.
        inertia_kg_m2: at the joint.
        viscous_n_m_s: viscous friction, N m s/rad.
        dry_n_m: dry friction, N m.
        backlash_rad: from stop to stop.
        gravity_n_m: greatest torque of gravity.
        stiffness_n_m: of the spring between motor and what is read, N m/rad; None where it is rigid.
        spring_damping_n_m_s: of that spring, N m s/rad.
        link_share: share of the inertia behind that spring.
        uneven: by which share the ratio of its transmission varies with the angle; None where it was not measured.
        fit_rms_v: by how much the fit misses the motor's voltage.
        following_rms_rad: error of the small swing that verified the gains, as read: the sensor's noise is in it.
        sensor: what reads it: potentiometer, quadrature or absolute.
        encoder_input: of a quadrature encoder: which.
        counts_per_rev: of its encoder, a revolution of the joint; negative where counts fall with the angle.
        zero_counts: of its encoder at 0 rad; counts go on beyond where a reading wraps.
        problems: what was named, in order.
        traces: lines of figures by name.
    """

    noise_counts: float | None = None
    marks: list[list[float]] = field(default_factory=list)
    range_counts: list[float] | None = None
    motor_direction: int | None = None
    breakaway_duty: float | None = None
    resistance_ohm: float | None = None
    constant_v_s: float | None = None
    inertia_kg_m2: float | None = None
    viscous_n_m_s: float | None = None
    dry_n_m: float | None = None
    backlash_rad: float | None = None
    gravity_n_m: float | None = None
    stiffness_n_m: float | None = None
    spring_damping_n_m_s: float | None = None
    link_share: float | None = None
    uneven: float | None = None
    fit_rms_v: float | None = None
    following_rms_rad: float | None = None
    sensor: str = "potentiometer"
    encoder_input: int = 0
    counts_per_rev: float | None = None
    zero_counts: float = 0.0
    problems: list[str] = field(default_factory=list)
    traces: dict[str, list[float]] = field(default_factory=dict)

    @property
    def motor(self) -> MotorFigures | None:
        """Its motor, where it was identified."""
        values = (self.resistance_ohm, self.constant_v_s, self.inertia_kg_m2, self.viscous_n_m_s, self.dry_n_m)
        return None if None in values else MotorFigures(*values)  # type: ignore[arg-type]

    @property
    def elastic(self) -> Elasticity | None:
        """Its spring, where it has one."""
        values = (self.stiffness_n_m, self.spring_damping_n_m_s, self.link_share)
        return None if None in values else Elasticity(*values)  # type: ignore[arg-type]

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
        looked_for = {
            "readings": self.noise_counts,
            "potentiometers": self.range_counts,
            "motors": self.motor_direction,
            "swing": self.resistance_ohm,
            "verify": self.following_rms_rad,
        }
        return looked_for.get(step) is not None

    def impossible(self) -> str | None:
        """Return the name of a value that cannot have been found, None where all can."""
        for name in (*_POSITIVE, *_NOT_NEGATIVE):
            value = getattr(self, name)
            if value is not None and not (_is_number(value) and (value > 0 if name in _POSITIVE else value >= 0)):
                return name
        can_be = {
            "link_share": self.link_share is None or (_is_number(self.link_share) and 0 < self.link_share < 1),
            "motor_direction": self.motor_direction in (None, 1, -1),
            "sensor": self.sensor in [kind.name.lower() for kind in SensorKind],
            "encoder_input": _is_number(self.encoder_input) and self.encoder_input in range(JOINTS + 1),
            "counts_per_rev": self.counts_per_rev is None
            or (_is_number(self.counts_per_rev) and self.counts_per_rev != 0),
            "zero_counts": _is_number(self.zero_counts),
            "marks": isinstance(self.marks, list) and all(map(_is_pair, self.marks)),
            "range_counts": self.range_counts is None
            or (_is_pair(self.range_counts) and self.range_counts[0] < self.range_counts[1]),
        }
        return next((name for name, holds in can_be.items() if not holds), None)

    @property
    def kind(self) -> SensorKind:
        """What reads it."""
        return SensorKind[self.sensor.upper()]

    def fit_encoder(self) -> float:
        """Fit a line to the angles marked: counts of a revolution and zero; returns the greatest deviation, rad.

        Raises:
            InputError: an absolute encoder that does not go with the joint one to one.
        """
        marks = np.array(self.marks)
        slope, offset = np.polyfit(marks[:, 1], marks[:, 0], 1)
        per_rev = float(2 * np.pi * slope)
        if self.kind == SensorKind.ABSOLUTE:
            if not 0.95 < abs(per_rev) / ENCODER_REV < 1.05:
                raise InputError(
                    f"its encoder counts {abs(per_rev):.0f} a revolution of the joint; an absolute one must count"
                    f" {ENCODER_REV}. Is its magnet on the joint's own axis?"
                )
            per_rev = float(np.copysign(ENCODER_REV, per_rev))
            offset = np.mean(marks[:, 0] - per_rev / (2 * np.pi) * marks[:, 1])
        self.counts_per_rev, self.zero_counts = float(round(per_rev)), float(offset)
        return float(np.abs(marks[:, 1] - self.encoder_angles(marks[:, 0])).max())

    def encoder_angles(self, counts: Array) -> Array:
        """Return joint angles (n,), rad, of an encoder's counts (n,)."""
        per_rev = self.counts_per_rev or 1.0
        return np.asarray(2 * np.pi / per_rev * (counts - self.zero_counts), dtype=float)

    def pot_table(self) -> tuple[list[int], list[float], int]:
        """Return counts and angles, rad, of the potentiometer's table, and its direction; ends are extrapolated.

        Of an encoder the ends of its range, which is a straight line.
        """
        if self.counts_per_rev is not None and self.range_counts is not None:
            sign = 1 if self.counts_per_rev > 0 else -1
            ends = self.encoder_angles(np.array(self.range_counts))
            return [round(each) for each in self.range_counts], (sign * ends).tolist(), sign
        if self.range_counts is None or len(self.marks) < 2:
            return [2000, 63500], [-2.6, 2.6], 1
        marks = np.array(sorted(self.marks))
        counts, angles = marks[:, 0], marks[:, 1]
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
        if (
            self.kind == SensorKind.ABSOLUTE and self.counts_per_rev is not None
        ):  # within half a revolution of the middle
            middle = 0.5 * (at[0] + at[-1])
            counts = middle + (counts - middle + ENCODER_REV / 2) % ENCODER_REV - ENCODER_REV / 2
        node = np.clip(np.searchsorted(at, counts), 1, len(at) - 1)
        c, a = np.array(at, dtype=float), np.array(angle)
        along = (counts - c[node - 1]) / (c[node] - c[node - 1])
        return np.asarray(direction * (a[node - 1] + along * (a[node] - a[node - 1])), dtype=float)

    @property
    def rad_per_count(self) -> float:
        """Mean slope of the table."""
        counts, angles, _ = self.pot_table()
        return (angles[-1] - angles[0]) / (counts[-1] - counts[0])

    @property
    def noise_rad(self) -> float:
        """Noise of a reading, no less than its rounding; 10 counts where it was not measured."""
        counts = 10.0 if self.noise_counts is None else max(self.noise_counts, 12**-0.5)
        return counts * self.rad_per_count


@dataclass
class Found:
    """What a bring-up found.

    Attributes:
        board: the board's name.
        joints: of each joint.
        supply_v: of the motors.
        joint_count: how many joints the board has.
        arm_time_s: time on the board's clock, over all runs.
        verified: whether the small swing went well with what is stored.
    """

    board: str
    joints: list[JointFound]
    supply_v: float = 12.0
    joint_count: int = JOINTS
    arm_time_s: float = 0.0
    verified: bool = False

    @classmethod
    def read(cls, path: Path) -> Found:
        """Read what an earlier run kept.

        Raises:
            InputError: it is no such file.
        """
        try:
            data = read_json(path)
            names = {each.name for each in fields(JointFound)}
            joints = data["joints"]
            if data.pop("version") not in (5, CONFIG_VERSION) or not isinstance(joints, list) or len(joints) != JOINTS:
                raise ValueError("it is of another version")
            joints = [JointFound(**{k: v for k, v in each.items() if k in names}) for each in data.pop("joints")]
            found = cls(joints=joints, **data)
            found.check()
            return found
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(
                f"{path}: not what a bring-up kept ({error}): remove it, or name another folder with -o"
            ) from None

    def check(self) -> None:
        """Raise ValueError where a value cannot have been found: its file was changed by hand."""
        if not _is_number(self.supply_v) or self.supply_v < 0:
            raise ValueError(f"supply_v is {self.supply_v!r}")
        if isinstance(self.joint_count, bool) or self.joint_count not in range(1, JOINTS + 1):
            raise ValueError(f"joint_count is {self.joint_count!r}")
        for j, joint in enumerate(self.joints):
            wrong = joint.impossible()
            if wrong is not None:
                raise ValueError(f"joint {j + 1}: {wrong} is {getattr(joint, wrong)!r}")

    def write(self, path: Path) -> None:
        """Keep it."""
        write_text(path, json.dumps({"version": CONFIG_VERSION, **asdict(self)}, indent=1) + "\n")

    def configuration(self, most_current_a: float, reaction: Reaction, *, gains: bool) -> Configuration:
        """Return the configuration of what is known; without ``gains`` joints are not controlled and nothing is watched."""
        config = lab_configuration()
        config["joint_count"] = self.joint_count
        supply = self.supply_v
        config["supply_nominal_mv"] = round(1e3 * supply)
        config["supply_min_mv"], config["supply_max_mv"] = round(800 * supply), round(1200 * supply)
        config["silence_reaction"] = reaction
        for joint, found in zip(config["joint"], self.joints, strict=True):
            _put_sensor(joint, found)
            joint["motor_direction"] = found.motor_direction or 1
            joint["current_limit_ma"] = round(1e3 * most_current_a)
            if gains and found.motor is not None:
                _put_motor(joint, found, found.motor, supply, most_current_a)
            else:
                _put_free(joint, found)
        return config


def _put_sensor(joint: Configuration, found: JointFound) -> None:
    """Put what reads a joint, and its soft limits."""
    _, angles, direction = found.pot_table()
    ends = sorted((direction * angles[0], direction * angles[-1]))
    joint["soft_min_rad"], joint["soft_max_rad"] = ends[0] + _MARGIN_RAD, ends[1] - _MARGIN_RAD
    joint["pot"]["jump_rad"] = max(0.02, 12 * found.noise_rad)
    if found.kind == SensorKind.POTENTIOMETER:
        _put_pot(joint["pot"], found)
        return
    per_rev = found.counts_per_rev or float(ENCODER_REV)
    middle = 0.5 * (ends[0] + ends[1])
    absolute = found.kind == SensorKind.ABSOLUTE
    zero = round(found.zero_counts + middle * per_rev / (2 * np.pi)) % ENCODER_REV if absolute else 0
    sign = 1 if per_rev > 0 else -1
    joint["encoder"] = (found.kind, found.encoder_input, abs(per_rev), sign, zero, middle if absolute else 0.0)


def _put_pot(pot: Configuration, found: JointFound) -> None:
    counts, angles, direction = found.pot_table()
    pot["node_count"], pot["direction"] = len(counts), direction
    pot["counts"] = counts + [0] * (POT_NODES - len(counts))
    pot["angle_rad"] = angles + [0.0] * (POT_NODES - len(angles))
    # A joint without a table may have an open input: it shall not keep the others from being driven.
    pot["short_counts"], pot["open_counts"] = (
        (0, 65535)
        if found.range_counts is None
        else (max(1, min(1000, counts[0] // 2)), min(65000, (counts[-1] + 65535) // 2 + 1))
    )


def _put_motor(
    joint: Configuration, found: JointFound, motor: MotorFigures, supply_v: float, most_current_a: float
) -> None:
    """Put gains, limits and the motor's numbers."""
    gains = quiet_gains(motor, supply_v, found.noise_rad, found.gravity_n_m or 0.0)
    elastic = found.elastic
    if elastic is not None:
        soft = elastic_gains(motor, supply_v, elastic, found.noise_rad)
        gains = np.zeros(len(GAIN_RANGES)) if soft is None else soft
    joint["gains"] = np.array(tuple(gains), GAINS)
    joint["motor"]["resistance_ohm"], joint["motor"]["constant_v_s"] = motor.resistance_ohm, motor.constant_v_s
    backlash_rad = 1.5 * (LAB_BACKLASH_RAD if found.backlash_rad is None else found.backlash_rad)
    joint["motor"]["apart_rad"] = max(0.03, 10 * found.noise_rad + backlash_rad)
    joint["motor"]["backlash_rad"] = backlash_rad
    joint["transmission"]["uneven"] = min(found.uneven or 0.0, _MOST_UNEVEN)
    speed, acceleration = motion_limits(motor, supply_v, found.gravity_n_m or 0.0)
    speed = min(speed, 0.9e3 * float(joint["pot"]["jump_rad"]))
    if elastic is not None and found.resonance_hz is not None:
        acceleration = min(acceleration, _ACCELERATION_TWIST_RAD * (2 * np.pi * found.resonance_hz) ** 2)
        _put_spring(joint, motor, elastic, supply_v)
    for name, value in {
        "speed_limit_rad_s": speed,
        "acceleration_rad_s2": acceleration,
        "deceleration_rad_s2": acceleration,
        "jerk_rad_s3": 100 * acceleration,
        "duty_limit": 1.0,
        "stall_duty": 0.9,
    }.items():
        joint[name] = value
    joint["current_limit_ma"] = round(1e3 * min(most_current_a, 0.95 * supply_v / motor.resistance_ohm))


def _put_spring(joint: Configuration, motor: MotorFigures, elastic: Elasticity, supply_v: float) -> None:
    """Put what the spring between motor and sensor makes of the law and of the motor's testimony."""
    twist_rad_per_a = motor.constant_v_s / elastic.stiffness_n_m
    stall_a = supply_v / motor.resistance_ohm
    joint["transmission"]["damping_share"] = 1.0
    joint["transmission"]["twist_rad_per_a"] = min(twist_rad_per_a, 1.0)
    sudden_rad = _SUDDEN * stall_a * twist_rad_per_a
    joint["motor"]["apart_rad"] = min(joint["motor"]["apart_rad"] + sudden_rad, 1.0)
    joint["pot"]["inverted_rad"] = min(
        joint["pot"]["inverted_rad"] + _SOFTER * stall_a * twist_rad_per_a, _MOST_INVERTED_RAD
    )
    joint["following_rad"] += _SOFTER * stall_a * twist_rad_per_a


def _put_free(joint: Configuration, found: JointFound) -> None:
    """Put gains of zero, and let nothing be watched that needs to know the motor."""
    joint["gains"] = np.array((0, 0, 0, 0, 0, 0, 0.005, 20), GAINS)
    joint["motor"]["resistance_ohm"] = 0.0
    for name, value in {
        "duty_limit": 1.0,
        "stall_duty": 1.0,
        "following_rad": 13.0,
        "gravity_slew_per_s": 1000.0,
    }.items():
        joint[name] = value
    joint["pot"]["frozen_rad"] = joint["pot"]["inverted_rad"] = 1.0
    if found.range_counts is None:  # its input may be open
        joint["pot"]["jump_rad"] = 1.0


def put_gentle(joint: Configuration, found: JointFound) -> None:
    """Put gains that move any joint a little: full duty at 30 degrees."""
    joint["gains"] = np.array((2.0, 2.0, 0.0, 0.0, 0.0, 0.5 * (found.breakaway_duty or 0.0), 0.005, 20.0), GAINS)
    joint["acceleration_rad_s2"], joint["jerk_rad_s3"] = 30.0, 3000.0


# ---- the page ----

_NUMBERS: tuple[tuple[str, str, float, str], ...] = (
    ("noise_counts", "noise, counts", 1, ".1f"),
    ("motor_direction", "motor direction", 1, ".0f"),
    ("breakaway_duty", "moves from duty, %", 100, ".1f"),
    ("resistance_ohm", "R, ohm", 1, ".2f"),
    ("constant_v_s", "K, V s/rad", 1, ".3f"),
    ("inertia_kg_m2", "inertia, g m&sup2;", 1e3, ".1f"),
    ("dry_n_m", "dry friction, N m", 1, ".3f"),
    ("backlash_rad", "backlash, mrad", 1e3, ".1f"),
    ("gravity_n_m", "gravity at most, N m", 1, ".2f"),
    ("resonance_hz", "resonance, Hz", 1, ".1f"),
    ("uneven", "ratio varies by, %", 100, ".0f"),
    ("following_rms_rad", "follows to, as read, mrad RMS", 1e3, ".2f"),
    ("noise_rad", "noise, mrad", 1e3, ".2f"),
)


def report(found: Found, gains: Array) -> str:
    """Return the page of figures.

    Raises:
        InputError: matplotlib is not installed.
    """
    rows = []
    for j, each in enumerate(found.joints):
        known = {
            **vars(each),
            "resonance_hz": each.resonance_hz,
            "noise_rad": None if each.range_counts is None else each.noise_rad,
        }
        values = [(known[name], scale, form) for name, _, scale, form in _NUMBERS]
        rows.append([f"joint {j + 1}", *("" if v is None else format(v * s, f) for v, s, f in values)])
    gain_rows = [[name, *(f"{value:.4g}" for value in row)] for name, row in zip(GAIN_RANGES, gains.T, strict=True)]
    problems = [[f"joint {j + 1}", text(line)] for j, each in enumerate(found.joints) for line in each.problems]
    sections = {
        "joints": ("Joints", table(["", *(title for _, title, _, _ in _NUMBERS)], rows, "numbers")),
        "gains": ("Gains", table(["", *(f"joint {j + 1}" for j in range(len(gains)))], gain_rows, "numbers")),
        "figures": ("Figures", _figures(found)),
    }
    if problems:
        sections["problems"] = ("Problems on the way", table(["", "named"], problems, "prose"))
    sub = f"board {found.board}, {found.supply_v:g} V, {found.arm_time_s:.0f} s of the board's time"
    return html_page("Bring-up", "Bring-up of the arm's board", sub, sections)


def _figures(found: Found) -> str:
    """Return a row of plots for every joint: table, motor voltage of the swing, error of the small swing."""
    shown = [(j, each) for j, each in enumerate(found.joints) if each.range_counts is not None]
    if not shown:
        return "<p>Nothing to show.</p>"
    with drawing():
        figure = new_figure(2.1 * len(shown))
        axes = figure.subplots(len(shown), 3, squeeze=False)
        for (j, each), (left, middle, right) in zip(shown, axes, strict=True):
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
        plots = picture(png(figure), "For every joint: table of its sensor, motor voltage, following error")
        return f"<figure>{plots}</figure>"


def found_json(found: Found) -> dict[str, Any]:
    """Return what was found as JSON has it, without the figures' lines."""
    record = asdict(found)
    for each in record["joints"]:
        del each["traces"]
    return record
