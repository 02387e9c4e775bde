"""Gains of a joint from what its motor is, by a rule with two inputs: bandwidth and damping.

With the torque ``K (u V - K w) / R`` and ``J``, ``B`` and ``C`` the inertia, viscous and dry friction at the joint, the
stall torque is ``S = K V / R`` and the motor damps itself by ``D = K^2 / R + B``. The speed that kd damps is filtered by a
time constant t, which is part of the loop: its four poles are placed as two pairs of one damping z, the slower one at the
bandwidth w, the faster one at v = w / 0.35 (or another ratio), ``(s^2 + 2 z w s + w^2) (s^2 + 2 z v s + v^2) = s^4 + c3 s^3
+ c2 s^2 + c1 s + c0``:

    t = 1 / c3,  ki = t J c0 / S,  kp = t J c1 / S - ki t,  kd = t J c2 / S - kp t - D / (2 S)

(t as if D were 0. Only half of what the motor damps by itself is counted: it is known to 15 % at first, and kd also says
how hard a joint is held against a push.) For the noise that a potentiometer puts into the duty, a filter within the loop
lets the bandwidth be half again as great as one beside it. The feed-forward gives what the motion itself takes, so that
nothing is left to the error: ``kv = D / S + kd``, ``ka = J / S - kd t``, ``kf = C / S``; t is by how much the filtered
speed is late, which damps the less while the motion accelerates.

A load that changes by P N m a second leaves the error ``P / (S ki)``: :func:`quiet_gains` looks for the greatest ki that
the noise of the readings admits. (Åström and Murray, "Feedback Systems", 2008, sections 10.2 and 10.5; Ellis, "Control
System Design Guide", 2012, chapter 6.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.robot.boards import headers
from armsight.robot.boards.link import TICK_S

#: Gain -> smallest and largest value.
GAIN_RANGES = headers.ranges("joint_gains")
_PAIRS = 0.35
#: Dry friction is compensated by a little less than it is, so that it never drives.
_FRICTION_SHARE = 0.9
_LEAST_ANTI_WINDUP_PER_S = 20.0


@dataclass(frozen=True)
class MotorFigures:
    """A motor with its gear, at the joint."""

    resistance_ohm: float  #: of the winding
    constant_v_s: float  #: motor constant, V s/rad and N m/A
    inertia_kg_m2: float  #: of rotor, gear and what it moves
    viscous_n_m_s: float  #: friction that grows with speed, N m s/rad
    dry_n_m: float  #: dry friction, N m

    def stall_n_m(self, supply_v: float) -> float:
        """Return the torque at rest under full duty."""
        return self.constant_v_s * supply_v / self.resistance_ohm

    @property
    def own_damping_n_m_s(self) -> float:
        """What damps it by itself, N m s/rad: its back-EMF and its friction."""
        return self.constant_v_s**2 / self.resistance_ohm + self.viscous_n_m_s


@dataclass(frozen=True)
class Elasticity:
    """A transmission that twists between the motor and what is read."""

    stiffness_n_m: float  #: of the spring, N m/rad
    damping_n_m_s: float  #: of the spring, N m s/rad
    link_share: float  #: share of the joint's inertia behind the spring
    opens: bool = False  #: whether its load is too small to keep the teeth of its backlash together

    def held_hz(self, inertia_kg_m2: float) -> float:
        """Return the resonance of the joint while its motor is held, Hz, of an inertia of motor and joint together."""
        return float(np.sqrt(self.stiffness_n_m / (self.link_share * inertia_kg_m2)) / (2 * np.pi))


def tuned_gains(
    motor: MotorFigures, supply_v: float, bandwidth_rad_s: float, damping: float = 0.7, pairs: float = _PAIRS
) -> Array:
    """Return the gains of a joint by the rule above.

    ``supply_v``: nominal supply, V; ``bandwidth_rad_s``: natural frequency of the slower pair of poles, rad/s; ``damping``:
    of both pairs, of critical; ``pairs``: natural frequency of the slower pair over that of the faster one, 0 to 1. Returns
    (8,) kp, ki, kd, kv, ka, kf, derivative filter, anti-windup. Raises InputError: a number is not positive.
    """
    needed = {"supply_v": supply_v, "bandwidth_rad_s": bandwidth_rad_s, "damping": damping}
    needed |= {name: getattr(motor, name) for name in ("resistance_ohm", "constant_v_s", "inertia_kg_m2")}
    for name, value in needed.items():
        if not value > 0:
            raise InputError(f"{name} is {value:g}; it must be positive")
    stall, own = motor.stall_n_m(supply_v), motor.own_damping_n_m_s
    per_rad_s2 = motor.inertia_kg_m2 / stall
    slow, fast = ((1.0, 2 * damping * w, w * w) for w in (bandwidth_rad_s, bandwidth_rad_s / pairs))
    _, c3, c2, c1, c0 = np.polymul(slow, fast)
    filter_s = 1 / c3
    ki = filter_s * c0 * per_rad_s2
    kp = filter_s * c1 * per_rad_s2 - ki * filter_s
    kd = max(filter_s * c2 * per_rad_s2 - kp * filter_s - 0.5 * own / stall, 0.0)
    ka = max(per_rad_s2 - kd * (filter_s + 0.5 * TICK_S), 0.0)
    kf = _FRICTION_SHARE * motor.dry_n_m / stall
    return np.array([kp, ki, kd, own / stall + kd, ka, kf, filter_s, max(3 * ki / kp, _LEAST_ANTI_WINDUP_PER_S)])


#: Of an elastic joint: what its stiffness may be of that identified (a payload, another pose), how near -1 the loop
#: gain may come, and damping and ratio of the third pole to the others' frequency. The motor's speed is smoothed for so
#: long (motor.c), and a duty comes so late: a tick is half held, one is computed in.
_STIFFNESSES, _LEAST_MARGIN, _ELASTIC_DAMPING = (0.5, 1.0, 1.7), 0.5, 0.7
#: Share of spring and damping that swings of 0.7 of the backlash find (the describing function of a gap in a spring); half:
#: soft joints are slow, double: light ones swing between the teeth.
_OPEN_SHARE = 0.2
_THIRD_POLES, _MOTOR_SMOOTH_S, _LATE_S = (1.0, 0.6), 0.002, 0.0015
_ELASTIC_FILTER_S = 0.005  # of the reading's speed, which is damped only while the motor's is not known
_MARGIN_HZ = np.geomspace(0.3, 400.0, 200)


def elastic_gains(motor: MotorFigures, supply_v: float, elastic: Elasticity, noise_rad: float) -> Array | None:
    """Return the gains with the greatest ki of a joint that is read behind its spring and damped by its motor's speed.

    Without the spring there would be three poles, ``(s^2 + 2 z w s + w^2) (s + r w)``; w is the greatest with which the
    loop gain, at the motor's duty and with the spring, stays away from -1 and every pole decays. Damping by its speed
    takes energy from the resonance at any frequency; by the speed read behind the spring it feeds it from there on (Spong,
    Hutchinson and Vidyasagar, "Robot Modeling and Control", 2006, section 6.5). Backlash that opens is a softer spring, the
    softer the smaller the swing (Gelb and Vander Velde, "Multiple-Input Describing Functions", 1968, chapter 2).

    ``motor``: its motor; the inertia is that of motor and joint together. ``supply_v``: nominal supply, V. ``elastic``: its
    spring. ``noise_rad``: standard deviation of a reading. Returns (8,) as those of :func:`tuned_gains`; None where the
    joint is too soft: no bandwidth from 5 rad/s on is stable.
    """
    best: Array | None = None
    springs = [(share, elastic.damping_n_m_s, _LEAST_MARGIN) for share in _STIFFNESSES]
    if elastic.opens:
        springs.append((_OPEN_SHARE, _OPEN_SHARE * elastic.damping_n_m_s, 0.0))
    for third in _THIRD_POLES:
        for bandwidth in _bandwidths(motor, _QUIET_STEP_RAD_S):
            gains = _three_pole_gains(motor, supply_v, bandwidth, third)
            too_many = any(gain > most for gain, (_, most) in zip(gains, GAIN_RANGES.values(), strict=True))
            if too_many or gains[0] * noise_rad > _QUIET[0][1]:
                continue
            if all(_holds(motor, supply_v, elastic, gains, *spring) for spring in springs):
                best = gains if best is None or gains[1] > best[1] else best
                break
    return best


def _three_pole_gains(motor: MotorFigures, supply_v: float, bandwidth: float, third: float) -> Array:
    stall, own = motor.stall_n_m(supply_v), motor.own_damping_n_m_s
    per_rad_s2, double = motor.inertia_kg_m2 / stall, 2 * _ELASTIC_DAMPING
    kp, ki = (1 + double * third) * bandwidth**2 * per_rad_s2, third * bandwidth**3 * per_rad_s2
    kd = max((double + third) * bandwidth * per_rad_s2 - 0.5 * own / stall, 0.0)
    ka = max(per_rad_s2 - kd * (_MOTOR_SMOOTH_S + 0.5 * TICK_S), 0.0)
    kf = _FRICTION_SHARE * motor.dry_n_m / stall
    windup = max(3 * ki / kp, _LEAST_ANTI_WINDUP_PER_S)
    return np.array([kp, ki, kd, own / stall + kd, ka, kf, _ELASTIC_FILTER_S, windup])


def _holds(
    motor: MotorFigures, supply_v: float, elastic: Elasticity, gains: Array, share: float, c: float, margin: float
) -> bool:
    """Return whether the loop with share of the spring's stiffness and damping c, N m s/rad, is stable, with margin."""
    stall, own = motor.stall_n_m(supply_v), motor.own_damping_n_m_s
    link = elastic.link_share * motor.inertia_kg_m2
    rotor, k = motor.inertia_kg_m2 - link, share * elastic.stiffness_n_m
    kp, ki, kd = gains[:3]
    s = 2j * np.pi * _MARGIN_HZ
    spring = k + c * s
    per = stall * np.exp(-_LATE_S * s) / ((rotor * s**2 + own * s + spring) * (link * s**2 + spring) - spring**2)
    loop = per * (spring * (kp + ki / s) + (link * s**2 + spring) * kd * s / (1 + _MOTOR_SMOOTH_S * s))
    if np.abs(1 + loop).min() < margin:
        return False
    # States: motor's angle and speed, joint's angle and speed, smoothed speed, integral, lateness (Pade's first order).
    a, asked = np.zeros((7, 7)), np.array([0, 0, -kp, 0, -kd, 1, 0])
    duty = -asked + np.array([0, 0, 0, 0, 0, 0, 4 / _LATE_S])
    a[0, 1] = a[2, 3] = 1
    a[1] = (stall * duty + np.array([-k, -own - c, k, c, 0, 0, 0])) / rotor
    a[3, :4] = np.array([k, c, -k, -c]) / link
    a[4, [1, 4]] = np.array([1, -1]) / _MOTOR_SMOOTH_S
    a[5, 2], a[6] = -ki, asked
    a[6, 6] -= 2 / _LATE_S
    return bool(np.linalg.eigvals(a).real.max() < 0)


#: Between which bandwidths one is looked for; stiffer than ``w^2 J`` a gear with backlash chatters.
_LEAST_RAD_S, _MOST_RAD_S, _MOST_N_M = 5, 40, 64.0
#: Shares of the duty: all that motion and load may take, and of what the load leaves, what steady motion may take.
_USED, _MOVING = 0.95, 0.8
_MOST_SPEED_RAD_S, _MOST_RAD_S2 = 2.0, 10.0


def quiet_bandwidth(motor: MotorFigures, supply_v: float, noise_rad: float, duty_noise: float) -> float:
    """Return the greatest bandwidth, rad/s, not too stiff, with gains a board takes, at which noise hardly moves the duty.

    Noise is the standard deviation of a reading, and of the duty that it may cause.
    """
    for bandwidth in _bandwidths(motor, 1.0):
        if _is_quiet(tuned_gains(motor, supply_v, bandwidth), noise_rad, duty_noise):
            return bandwidth
    return float(_LEAST_RAD_S)


#: Damping of quiet gains, and standard deviation of the duty that a reading's noise may cause: the first ones with which
#: gravity's change leaves little error. With a damping of 0.5 joints with backlash swing by themselves.
_QUIET = ((0.7, 0.08), (0.6, 0.08), (0.6, 0.1), (0.6, 0.12))
_QUIET_PAIRS, _QUIET_STEP_RAD_S = (0.35, 0.42, 0.5, 0.6), 0.5
#: RMS error that gravity's change may leave in a swing of this amplitude and frequency, or of what the motor reaches.
_GRAVITY_RAD, _SWING_RAD, _SWING_HZ = 0.001, 0.5, 0.4


def quiet_gains(motor: MotorFigures, supply_v: float, noise_rad: float, gravity_n_m: float) -> Array:
    """Return the gains with the greatest ki, not too stiff, that a board takes, at which noise hardly moves the duty.

    Where gravity's greatest torque is great, damping may be less, noise greater. (8,) as :func:`tuned_gains`.
    """
    stall = motor.stall_n_m(supply_v)
    speed_rad_s, acceleration_rad_s2 = motion_limits(motor, supply_v, gravity_n_m)
    w = 2 * np.pi * _SWING_HZ
    gravity_n_m_s = gravity_n_m * min(_SWING_RAD * w, speed_rad_s, acceleration_rad_s2 / w) / np.sqrt(2)
    best = tuned_gains(motor, supply_v, _LEAST_RAD_S)
    for damping, duty_noise in _QUIET:
        for pairs in _QUIET_PAIRS:
            for bandwidth in _bandwidths(motor, _QUIET_STEP_RAD_S):
                gains = tuned_gains(motor, supply_v, bandwidth, damping, pairs)
                if _is_quiet(gains, noise_rad, duty_noise):
                    best = max(best, gains, key=lambda each: float(each[1]))
                    break
        if gravity_n_m_s <= _GRAVITY_RAD * stall * best[1]:
            break
    return best


def _bandwidths(motor: MotorFigures, step_rad_s: float) -> list[float]:
    """Return the bandwidths to be tried, falling, rad/s: none so stiff that a gear with backlash chatters."""
    stiffest = min(_MOST_RAD_S, round(np.sqrt(_MOST_N_M / motor.inertia_kg_m2)))
    return [float(each) for each in np.arange(stiffest, _LEAST_RAD_S, -step_rad_s)]


def _is_quiet(gains: Array, noise_rad: float, duty_noise: float) -> bool:
    """Return whether a board takes the gains (8,) and noise of the readings moves the duty by no more than duty_noise."""
    if any(gain > most for gain, (_, most) in zip(gains, GAIN_RANGES.values(), strict=True)):
        return False
    kp, _, kd, *_, filter_s, _ = gains
    share = TICK_S / (filter_s + TICK_S)
    speed_noise = noise_rad * share / TICK_S * np.sqrt(2 / (2 - share))
    return bool(np.hypot(kp * noise_rad, kd * speed_noise) <= duty_noise)


def motion_limits(motor: MotorFigures, supply_v: float, gravity_n_m: float) -> tuple[float, float]:
    """Return the greatest speed, rad/s, and acceleration, rad/s^2, that a motor reaches with duty to spare."""
    stall = motor.stall_n_m(supply_v)
    free_rad_s = supply_v / motor.constant_v_s
    load = min((gravity_n_m + motor.dry_n_m) / stall, _MOVING)
    speed = min(max(_MOVING * (_USED - load) * free_rad_s, 0.05), _MOST_SPEED_RAD_S)
    spare = max(_USED - load - speed / free_rad_s, 0.05)
    return speed, min(max(spare * stall / motor.inertia_kg_m2, 0.5), _MOST_RAD_S2)
