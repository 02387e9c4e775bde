"""States: power-up, enabling, the host's silence, the emergency stop."""

import ctypes

import pytest
from firmware_arm import JOINTS, LabArm, lab_config, read_as, supply
from firmware_layout import STATES, c

from armsight.loop.sync_led import code

NAN = float("nan")


def test_power_up_is_disabled_and_only_enabling_changes_that(arm):
    for _ in range(20):
        arm.move(0.5)
        assert not arm.acknowledged()
    assert (arm.outputs.state, arm.outputs.drives_on, list(arm.outputs.duty)) == (c.STATE_DISABLED, 0, [0.0] * 6)


@pytest.mark.parametrize("angle_rad", [0.0, 1.7, -2.3])
def test_the_first_reference_is_the_measured_position(library, angle_rad):
    arm = LabArm(library, angle_rad=angle_rad)
    out = arm.enable()
    assert (out.state, out.drives_on) == (c.STATE_ENABLED, 1)
    assert list(out.reference_rad) == list(out.angle_rad)
    for i in JOINTS:  # nothing but the damping of what the converter's noise looks like
        assert abs(out.duty[i]) <= 0.1 * abs(out.speed_rad_s[i]) * 1.00001
    assert abs(out.angle_rad[0] - angle_rad) < 3e-4
    arm.tick(50)
    assert max(abs(arm.angle_rad[i] - angle_rad) for i in JOINTS) < 1e-3


def test_a_coasting_arm_is_braked_from_the_first_tick(arm):
    def coast(arm):
        arm.speed_rad_s = [0.5] * 6

    arm.spoil = coast
    out = arm.enable()
    for i in JOINTS:
        assert out.speed_rad_s[i] > 0.3
        assert out.duty[i] == pytest.approx(max(-0.1 * out.speed_rad_s[i], -0.05), abs=1e-6)  # or the slew limit


def test_enabling_again_remembers_nothing_of_the_last_motion(moving):
    moving.move(0.4, gravity=0.3)
    moving.tick(50)
    out = moving.command(c.COMMAND_DISABLE)
    assert (list(out.reference_rad), list(out.reference_rad_s)) == (list(out.angle_rad), [0.0] * 6)
    moving.tick(500)
    out = moving.command(c.COMMAND_ENABLE)
    assert max(map(abs, out.duty)) < 0.01
    assert max(map(abs, moving.tick(50).duty)) < 0.01


def test_before_a_potentiometer_is_read_the_arm_cannot_be_enabled(arm):
    arm.spoil = read_as(3, 65535)
    arm.tick(2)
    arm.command(c.COMMAND_ENABLE)
    assert (arm.acknowledged(), arm.outputs.rejection) == (False, c.REJECTION_POT_UNREAD)


@pytest.mark.parametrize("outside_rad", [2.45, -2.45])
def test_outside_its_soft_limits_the_arm_only_moves_back_in(library, outside_rad):
    arm = LabArm(library, angle_rad=outside_rad)
    arm.enable()
    assert (arm.acknowledged(), arm.outputs.rejection) == (False, c.REJECTION_OUTSIDE_LIMITS)
    arm.command(c.COMMAND_ENABLE_INWARD)
    assert arm.outputs.state == c.STATE_ENABLED
    start = arm.outputs.reference_rad[0]
    arm.move(1.5 * outside_rad)
    arm.tick(20)
    assert arm.outputs.reference_rad[0] == start
    assert arm.outputs.limited[0] & c.LIMITED_SOFT
    for _ in range(20):
        arm.move(0.98 * outside_rad, ticks=20)
        arm.tick(19)
    assert arm.outputs.reference_rad[0] == pytest.approx(0.98 * outside_rad, abs=1e-4)
    arm.move(outside_rad)
    arm.tick(50)
    assert abs(arm.outputs.reference_rad[0]) <= 0.98 * abs(outside_rad) + 1e-4  # the door has closed behind it
    for share in [0.9] * 20 + [1.0] * 20:
        arm.move(share * outside_rad, ticks=20)
        arm.tick(19)
    assert abs(arm.outputs.reference_rad[0]) == pytest.approx(2.4, abs=1e-5)
    assert abs(arm.outputs.reference_rad[0]) <= ctypes.c_float(2.4).value
    assert arm.outputs.faults == 0


def test_silence_slows_the_arm_down_within_its_deceleration_and_holds_it(moving):
    moving.wander(1000)
    moving.move(1.0, speed_rad_s=1.0, ticks=100)
    moving.tick(90)
    quiet = moving.tick(10).tick  # 100 ticks without a motion command: just within the time set
    assert moving.outputs.state == c.STATE_ENABLED
    moving.tick()
    assert moving.outputs.state == c.STATE_STOPPING
    speed = abs(moving.outputs.reference_rad_s[0])
    ticks = next(k for k in range(1, 2000) if moving.tick().state == c.STATE_HOLDING)
    assert ticks <= speed / 10.0 * 1000 + 2  # 10 rad/s^2
    assert moving.outputs.drives_on == 1
    rest = moving.outputs.reference_rad[0]
    assert moving.tick(1000).reference_rad[0] == rest
    assert abs(moving.angle_rad[0] - rest) < 0.01
    assert moving.outputs.tick > quiet


def test_only_motion_commands_feed_the_silence_timer(moving):
    for i in JOINTS:
        moving.inputs.command.gains.joint[i] = moving.config.joint[i].gains
    for _ in range(12):
        moving.command(c.COMMAND_GAINS)
        moving.tick(8)
    assert moving.acknowledged()
    assert moving.outputs.first_fault == c.FAULT_HOST_SILENT


def test_a_rejected_motion_command_does_not_feed_it_either(moving):
    for _ in range(12):
        moving.move(NAN)
        moving.tick(8)
    assert moving.outputs.first_fault == c.FAULT_HOST_SILENT


def test_a_held_arm_is_not_dropped_by_clearing(moving):
    moving.move(2.0, ticks=1)
    assert moving.outputs.limited[0] & c.LIMITED_SPEED
    moving.tick(500)
    assert moving.outputs.state == c.STATE_HOLDING
    moving.command(c.COMMAND_CLEAR_FAULTS)
    assert not moving.outputs.limited[0] & c.LIMITED_SPEED
    held = [*moving.outputs.reference_rad]
    assert (moving.outputs.state, moving.outputs.drives_on) == (c.STATE_HOLDING, 1)
    moving.move(0.1)
    assert not moving.acknowledged()
    moving.command(c.COMMAND_ENABLE)
    assert moving.outputs.state == c.STATE_ENABLED
    assert [*moving.outputs.reference_rad] == held
    moving.move(0.1)
    assert moving.acknowledged()


def test_while_it_slows_down_a_fault_cannot_be_cleared_and_a_worse_one_releases(moving):
    moving.move(1.0, speed_rad_s=1.5, ticks=100)
    moving.tick(101)
    assert moving.outputs.state == c.STATE_STOPPING
    moving.command(c.COMMAND_CLEAR_FAULTS)
    assert (moving.acknowledged(), moving.outputs.rejection) == (False, c.REJECTION_WRONG_STATE)
    moving.inputs.overrun = 1
    moving.tick()
    moving.inputs.overrun = 0
    assert moving.outputs.state == c.STATE_STOPPING
    moving.spoil = read_as(0, 65535)
    moving.tick(5)
    assert moving.outputs.state == c.STATE_STOPPING  # that joint is let go of, its windings shorted
    assert (moving.outputs.duty[0], moving.outputs.drives_on) == (0.0, 1)
    moving.spoil = supply(0)
    moving.tick(5)
    assert (moving.outputs.state, moving.outputs.windings_shorted) == (c.STATE_FAULTED, 1)
    assert moving.outputs.first_fault == c.FAULT_HOST_SILENT
    codes = (c.FAULT_HOST_SILENT, c.FAULT_TICK_OVERRUN, c.FAULT_POT_OPEN, c.FAULT_SUPPLY_LOW)
    assert moving.outputs.faults == sum(1 << code for code in codes)


def test_a_stop_after_a_fault_stays_on_the_path_and_all_joints_come_to_rest_together(moving):
    rates = [1.5, -0.75, 0.3, 0.6, -1.2, 0.9]
    move = moving.inputs.command.move
    for i in JOINTS:
        move.position_rad[i], move.speed_rad_s[i] = moving.outputs.reference_rad[i] + 0.3 * rates[i], rates[i]
    move.duration_ticks = 300
    moving.command(c.COMMAND_MOVE)
    while moving.outputs.state == c.STATE_ENABLED:
        moving.tick()
    start, rates = [*moving.outputs.reference_rad], [*moving.outputs.reference_rad_s]
    moving.tick(60)
    shares = [(moving.outputs.reference_rad[i] - start[i]) / rates[i] for i in JOINTS]
    assert max(shares) - min(shares) < 1e-2 * max(shares)
    while moving.outputs.state == c.STATE_STOPPING:
        moving.tick()
    assert [*moving.outputs.reference_rad_s] == [0.0] * 6


def test_brakes_open_before_the_arm_moves_and_close_before_it_is_let_go(library):
    config = lab_config(library)
    config.brake_release_ticks, config.brake_engage_ticks = 30, 40
    arm = LabArm(library, config)
    assert arm.tick().brakes_open == 0
    out = arm.enable()
    assert (out.brakes_open, out.drives_on) == (1, 1)
    start = out.reference_rad[0]
    arm.move(0.5)
    assert arm.tick(27).reference_rad[0] == start
    assert arm.tick(20).reference_rad[0] > start
    out = arm.command(c.COMMAND_DISABLE)
    assert (out.brakes_open, out.drives_on) == (0, 1)
    arm.move(0.6)
    assert not arm.acknowledged()
    assert arm.tick(30).drives_on == 1
    out = arm.tick(20)
    assert (out.state, out.drives_on, out.windings_shorted) == (c.STATE_DISABLED, 0, 1)


def test_a_board_that_has_driven_nothing_yet_lets_the_arm_be_moved_by_hand(arm):
    assert (arm.tick(5).windings_shorted, arm.outputs.drives_on) == (0, 0)


def into(arm, state):
    """Bring a fresh arm into a state."""
    if state == "DISABLED":
        arm.tick(20)
    elif state == "FAULTED":
        arm.enable()
        arm.spoil = supply(0)
        arm.tick(10)
        arm.spoil = supply(12000)
    else:
        arm.enable()
        arm.wander(200)
        if state == "STOPPING":
            arm.tick(101)
        elif state == "HOLDING":
            arm.tick(500)
        elif state == "STOPPED":
            arm.inputs.stop_pressed = 1
            arm.tick()
            arm.inputs.stop_pressed = 0
    assert arm.tick().state == STATES[state]


@pytest.mark.parametrize("state", STATES)
def test_the_emergency_stop_works_in_every_state_and_is_cleared_only_explicitly(arm, state):
    into(arm, state)
    faults = arm.outputs.faults
    arm.inputs.stop_pressed = 1
    out = arm.tick()
    assert (out.state, out.drives_on, list(out.duty)) == (c.STATE_STOPPED, 0, [0.0] * 6)
    arm.command(c.COMMAND_CLEAR_STOP)
    assert (arm.acknowledged(), arm.outputs.rejection) == (False, c.REJECTION_STOP_PRESSED)
    arm.inputs.stop_pressed = 0
    arm.tick(1000)
    for kind in (c.COMMAND_MOVE, c.COMMAND_ENABLE, c.COMMAND_ENABLE_INWARD, c.COMMAND_DISABLE, c.COMMAND_CLEAR_FAULTS):
        arm.command(kind)
        assert (arm.acknowledged(), arm.outputs.rejection) == (False, c.REJECTION_WRONG_STATE)
        assert arm.outputs.state == c.STATE_STOPPED
    arm.command(c.COMMAND_CLEAR_STOP)
    assert arm.acknowledged()
    assert arm.outputs.faults == faults  # the stop hides no fault
    assert arm.outputs.state == (c.STATE_FAULTED if faults else c.STATE_DISABLED)


def test_a_stop_beats_an_enable_in_the_same_tick(arm):
    arm.tick(20)
    arm.inputs.stop_pressed = 1
    arm.command(c.COMMAND_ENABLE)
    assert arm.outputs.state == c.STATE_STOPPED


def test_a_fault_during_a_stop_is_latched_beneath_it(arm):
    into(arm, "STOPPED")
    arm.spoil = read_as(0, 0)
    arm.tick(10)
    assert (arm.outputs.state, arm.outputs.first_fault) == (c.STATE_STOPPED, c.FAULT_POT_SHORT)


@pytest.mark.parametrize("state", STATES)
def test_disabling_works_in_every_state_but_the_stop(arm, state):
    into(arm, state)
    arm.command(c.COMMAND_DISABLE)
    assert arm.acknowledged() == (state != "STOPPED")
    assert arm.outputs.drives_on == 0
    if state in ("STOPPING", "HOLDING", "FAULTED"):
        assert arm.outputs.state == c.STATE_FAULTED


def test_joints_that_are_not_there_are_not_looked_at(library):
    config = lab_config(library)
    config.joint_count = 3
    for joint in (3, 4, 5):
        config.joint[joint] = c.joint_config()
    arm = LabArm(library, config)
    arm.spoil = lambda arm: arm.inputs.counts.__setitem__(slice(3, 6), [0, 65535, 0])
    arm.enable()
    out = arm.wander(300)
    assert (out.state, out.faults) == (c.STATE_ENABLED, 0)
    assert all(out.duty[joint] != 0 for joint in range(3))
    assert not any(out.duty[joint] or out.angle_rad[joint] or out.reference_rad[joint] for joint in (3, 4, 5))


def test_the_sync_led_shows_its_code_where_it_has_a_pin(library):
    config = lab_config(library)
    config.sync_led_pin, config.sync_led_ticks = 29, 3
    shown = [library.sync_led_on(ctypes.byref(config), tick) for tick in range(4 * 511 * 3)]
    assert shown == [bool(bit) for bit in code() for _ in range(3)] * 4
    config.sync_led_pin = 0
    assert not any(library.sync_led_on(ctypes.byref(config), tick) for tick in range(30))
