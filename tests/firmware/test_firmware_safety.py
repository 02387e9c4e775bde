"""States, faults and refusals: each one comes when it must, does what it must, and stays away when it must not."""

import ctypes
import re
from pathlib import Path

import pytest
from firmware_arm import JOINTS, LabArm, lab_config
from firmware_layout import FAULTS, REACTIONS, REFUSALS, STATES, c

DOC = Path(__file__).resolve().parents[2] / "docs" / "firmware.md"
NAN, INF = float("nan"), float("inf")
REACTION_STATE = {"RELEASE": c.STATE_FAULTED, "HOLD": c.STATE_STOPPING}


def read_as(joint, counts):
    def spoil(arm):
        arm.inputs.counts[joint] = counts

    return spoil


def freeze(joint):
    def spoil(arm):
        spoil.counts = getattr(spoil, "counts", arm.inputs.counts[joint])
        arm.inputs.counts[joint] = spoil.counts

    return spoil


def shift(joint, counts):
    def spoil(arm):
        arm.inputs.counts[joint] += counts

    return spoil


def invert(joint):
    def spoil(arm):
        spoil.middle = getattr(spoil, "middle", arm.inputs.counts[joint])
        arm.inputs.counts[joint] = max(0, min(65535, 2 * spoil.middle - arm.inputs.counts[joint]))

    return spoil


def spoiling(spoil, ticks):
    """A way to provoke a fault: spoil the inputs while the arm follows a sine."""

    def provoke(arm):
        arm.spoil = spoil
        arm.wander(ticks)

    return provoke


def supply(millivolts):
    def spoil(arm):
        arm.inputs.supply_mv = millivolts

    return spoil


def lose_tick(arm):
    arm.inputs.tick += 1
    arm.tick()


def overrun(arm):
    arm.inputs.overrun = 1
    arm.tick()
    arm.inputs.overrun = 0


def block(short_rad):
    """Block the arm and ask it for a place so far away."""

    def provoke(arm):
        arm.blocked = True
        target = arm.angle_rad[0] + short_rad
        for _ in range(50):
            arm.move(target)
            arm.tick(9)

    return provoke


def fall_silent(arm):
    arm.tick(101)


#: Fault -> (how to provoke it on a moving arm, the joint it must name).
PROVOKE = {
    "POT_OPEN": (spoiling(read_as(2, 65535), 20), 2),
    "POT_SHORT": (spoiling(read_as(5, 12), 20), 5),
    "POT_FROZEN": (spoiling(freeze(1), 1000), 1),
    "POT_JUMP": (spoiling(shift(3, 2000), 20), 3),
    "POT_INVERTED": (spoiling(invert(4), 1000), 4),
    "FOLLOWING": (block(1.2), 0),
    "STALL": (block(0.25), 0),
    "HOST_SILENT": (fall_silent, c.NO_JOINT),
    "SUPPLY_LOW": (spoiling(supply(9999), 10), c.NO_JOINT),
    "SUPPLY_HIGH": (spoiling(supply(14001), 10), c.NO_JOINT),
    "TICK_MISSED": (lose_tick, c.NO_JOINT),
    "TICK_OVERRUN": (overrun, c.NO_JOINT),
}
AT_START = {"WATCHDOG": {"watchdog": True}, "CONFIG": {"source": c.CONFIG_FACTORY}}


@pytest.fixture
def moving(arm):
    """An arm that follows a sine without a fault."""
    arm.enable()
    arm.wander(500)
    assert (arm.outputs.state, arm.outputs.faults) == (c.STATE_ENABLED, 0)
    return arm


def first_tick_of(arm, fault):
    """The outputs of the tick in which a fault was latched."""
    outputs = [c.core_outputs.from_buffer_copy(raw) for raw in arm.history]
    return next(out for out in outputs if out.faults & 1 << fault)


def test_every_fault_is_provoked_here():
    assert {*PROVOKE, *AT_START} == set(FAULTS)


@pytest.mark.parametrize("reaction", [c.REACTION_HOLD, c.REACTION_RELEASE], ids=["hold", "release"])
@pytest.mark.parametrize("name", PROVOKE)
def test_a_fault_latches_names_its_joint_and_reacts(library, name, reaction):
    config = lab_config(library)
    config.silence_reaction = reaction
    arm = LabArm(library, config)
    arm.enable()
    arm.wander(200)
    provoke, joint = PROVOKE[name]
    provoke(arm)
    out = first_tick_of(arm, FAULTS[name])
    assert (out.first_fault, out.first_joint) == (FAULTS[name], joint)
    assert [bool(out.joint_faults[i] & 1 << FAULTS[name]) for i in JOINTS][:1] == [joint == 0]
    if joint != c.NO_JOINT:
        assert out.joint_faults[joint] & 1 << FAULTS[name]
    chosen = "RELEASE" if reaction == c.REACTION_RELEASE else "HOLD"
    expected = REACTION_STATE[chosen if REACTIONS[name] == "CHOSEN" else REACTIONS[name]]
    assert out.state == expected
    if expected == c.STATE_FAULTED:
        assert (out.drives_on, list(out.duty)) == (0, [0.0] * 6)  # in the very tick
    # It stays latched when its cause is gone, and nothing but a clear takes it away.
    arm.spoil, arm.blocked, arm.inputs.supply_mv = lambda arm: None, False, 12000
    arm.move(0.1)
    assert not arm.obeyed()
    arm.command(c.COMMAND_ENABLE)
    assert not arm.obeyed()
    assert arm.tick(3000).state in (c.STATE_FAULTED, c.STATE_HOLDING)
    assert arm.outputs.faults & 1 << FAULTS[name]
    arm.command(c.COMMAND_CLEAR_FAULTS)
    assert arm.obeyed()
    assert (arm.outputs.faults, arm.outputs.first_fault, list(arm.outputs.joint_faults)) == (0, 0, [0] * 6)


@pytest.mark.parametrize("name", AT_START)
def test_a_fault_of_the_start_keeps_the_arm_off(library, name):
    arm = LabArm(library, **AT_START[name])
    out = arm.enable()
    assert not arm.obeyed()
    assert (out.state, out.first_fault, out.drives_on) == (c.STATE_FAULTED, FAULTS[name], 0)
    arm.command(c.COMMAND_CLEAR_FAULTS)
    assert arm.obeyed() == (name == "WATCHDOG")


def jitter(joint, counts):
    """Off by so many counts in four ticks out of six: one short of the five that count."""

    def spoil(arm):
        if arm.inputs.tick % 6 < 4:
            arm.inputs.counts[joint] = counts

    return spoil


def dip(millivolts):
    def spoil(arm):
        arm.inputs.supply_mv = millivolts if arm.inputs.tick % 6 < 4 else 12000

    return spoil


@pytest.mark.parametrize(
    "spoil",
    [jitter(2, 65535), jitter(2, 0), jitter(2, 50000), dip(0), dip(30000), supply(10000), supply(14000), shift(0, 20)],
    ids=["open", "short", "jump", "dip", "surge", "least supply", "most supply", "offset"],
)
def test_what_is_short_or_within_bounds_is_no_fault(moving, spoil):
    moving.spoil = spoil
    moving.wander(600)
    assert (moving.outputs.state, moving.outputs.faults) == (c.STATE_ENABLED, 0)


def test_an_arm_at_rest_with_still_readings_is_not_frozen(moving):
    moving.wander(1500, amplitude_rad=0.0)
    moving.spoil = lambda arm: arm.inputs.counts.__setitem__(slice(None), [32768] * 6)
    moving.wander(1000, amplitude_rad=0.0)
    assert moving.outputs.faults == 0


def test_a_short_block_is_no_stall_and_no_following_error(moving):
    moving.blocked = True
    moving.wander(40)
    moving.blocked = False
    moving.wander(500)
    assert moving.outputs.faults == 0


def test_a_hard_brake_is_no_inversion(moving):
    for to in (0.8, -0.8, 0.8, -0.8):
        for _ in range(30):
            moving.move(to)
            moving.tick(9)
    assert moving.outputs.faults == 0


# --- power-up and enabling -------------------------------------------------------------------------------------------


def test_power_up_is_disabled_and_only_enabling_changes_that(arm):
    for _ in range(20):
        arm.move(0.5)
        assert not arm.obeyed()
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


def test_before_a_potentiometer_is_read_the_arm_cannot_be_enabled(arm):
    arm.spoil = read_as(3, 65535)
    arm.tick(2)
    arm.command(c.COMMAND_ENABLE)
    assert (arm.obeyed(), arm.outputs.refusal) == (False, c.REFUSAL_POT_UNREAD)


@pytest.mark.parametrize("outside_rad", [2.45, -2.45])
def test_outside_its_soft_limits_the_arm_only_moves_back_in(library, outside_rad):
    arm = LabArm(library, angle_rad=outside_rad)
    arm.enable()
    assert (arm.obeyed(), arm.outputs.refusal) == (False, c.REFUSAL_OUTSIDE_LIMITS)
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
    assert arm.outputs.reference_rad[0] == pytest.approx(0.98 * outside_rad, abs=1e-6)
    arm.move(outside_rad)
    arm.tick(50)
    assert abs(arm.outputs.reference_rad[0]) <= 0.98 * abs(outside_rad) + 1e-6  # the door has closed behind it
    for share in [0.9] * 20 + [1.0] * 20:
        arm.move(share * outside_rad, ticks=20)
        arm.tick(19)
    assert abs(arm.outputs.reference_rad[0]) == ctypes.c_float(2.4).value
    assert arm.outputs.faults == 0


# --- host silence ----------------------------------------------------------------------------------------------------


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
    assert moving.obeyed()
    assert moving.outputs.first_fault == c.FAULT_HOST_SILENT


def test_a_refused_motion_command_does_not_feed_it_either(moving):
    for _ in range(12):
        moving.move(NAN)
        moving.tick(8)
    assert moving.outputs.first_fault == c.FAULT_HOST_SILENT


def test_a_held_arm_is_not_dropped_by_clearing(moving):
    moving.tick(500)
    assert moving.outputs.state == c.STATE_HOLDING
    moving.command(c.COMMAND_CLEAR_FAULTS)
    assert (moving.outputs.state, moving.outputs.drives_on) == (c.STATE_ENABLED, 1)
    moving.move(0.1)
    assert moving.obeyed()


def test_while_it_slows_down_a_fault_cannot_be_cleared_and_a_worse_one_releases(moving):
    moving.move(1.0, speed_rad_s=1.5, ticks=100)
    moving.tick(101)
    assert moving.outputs.state == c.STATE_STOPPING
    moving.command(c.COMMAND_CLEAR_FAULTS)
    assert (moving.obeyed(), moving.outputs.refusal) == (False, c.REFUSAL_WRONG_STATE)
    overrun(moving)
    assert moving.outputs.state == c.STATE_STOPPING
    moving.spoil = read_as(0, 65535)
    moving.tick(5)
    assert moving.outputs.state == c.STATE_FAULTED
    assert moving.outputs.first_fault == c.FAULT_HOST_SILENT
    assert moving.outputs.faults == 1 << c.FAULT_HOST_SILENT | 1 << c.FAULT_TICK_OVERRUN | 1 << c.FAULT_POT_OPEN


# --- emergency stop --------------------------------------------------------------------------------------------------


def into(arm, state):
    """Bring a fresh arm into a state."""
    if state == "DISABLED":
        arm.tick(20)
    elif state == "FAULTED":
        arm.enable()
        spoiling(supply(0), 10)(arm)
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
    assert (arm.obeyed(), arm.outputs.refusal) == (False, c.REFUSAL_STOP_PRESSED)
    arm.inputs.stop_pressed = 0
    arm.tick(1000)
    for kind in (c.COMMAND_MOVE, c.COMMAND_ENABLE, c.COMMAND_ENABLE_INWARD, c.COMMAND_DISABLE, c.COMMAND_CLEAR_FAULTS):
        arm.command(kind)
        assert (arm.obeyed(), arm.outputs.refusal) == (False, c.REFUSAL_WRONG_STATE)
        assert arm.outputs.state == c.STATE_STOPPED
    arm.command(c.COMMAND_CLEAR_STOP)
    assert arm.obeyed()
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
    assert arm.obeyed() == (state != "STOPPED")
    assert arm.outputs.drives_on == 0
    if state in ("STOPPING", "HOLDING", "FAULTED"):
        assert arm.outputs.state == c.STATE_FAULTED


# --- commands --------------------------------------------------------------------------------------------------------


def twin_of(arm):
    """A second arm in the very same condition."""
    twin = LabArm(arm.library)
    for name in ("core", "inputs", "outputs"):
        record = getattr(arm, name)
        setattr(twin, name, type(record).from_buffer_copy(record))
    twin.angle_rad, twin.speed_rad_s = [*arm.angle_rad], [*arm.speed_rad_s]
    return twin


@pytest.mark.parametrize("value", [NAN, INF, -INF])
@pytest.mark.parametrize("field", ["position_rad", "speed_rad_s", "gravity_duty"])
def test_a_number_that_is_none_is_refused_and_changes_nothing(moving, field, value):
    moving.move(0.1)
    obeyed = moving.outputs.obeyed_sequence
    twin = twin_of(moving)
    getattr(moving.inputs.command.move, field)[3] = value
    moving.command(c.COMMAND_MOVE)
    twin.tick()  # the same tick without a command
    assert (moving.obeyed(), moving.outputs.refusal) == (False, c.REFUSAL_NOT_FINITE)
    assert moving.outputs.obeyed_sequence == obeyed
    assert bytes(moving.core.joint) == bytes(twin.core.joint)


@pytest.mark.parametrize(("gravity", "ticks"), [(1.01, 10), (-1.01, 10), (0.0, 0), (0.0, 10001), (0.0, 2**32 - 1)])
def test_a_number_out_of_its_range_is_refused(moving, gravity, ticks):
    moving.move(0.1, gravity=gravity, ticks=ticks)
    assert (moving.obeyed(), moving.outputs.refusal) == (False, c.REFUSAL_OUT_OF_RANGE)


def test_an_unknown_command_is_refused(moving):
    moving.command(99)
    assert (moving.obeyed(), moving.outputs.refusal) == (False, c.REFUSAL_UNKNOWN_COMMAND)
    assert moving.outputs.state == c.STATE_ENABLED


def test_a_fault_whose_cause_stands_cannot_be_cleared(moving):
    moving.spoil = supply(0)
    moving.tick(10)
    moving.command(c.COMMAND_CLEAR_FAULTS)
    assert (moving.obeyed(), moving.outputs.refusal) == (False, c.REFUSAL_FAULT_STANDS)


def test_every_command_is_counted_as_obeyed_or_refused(moving):
    before = moving.outputs.obeyed_count, moving.outputs.refused_count
    kinds = [c.COMMAND_MOVE, 99, c.COMMAND_ENABLE, c.COMMAND_DISABLE, c.COMMAND_CLEAR_FAULTS, c.COMMAND_CLEAR_STOP]
    told = [(moving.command(kind), moving.obeyed())[1] for kind in kinds]
    assert told == [True, False, False, True, True, False]
    assert (moving.outputs.obeyed_count, moving.outputs.refused_count) == (before[0] + 3, before[1] + 3)


GAIN_FIELDS = [name for name, _ in c.joint_gains._fields_]


@pytest.mark.parametrize(
    ("joint", "field", "value", "refusal"),
    [(k, field, [NAN, INF, -INF][k % 3], c.REFUSAL_NOT_FINITE) for k, field in enumerate(GAIN_FIELDS)]
    + [(5 - k, field, [-0.1, 1001.0][k % 2], c.REFUSAL_OUT_OF_RANGE) for k, field in enumerate(GAIN_FIELDS)],
)
def test_a_gain_set_is_taken_whole_or_not_at_all(moving, joint, field, value, refusal):
    before = [bytes(entry.gains) for entry in moving.core.config.joint]
    gains = moving.inputs.command.gains
    for i in JOINTS:
        gains.joint[i] = c.joint_gains(5, 6, 0.05, 0.1, 0.01, 10)
    setattr(gains.joint[joint], field, value)
    moving.command(c.COMMAND_GAINS)
    assert (moving.obeyed(), moving.outputs.refusal) == (False, refusal)
    assert [bytes(entry.gains) for entry in moving.core.config.joint] == before
    gains.joint[joint] = c.joint_gains(5, 6, 0.05, 0.1, 0.01, 10)
    moving.command(c.COMMAND_GAINS)
    assert moving.obeyed()
    assert len({bytes(entry.gains) for entry in moving.core.config.joint}) == 1


def test_a_change_of_gains_in_motion_does_not_jerk_the_arm(moving):
    moving.move(0.5, speed_rad_s=0.5, ticks=100)
    before = c.core_outputs.from_buffer_copy(moving.tick(50))
    twin = twin_of(moving)
    for i in JOINTS:
        moving.inputs.command.gains.joint[i] = c.joint_gains(12.0, 20.0, 0.1, 0.5, 0.005, 20.0)
    changed, unchanged = moving.command(c.COMMAND_GAINS), twin.tick()
    for i in JOINTS:
        error = changed.reference_rad[i] - changed.angle_rad[i] - before.reference_rad[i] + before.angle_rad[i]
        rate = changed.reference_rad_s[i] - before.reference_rad_s[i]
        # Only what has changed since the last tick meets the new gains.
        assert changed.duty[i] - unchanged.duty[i] == pytest.approx(8.0 * error + 0.3 * rate, abs=1e-5)
    assert changed.faults == 0


# --- limits that are no faults ---------------------------------------------------------------------------------------


def test_a_target_beyond_the_soft_limit_ends_at_it(moving):
    for _ in range(400):
        moving.move(3.0, speed_rad_s=1.0)
        moving.tick(9)
    assert moving.outputs.reference_rad[0] == ctypes.c_float(2.4).value
    assert moving.outputs.limited[0] & c.LIMITED_SOFT
    assert max(moving.angle_rad) < 2.4 + 0.01
    assert moving.outputs.faults == 0


def test_a_reference_that_runs_on_stops_at_the_soft_limit(library):
    config = lab_config(library)
    config.silence_ticks = 1000
    arm = LabArm(library, config, angle_rad=2.2)
    arm.enable()
    arm.move(2.39, speed_rad_s=1.0, ticks=300)
    arm.tick(350)
    assert arm.outputs.state == c.STATE_ENABLED
    assert (arm.outputs.reference_rad[0], arm.outputs.reference_rad_s[0]) == (ctypes.c_float(2.4).value, 0.0)
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


def test_a_speed_beyond_the_limit_is_cut_and_told(moving):
    moving.move(0.0, speed_rad_s=9.0, ticks=200)
    assert moving.outputs.limited[0] & c.LIMITED_SPEED
    assert moving.tick(200).reference_rad_s[0] <= 2.0


def test_too_much_current_takes_duty_away_and_gives_it_back(moving):
    moving.wander(1000, amplitude_rad=0.0)
    duties, told = {}, {}
    for milliamperes in (1000, 1500, 0):
        for i in JOINTS:
            moving.inputs.current_ma[i] = milliamperes
        moving.wander(2000, amplitude_rad=0.14)
        # 0.5 A beyond the limit take 2.5 duty per second, so that nothing is left of 0.8 after 0.32 s.
        outputs = [c.core_outputs.from_buffer_copy(raw) for raw in moving.history[-1500:]]
        duties[milliamperes] = max(abs(out.duty[0]) for out in outputs)
        told[milliamperes] = any(out.limited[0] & c.LIMITED_CURRENT for out in outputs)
    assert duties[1500] == 0.0
    assert told == {1000: False, 1500: True, 0: False}
    assert duties[0] == pytest.approx(duties[1000], rel=0.2)
    assert moving.outputs.faults == 0


def test_a_motor_wired_the_other_way_is_turned_by_its_configuration(library):
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


# --- the whole -------------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("which", "codes"),
    [("fault", FAULTS), ("state", STATES), ("refusal", REFUSALS)],
    ids=["faults", "states", "refusals"],
)
def test_every_code_has_a_name_a_text_and_a_line_in_the_docs(library, which, codes):
    section = DOC.read_text(encoding="utf-8").split(f"## {which.title()}s")[1].split("\n## ")[0]
    rows = dict(re.findall(r"^\| (\d+) \| `(\w+)` \|", section, flags=re.MULTILINE))
    assert {name: int(code) for code, name in rows.items()} == codes
    name, text = getattr(library, f"{which}_name"), getattr(library, f"{which}_text")
    for known, code in codes.items():
        assert name(code).decode() == known
        assert len(text(code)) > 5
        assert text(code).decode() in section
    assert name(200) == text(200) == b"?"
