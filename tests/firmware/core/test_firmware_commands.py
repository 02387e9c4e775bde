"""Commands, acknowledged or rejected; limits that are no faults; the core's own soundness."""

import ctypes

import pytest
from firmware_arm import JOINTS, LabArm, lab_config, supply, twin_of
from firmware_layout import c

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize("value", [NAN, INF, -INF])
@pytest.mark.parametrize("field", ["position_rad", "speed_rad_s", "gravity_duty"])
def test_a_number_that_is_none_is_rejected_and_changes_nothing(moving, field, value):
    moving.move(0.1)
    acknowledged = moving.outputs.acknowledged_sequence
    twin = twin_of(moving)
    getattr(moving.inputs.command.move, field)[3] = value
    moving.command(c.COMMAND_MOVE)
    twin.tick()  # the same tick without a command
    assert (moving.acknowledged(), moving.outputs.rejection) == (False, c.REJECTION_NOT_FINITE)
    assert moving.outputs.acknowledged_sequence == acknowledged
    assert bytes(moving.core.joint) == bytes(twin.core.joint)


@pytest.mark.parametrize(("gravity", "ticks"), [(1.01, 10), (-1.01, 10), (0.0, 0), (0.0, 10001), (0.0, 2**32 - 1)])
def test_a_number_out_of_its_range_is_rejected(moving, gravity, ticks):
    moving.move(0.1, gravity=gravity, ticks=ticks)
    assert (moving.acknowledged(), moving.outputs.rejection) == (False, c.REJECTION_OUT_OF_RANGE)


def test_an_unknown_command_is_rejected(moving):
    moving.command(99)
    assert (moving.acknowledged(), moving.outputs.rejection) == (False, c.REJECTION_UNKNOWN_COMMAND)
    assert moving.outputs.state == c.STATE_ENABLED


def test_a_fault_whose_cause_stands_cannot_be_cleared(moving):
    moving.spoil = supply(0)
    moving.tick(10)
    moving.command(c.COMMAND_CLEAR_FAULTS)
    assert (moving.acknowledged(), moving.outputs.rejection) == (False, c.REJECTION_FAULT_STANDS)


def test_every_command_is_counted_as_acknowledged_or_rejected(moving):
    before = moving.outputs.acknowledged_count, moving.outputs.rejected_count
    kinds = [c.COMMAND_MOVE, 99, c.COMMAND_ENABLE, c.COMMAND_DISABLE, c.COMMAND_CLEAR_FAULTS, c.COMMAND_CLEAR_STOP]
    reported = [(moving.command(kind), moving.acknowledged())[1] for kind in kinds]
    assert reported == [True, False, False, True, True, False]
    assert (moving.outputs.acknowledged_count, moving.outputs.rejected_count) == (before[0] + 3, before[1] + 3)


GAIN_FIELDS = [name for name, _ in c.joint_gains._fields_]


@pytest.mark.parametrize(
    ("joint", "field", "value", "rejection"),
    [(k % 6, field, [NAN, INF, -INF][k % 3], c.REJECTION_NOT_FINITE) for k, field in enumerate(GAIN_FIELDS)]
    + [((5 - k) % 6, field, [-0.1, 1001.0][k % 2], c.REJECTION_OUT_OF_RANGE) for k, field in enumerate(GAIN_FIELDS)],
)
def test_a_gain_set_is_taken_whole_or_not_at_all(moving, joint, field, value, rejection):
    before = [bytes(entry.gains) for entry in moving.core.config.joint]
    gains = moving.inputs.command.gains
    for i in JOINTS:
        gains.joint[i] = c.joint_gains(5, 6, 0.05, 0.1, 0.0, 0.0, 0.01, 10)
    setattr(gains.joint[joint], field, value)
    moving.command(c.COMMAND_GAINS)
    assert (moving.acknowledged(), moving.outputs.rejection) == (False, rejection)
    assert [bytes(entry.gains) for entry in moving.core.config.joint] == before
    gains.joint[joint] = c.joint_gains(5, 6, 0.05, 0.1, 0.0, 0.0, 0.01, 10)
    moving.command(c.COMMAND_GAINS)
    assert moving.acknowledged()
    assert len({bytes(entry.gains) for entry in moving.core.config.joint}) == 1


def test_a_change_of_gains_in_motion_does_not_jerk_the_arm(moving):
    moving.move(0.5, speed_rad_s=0.5, ticks=100)
    before = c.core_outputs.from_buffer_copy(moving.tick(50))
    twin = twin_of(moving)
    for i in JOINTS:
        moving.inputs.command.gains.joint[i] = c.joint_gains(12.0, 20.0, 0.1, 0.5, 0.0, 0.0, 0.005, 20.0)
    changed, unchanged = moving.command(c.COMMAND_GAINS), twin.tick()
    for i in JOINTS:
        error = changed.reference_rad[i] - changed.angle_rad[i] - before.reference_rad[i] + before.angle_rad[i]
        rate = changed.reference_rad_s[i] - before.reference_rad_s[i]
        # Only what has changed since the last tick meets the new gains.
        assert changed.duty[i] - unchanged.duty[i] == pytest.approx(8.0 * error + 0.3 * rate, abs=1e-5)
    assert changed.faults == 0


def test_a_target_beyond_the_soft_limit_ends_at_it(moving):
    for _ in range(400):
        moving.move(3.0, speed_rad_s=1.0)
        moving.tick(9)
    assert moving.outputs.reference_rad[0] == pytest.approx(2.4, abs=1e-5)
    assert moving.outputs.reference_rad[0] <= ctypes.c_float(2.4).value
    assert moving.outputs.limited[0] & c.LIMITED_SOFT
    assert max(moving.angle_rad) < 2.4 + 0.01
    assert moving.outputs.faults == 0


def test_a_target_beyond_the_soft_limit_is_reached_at_rest(library):
    config = lab_config(library)
    config.silence_ticks = 1000
    arm = LabArm(library, config, angle_rad=2.2)
    arm.enable()
    arm.move(3.0, speed_rad_s=1.0, ticks=90)
    speeds = []
    while arm.outputs.reference_rad[0] < 2.4 - 1e-4:
        left_rad = 2.4 - arm.outputs.reference_rad[0]
        assert arm.tick().state == c.STATE_ENABLED
        speeds.append(arm.outputs.reference_rad_s[0])
        # It can always stop before the limit: v^2 = 2 a d.
        assert speeds[-1] ** 2 <= 2 * 10.0 * left_rad + 1e-6
    assert max(speeds) > 1.0


def test_a_reference_that_runs_on_stops_at_the_soft_limit(library):
    config = lab_config(library)
    config.silence_ticks = 1000
    arm = LabArm(library, config, angle_rad=2.2)
    arm.enable()
    arm.move(2.39, speed_rad_s=1.0, ticks=300)
    arm.tick(350)
    assert arm.outputs.limited[0] & c.LIMITED_SOFT
    arm.tick(200)
    assert arm.outputs.state == c.STATE_ENABLED
    assert arm.outputs.reference_rad[0] == pytest.approx(2.4, abs=1e-4)
    assert arm.outputs.reference_rad_s[0] == pytest.approx(0.0, abs=1e-3)
    assert arm.outputs.limited[0] & c.LIMITED_SOFT


def test_a_jump_of_the_target_is_travelled_at_the_speed_limit(moving):
    moving.wander(500, amplitude_rad=0.0)
    speeds = []
    for _ in range(200):
        moving.move(-1.5)
        assert moving.outputs.limited[0] & c.LIMITED_SPEED or abs(moving.outputs.reference_rad[0] + 1.5) < 0.2
        moving.tick(9)
        speeds.append(abs(moving.outputs.reference_rad_s[0]))
    assert max(speeds) <= 2.0 * (1 + 1e-4)
    assert max(speeds) > 1.9
    assert moving.angle_rad[0] == pytest.approx(-1.5, abs=0.01)
    assert moving.outputs.faults == 0


def test_a_speed_beyond_the_limit_is_cut_and_reported(moving):
    moving.move(0.0, speed_rad_s=9.0, ticks=200)
    assert moving.outputs.limited[0] & c.LIMITED_SPEED
    assert moving.tick(200).reference_rad_s[0] <= 2.0


def test_too_much_current_takes_duty_away_and_gives_it_back(moving):
    moving.core.config.overload_ticks = 10000
    moving.core.crc, moving.core.crc_at, moving.core.crc_known = 0xFFFFFFFF, 0, 0
    moving.wander(1000, amplitude_rad=0.0)
    duties, reported = {}, {}
    for milliamperes in (1000, 1500, 0):
        for i in JOINTS:
            moving.inputs.current_ma[i] = milliamperes
        moving.wander(2000, amplitude_rad=0.14)
        # 0.5 A beyond the limit take 2.5 duty per second, so that nothing is left of 0.8 after 0.32 s.
        outputs = [c.core_outputs.from_buffer_copy(raw) for raw in moving.history[-1500:]]
        duties[milliamperes] = max(abs(out.duty[0]) for out in outputs)
        reported[milliamperes] = any(out.limited[0] & c.LIMITED_CURRENT for out in outputs)
    assert duties[1500] == 0.0
    assert reported == {1000: False, 1500: True, 0: False}
    assert duties[0] == pytest.approx(duties[1000], rel=0.2)
    assert moving.outputs.faults == 0


def test_a_motor_wired_the_other_way_is_reversed_by_its_configuration(library):
    config = lab_config(library)
    config.joint[0].motor_direction = -1
    arm = LabArm(library, config)
    arm.enable()
    arm.move(0.5, ticks=100)
    arm.tick(50)
    assert arm.outputs.duty[0] < -0.01
    assert arm.outputs.duty[1] > 0.01
    arm.tick(2000)
    assert arm.outputs.joint_faults[0]  # this plant is not wired that way: the joint ran away, and was caught
    assert abs(arm.angle_rad[0]) < 0.2


def test_everything_in_the_outputs_is_written(moving):
    twin = twin_of(moving)
    moving.spoil = lambda arm: ctypes.memset(ctypes.byref(arm.outputs), 0xA5, ctypes.sizeof(arm.outputs))
    assert bytes(moving.tick()) == bytes(twin.tick())


@pytest.mark.parametrize("guard", ["guard_head", "guard_tail"])
def test_a_spoilt_state_switches_the_drives_off_and_starves_the_watchdog(moving, guard):
    assert moving.outputs.feed_watchdog == 1
    setattr(moving.core, guard, 0)
    out = moving.tick()
    assert (out.drives_on, out.feed_watchdog, list(out.duty), out.state) == (0, 0, [0.0] * 6, c.STATE_STOPPED)


def test_the_tick_counter_may_wrap(arm):
    arm.inputs.tick = 2**32 - 30
    arm.enable()
    arm.wander(100)
    assert (arm.outputs.state, arm.outputs.faults) == (c.STATE_ENABLED, 0)
