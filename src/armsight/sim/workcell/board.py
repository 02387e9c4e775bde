"""The configuration of the workcell's board: tables, limits and gains, all from the nominal arm and its motors.

It is what an owner would set up: the potentiometers' ends from the drawing, gains from the inertia at the motors.
With ``J`` the inertia at the joint, ``B`` the damping of motor and friction and ``K`` the stall torque, the loop
``J q'' + (B + K kd) q' + K kp q = K kp r`` is given the natural frequency and the damping that are asked for; the
feed-forward ``kv = B / K`` compensates the motor's own voltage. The host compensates gravity (:func:`gravity_duty`).
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array
from armsight.robot.boards.codes import Reaction
from armsight.robot.boards.configuration import CONFIG, SYNC_LED_TICKS, Configuration, check_configuration, pin_number
from armsight.robot.kinematics.arm import Arm
from armsight.sim.workcell.arm import pot_travel
from armsight.sim.workcell.motors import ACCELERATION_SPARE, SUPPLY_V, Motors, Solids, gravity_torque, inertia
from armsight.sim.workcell.plant import COUNTS, HIGH_SHARE, LOW_SHARE

#: Natural frequency, rad/s, of each joint's loop; its damping; integral gain per proportional gain, 1/s; filter of the
#: speed, s. As stiff as the potentiometers' noise allows: where dry friction holds a joint that is off by little, only the
#: integral frees it, and a loop that is closed on vision meanwhile winds up and hunts.
NATURAL_RAD_S = np.array([50.0, 70.0, 80.0, 85.0, 90.0, 90.0])
DAMPING, INTEGRAL_PER_S, FILTER_S = 1.0, 8.0, 0.004
_JERK_S = 0.01  # from no acceleration to all of it; half: rougher, double: slower
_BRAKE_TICKS = 20
SYNC_LED_PIN = "PB13"
_SPEED_SPARE = 1.2  # of the reference's limit over the arm's own


def configuration(model: Arm, parts: Solids, motors: Motors, *, sync_led: bool = False) -> Configuration:
    """Return the board's configuration for a nominal arm and its motors; ``sync_led``: an LED blinks its clock."""
    config = np.zeros((), CONFIG)
    joint, travel = config["joint"], pot_travel(model)
    inertia_kg_m2 = motors.rotor_inertia + inertia(model, parts, model.home)
    damping = motors.emf_damping + motors.viscous
    gains = joint["gains"]
    gains["kp_per_rad"] = inertia_kg_m2 * NATURAL_RAD_S**2 / motors.stall_nm
    gains["ki_per_rad_s"] = INTEGRAL_PER_S * gains["kp_per_rad"]
    gains["kd_s_per_rad"] = np.maximum(2 * DAMPING * NATURAL_RAD_S * inertia_kg_m2 - damping, 0.0) / motors.stall_nm
    gains["kv_s_per_rad"] = damping / motors.stall_nm + gains["kd_s_per_rad"]
    gains["ka_s2_per_rad"] = inertia_kg_m2 / motors.stall_nm
    gains["derivative_filter_s"], gains["anti_windup_per_s"] = FILTER_S, 20.0
    pot = joint["pot"]
    pot["node_count"], pot["direction"] = 2, 1
    pot["counts"][:, :2] = np.rint(np.array([LOW_SHARE, HIGH_SHARE]) * COUNTS)
    pot["angle_rad"][:, :2] = travel
    pot["short_counts"], pot["open_counts"] = round(0.02 * COUNTS), round(0.98 * COUNTS)
    pot["jump_rad"] = 0.01 + 2e-3 * model.qd_max
    pot["frozen_rad"], pot["inverted_rad"] = 0.05, 0.1
    joint["soft_min_rad"], joint["soft_max_rad"] = model.q_min, model.q_max
    joint["speed_limit_rad_s"] = _SPEED_SPARE * model.qd_max
    joint["deceleration_rad_s2"] = model.qdd_max
    joint["acceleration_rad_s2"] = ACCELERATION_SPARE * model.qdd_max
    joint["jerk_rad_s3"] = joint["acceleration_rad_s2"] / _JERK_S
    joint["gravity_slew_per_s"] = 5.0
    motor = joint["motor"]
    motor["resistance_ohm"] = motors.resistance_ohm
    motor["constant_v_s"] = motors.gear_ratio * motors.torque_constant
    motor["apart_rad"], motor["backlash_rad"] = 0.03, 0.001
    # A narrower slew limit would cut the noise unevenly in motion, which brakes.
    joint["duty_limit"], joint["duty_slew_per_s"], joint["current_cut_per_a_s"] = 1.0, 1000.0, 20.0
    joint["current_limit_ma"] = np.rint(900.0 * motors.current_max_a)
    joint["following_rad"], joint["stall_duty"], joint["stall_rad"] = 0.15, 0.9, 0.005
    joint["motor_direction"] = 1
    config["joint_count"] = len(joint)
    config["supply_min_mv"], config["supply_max_mv"], config["supply_ticks"] = 20000, 28000, 5
    config["supply_nominal_mv"], config["overload_ticks"] = round(1e3 * SUPPLY_V), 300
    config["brake_release_ticks"] = config["brake_engage_ticks"] = _BRAKE_TICKS
    config["pot_ticks"], config["following_ticks"], config["stall_ticks"] = 5, 50, 300
    config["silence_ticks"], config["silence_reaction"] = 100, Reaction.HOLD
    config["sync_led_ticks"] = SYNC_LED_TICKS
    config["sync_led_pin"] = pin_number(SYNC_LED_PIN) if sync_led else 0
    check_configuration(config)
    return config


def gravity_duty(model: Arm, parts: Solids, motors: Motors, q: Array) -> Array:
    """Return the duty (6,) that compensates the gravity load of the nominal arm at joint angles q (6,), rad."""
    return np.asarray(np.clip(-gravity_torque(model, parts, q) / motors.stall_nm, -1.0, 1.0))
