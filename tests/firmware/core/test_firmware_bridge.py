"""Bridges, motors and current sensors: what drives by itself sleeps, what is warm is followed, what is wrong is named."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from firmware_layout import c

from armsight.robot.boards.codes import BoardState, Fault

FOLDER = Path(__file__).resolve().parents[3] / "benchmarks"
SEEDS = range(800, 803)


@pytest.fixture(scope="module")
def motors():
    """The benchmark's module."""
    sys.path.insert(0, str(FOLDER))
    spec = importlib.util.spec_from_file_location("board_motors", FOLDER / "board_motors.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    sys.path.remove(str(FOLDER))
    return module


def at_rest(motors, library, seed, *, brake=0.0):
    arm = motors.drawn_arm(library, seed, brake=brake)
    arm.enable()
    arm.swing(1200)
    arm.rest(600)
    assert arm.first == (None, None)
    return arm


def asleep(arm):
    return not arm.out[0]["drives_on"] and not arm.out[0]["windings_shorted"]


@pytest.mark.parametrize("share", [-1.0, -0.5, 0.5, 1.0])
def test_a_bridge_that_drives_by_itself_puts_all_drives_to_sleep(motors, library, share):
    for seed in SEEDS:
        arm = at_rest(motors, library, seed)
        arm.plant.stuck[3] = share
        arm.rest_on(100)
        assert arm.first == (Fault.BRIDGE, 3)
        assert asleep(arm)
        assert arm.out[0]["state"] == BoardState.FAULTED


@pytest.mark.parametrize("share", [-1.0, 0.4])
def test_an_emergency_stop_of_a_stuck_bridge_is_one_by_sleep_and_brake(motors, library, share):
    for seed in SEEDS:
        arm = at_rest(motors, library, seed, brake=motors.BRAKE_N_M)
        at = arm.plant.link[3]
        arm.plant.stuck[3], arm.inputs.stop_pressed = share, 1
        arm.tick(60)
        assert asleep(arm)
        arm.tick(500)
        assert arm.out[0]["state"] == BoardState.STOPPED
        assert abs(arm.plant.link[3] - at) < 0.1


def test_an_emergency_stop_brakes_by_shorted_windings_and_ends_asleep(motors, library):
    arm = at_rest(motors, library, 800)
    arm.inputs.stop_pressed = 1
    out = arm.tick(100)
    assert (out["windings_shorted"], out["brakes_open"]) == (1, 0)
    arm.tick(201)
    assert asleep(arm)
    assert arm.first == (None, None)


@pytest.mark.parametrize("share", [0.8, 1.4])
def test_windings_that_warm_or_cool_are_followed(motors, library, share):
    for seed in SEEDS:
        arm = at_rest(motors, library, seed)
        cold = arm.plant._model[0].copy()
        for k in range(1, 101):
            arm.plant._model[0] = cold * (1 + (share - 1) * k / 100)
            arm.rest(200)
        assert arm.first == (None, None)
        loaded = np.abs(arm.model.gravity_n_m * np.cos(arm.plant.link)) > 0.8
        seen = [joint.motor.resistance_scale for joint in arm.core.joint]
        true = arm.plant._model[0] / 6.0 / arm.model.current_gain
        assert seen == pytest.approx(true, rel=0.05) if loaded.all() else np.abs(seen / true - 1)[loaded].max() < 0.05


def test_a_current_that_is_off_from_the_start_is_zeroed_while_the_bridges_sleep(motors, library):
    arm = motors.drawn_arm(library, 805)
    arm.plant.offset_a[:] = (1.0, -1.0, 0.5, -0.5, 0.2, -0.2)
    arm.tick(100)
    arm.enable()
    arm.swing(2000)
    assert arm.first == (None, None)


def test_a_current_sensor_is_named_and_its_joint_held(motors, library):
    for seed in SEEDS:
        arm = at_rest(motors, library, seed)
        joint = int(np.argmax(np.abs(arm.model.gravity_n_m * np.cos(arm.plant.link))))
        motors.offset(arm, joint)
        arm.rest_on(1200)
        arm.tick(90)
        assert arm.first == (Fault.CURRENT_SENSOR, joint)
        assert arm.out[0]["drives_on"]
        assert abs(arm.plant.link[joint] - arm.out[0]["reference_rad"][joint]) < 0.03
        arm.command(c.COMMAND_CLEAR_FAULTS)  # without its witness it is held, and no more
        assert arm.out[0]["rejection"] == c.REJECTION_FAULT_STANDS


def test_a_weak_motor_is_named_and_its_joint_held(motors, library):
    arm, joint = motors.drawn_arm(library, 808, load=0.2), 2
    arm.enable()
    motors.until_moving(arm, joint)
    arm.plant._model[1, joint] *= 0.6
    arm.swing(2000, stop_at_fault=False)
    assert arm.first == (Fault.MOTOR, joint)
    assert arm.out[0]["drives_on"]
    assert abs(arm.plant.link[joint] - arm.out[0]["reference_rad"][joint]) < 0.1


def test_a_current_that_flows_asleep_is_its_sensors_error(motors, library):
    arm = at_rest(motors, library, 801)
    arm.plant.blocked[:] = True
    arm.command(c.COMMAND_DISABLE)
    arm.tick(50)
    arm.plant.offset_a[4] = 0.9
    arm.tick(200)
    assert asleep(arm)
    assert arm.first == (Fault.CURRENT_SENSOR, 4)
