"""Gains of a joint from what its motor is, by a rule with two inputs: bandwidth and damping.

With the torque ``K (u V - K w) / R`` and ``J``, ``B`` and ``C`` the inertia, viscous and dry friction at the joint, the
stall torque is ``S = K V / R`` and the motor damps itself by ``D = K^2 / R + B``. With the integral the loop is of third
order, ``J q''' + (D + S kd) q'' + S kp q' + S ki q = ...``; its poles are placed at ``(s^2 + 2 z w s + w^2) (s + a w)``:

    kd = ((2 z + a) w J - D) / S,  kp = (1 + 2 z a) w^2 J / S,  ki = a w^3 J / S

The feed-forward gives what the motion itself takes, so that nothing is left to the error: ``kv = D / S + kd``,
``ka = J / S - kd t``, ``kf = C / S``; t is by how much the filtered speed is late, which damps the less while the motion
accelerates. (Åström and Murray, "Feedback Systems", 2008, sections 10.2 and 10.5; Ellis, "Control System
Design Guide", 2012, chapter 6.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armsight.data import Array
from armsight.errors import InputError

#: The integral's pole, and the corner of the speed's filter over the bandwidth: 1 / 0.25.
_INTEGRAL_SHARE, _FILTER_SHARE = 0.6, 0.25
#: Dry friction is compensated by a little less than it is, so that it never drives.
_FRICTION_SHARE = 0.9
ANTI_WINDUP_PER_S = 20.0
_TICK_S = 1e-3


@dataclass(frozen=True)
class MotorFigures:
    """A motor with its gear, at the joint.

    Attributes:
        resistance_ohm: of the winding.
        constant_v_s: motor constant, V s/rad and N m/A.
        inertia_kg_m2: of rotor, gear and what it moves.
        viscous_n_m_s: friction that grows with speed, N m s/rad.
        dry_n_m: dry friction, N m.
    """

    resistance_ohm: float
    constant_v_s: float
    inertia_kg_m2: float
    viscous_n_m_s: float
    dry_n_m: float


def tuned_gains(motor: MotorFigures, supply_v: float, bandwidth_rad_s: float, damping: float = 0.8) -> Array:
    """Return the gains of a joint by the rule above.

    Args:
        motor: its motor.
        supply_v: nominal supply, V.
        bandwidth_rad_s: natural frequency of the loop's pair of poles, rad/s.
        damping: of the pair, of critical.

    Returns:
        (8,) kp, ki, kd, kv, ka, kf, derivative filter, anti-windup.

    Raises:
        InputError: a number is not positive.
    """
    needed = {"supply_v": supply_v, "bandwidth_rad_s": bandwidth_rad_s, "damping": damping}
    needed |= {name: getattr(motor, name) for name in ("resistance_ohm", "constant_v_s", "inertia_kg_m2")}
    for name, value in needed.items():
        if not value > 0:
            raise InputError(f"{name} is {value:g}; it must be positive")
    stall = motor.constant_v_s * supply_v / motor.resistance_ohm
    own = motor.constant_v_s**2 / motor.resistance_ohm + motor.viscous_n_m_s
    per_rad_s2 = motor.inertia_kg_m2 / stall
    w, share = bandwidth_rad_s, _INTEGRAL_SHARE
    kd = max((2 * damping + share) * w * per_rad_s2 - own / stall, 0.0)
    filter_s = _FILTER_SHARE / w
    return np.array(
        [
            (1 + 2 * damping * share) * w**2 * per_rad_s2,
            share * w**3 * per_rad_s2,
            kd,
            own / stall + kd,
            max(per_rad_s2 - kd * (filter_s + 0.5 * _TICK_S), 0.0),
            _FRICTION_SHARE * motor.dry_n_m / stall,
            filter_s,
            ANTI_WINDUP_PER_S,
        ]
    )


#: Between which bandwidths one is looked for.
_LEAST_RAD_S, _MOST_RAD_S = 5, 40
#: Shares of the duty: all that motion and load may take, and of what the load leaves, what steady motion may take.
_USED, _MOVING = 0.95, 0.8
_MOST_SPEED_RAD_S, _MOST_RAD_S2 = 2.0, 10.0


def quiet_bandwidth(motor: MotorFigures, supply_v: float, noise_rad: float, duty_noise: float = 0.08) -> float:
    """Return the greatest bandwidth, rad/s, at which a potentiometer's noise hardly moves the duty.

    Args:
        motor: its motor.
        supply_v: nominal supply, V.
        noise_rad: standard deviation of a reading.
        duty_noise: standard deviation of the duty that this noise may cause.
    """
    for bandwidth in range(_MOST_RAD_S, _LEAST_RAD_S, -1):
        kp, _, kd, *_, filter_s, _ = tuned_gains(motor, supply_v, bandwidth)
        share = _TICK_S / (filter_s + _TICK_S)
        speed_noise = noise_rad * share / _TICK_S * np.sqrt(2 / (2 - share))
        if np.hypot(kp * noise_rad, kd * speed_noise) <= duty_noise:
            return float(bandwidth)
    return float(_LEAST_RAD_S)


def motion_limits(motor: MotorFigures, supply_v: float, gravity_n_m: float) -> tuple[float, float]:
    """Return the greatest speed, rad/s, and acceleration, rad/s^2, that a motor reaches with duty to spare.

    Args:
        motor: its motor.
        supply_v: nominal supply, V.
        gravity_n_m: greatest torque of gravity.
    """
    stall = motor.constant_v_s * supply_v / motor.resistance_ohm
    free_rad_s = supply_v / motor.constant_v_s
    load = min((gravity_n_m + motor.dry_n_m) / stall, _MOVING)
    speed = min(max(_MOVING * (_USED - load) * free_rad_s, 0.05), _MOST_SPEED_RAD_S)
    spare = max(_USED - load - speed / free_rad_s, 0.05)
    return speed, min(max(spare * stall / motor.inertia_kg_m2, 0.5), _MOST_RAD_S2)
