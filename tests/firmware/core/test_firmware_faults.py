"""Faults: each one comes when it must, does what it must, and stays away when it must not."""

import re
from pathlib import Path

import pytest
from firmware_arm import LabArm, lab_config, read_as, supply
from firmware_layout import FAULTS, REACTIONS, REJECTIONS, STATES, c

DOC = Path(__file__).resolve().parents[3] / "docs" / "reference" / "firmware.md"
REACTION_STATE = {
    "RELEASE": c.STATE_FAULTED,
    "HOLD": c.STATE_STOPPING,
    "YIELD": c.STATE_STOPPING,
    "JOINT": c.STATE_STOPPING,
}


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


def lose_tick(arm):
    arm.inputs.tick += 1
    arm.tick()


def lose_ticks(arm):
    """Lose every other tick: held at first, released in the end."""
    for _ in range(200):
        arm.inputs.tick += 1
        arm.tick()


def change_memory(arm):
    """Change a limit in the configuration in use, between two of its checks."""
    arm.wander(1500)
    arm.core.config.joint[2].soft_max_rad = 2.41
    arm.wander(1500)


def spoil_integral(arm):
    arm.core.joint[2].pid.integral_duty = float("nan")
    arm.tick()


def take_over(arm):
    arm.inputs.taken_over = 1
    arm.tick()
    arm.inputs.taken_over = 0


def press(short_rad):
    """Let a joint that cannot follow be asked for more than its duty's limit."""

    def provoke(arm):
        for joint in arm.core.config.joint:
            joint.following_rad, joint.stall_rad, joint.duty_limit = 0.6, 1e-4, 0.05
        arm.core.config.overload_ticks = 50
        arm.core.config.stall_ticks = 9999
        arm.core.crc, arm.core.crc_at, arm.core.crc_known = 0xFFFFFFFF, 0, 0
        block(short_rad)(arm)

    return provoke


def overrun(arm):
    arm.inputs.overrun = 1
    arm.tick()
    arm.inputs.overrun = 0


def block(short_rad):
    """Block the arm and ask it for an angle so far away."""

    def provoke(arm):
        arm.blocked = True
        target = arm.angle_rad[0] + short_rad
        for _ in range(50):
            arm.move(target)
            arm.tick(9)

    return provoke


def fall_silent(arm):
    arm.tick(101)


#: Fault -> (how to provoke it on a moving arm, the joint it must name; ANY: all are blocked, and one is watched first).
ANY = -1
PROVOKE = {
    "POT_OPEN": (spoiling(read_as(2, 65535), 20), 2),
    "POT_SHORT": (spoiling(read_as(5, 12), 20), 5),
    "POT_FROZEN": (spoiling(freeze(1), 1000), 1),
    "POT_JUMP": (spoiling(shift(3, 2000), 20), 3),
    "POT_INVERTED": (spoiling(invert(4), 1000), 4),
    "FOLLOWING": (block(1.2), ANY),
    "STALL": (block(0.25), ANY),
    "HOST_SILENT": (fall_silent, c.NO_JOINT),
    "SUPPLY_LOW": (spoiling(supply(9999), 10), c.NO_JOINT),
    "SUPPLY_HIGH": (spoiling(supply(14001), 10), c.NO_JOINT),
    "TICK_MISSED": (lose_tick, c.NO_JOINT),
    "TICK_OVERRUN": (overrun, c.NO_JOINT),
    "OVERLOAD": (press(0.9), ANY),
    "TICKS_LOST": (lose_ticks, c.NO_JOINT),
    "MEMORY": (change_memory, c.NO_JOINT),
    "ARITHMETIC": (spoil_integral, 2),
    "TAKEN_OVER": (take_over, c.NO_JOINT),
}
AT_START = {"WATCHDOG": {"watchdog": True}, "CONFIG": {"source": c.CONFIG_FACTORY}}
#: Found by the motor, which this arm has not (test_firmware_motor.py), by a restart or by the wire.
BY_OTHERS = {
    "POT_SLIP", "POT_DRIFT", "POT_SCALE", "POT_LAG", "PUSHED", "OVERSPEED", "OSCILLATION", "CURRENT_SENSOR",
    "OVERCURRENT", "CRASH", "ENCODER", "BRIDGE", "MOTOR",
}  # fmt: skip


def first_tick_of(arm, fault):
    """The outputs of the tick in which a fault was latched."""
    outputs = [c.core_outputs.from_buffer_copy(raw) for raw in arm.history]
    return next(out for out in outputs if out.faults & 1 << fault)


def test_every_fault_is_provoked_here():
    assert {*PROVOKE, *AT_START, *BY_OTHERS} == set(FAULTS)


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
    first = "TICK_MISSED" if name == "TICKS_LOST" else name
    joint = out.first_joint if joint == ANY and out.first_joint < c.JOINTS else joint
    assert (out.first_fault, out.first_joint) == (FAULTS[first], joint)
    if joint != c.NO_JOINT:
        assert out.joint_faults[joint] & 1 << FAULTS[name]
    chosen = "RELEASE" if reaction == c.REACTION_RELEASE else "HOLD"
    reaction_is = chosen if REACTIONS[name] == "CHOSEN" else REACTIONS[name]
    expected = REACTION_STATE[reaction_is]
    assert out.state == expected
    if reaction_is == "JOINT":
        assert out.duty[joint] == 0.0  # in the very tick; the others are driven on
        assert out.drives_on == 1
    if expected == c.STATE_FAULTED:
        assert (out.drives_on, list(out.duty)) == (0, [0.0] * 6)  # in the very tick
    # It stays latched when its cause is gone, and nothing but a clear takes it away.
    arm.spoil, arm.blocked, arm.inputs.supply_mv = lambda arm: None, False, 12000
    arm.move(0.1)
    assert not arm.acknowledged()
    arm.command(c.COMMAND_ENABLE)
    assert not arm.acknowledged()
    assert arm.tick(3000).state in (c.STATE_FAULTED, c.STATE_HOLDING)
    assert arm.outputs.faults & 1 << FAULTS[name]
    held = [*arm.outputs.reference_rad]
    arm.command(c.COMMAND_CLEAR_FAULTS)
    if name == "MEMORY":  # only a restart brings the configuration back
        assert (arm.acknowledged(), arm.outputs.rejection) == (False, c.REJECTION_FAULT_STANDS)
        return
    assert arm.acknowledged()
    assert arm.outputs.state == (c.STATE_HOLDING if arm.outputs.drives_on else c.STATE_DISABLED)
    arm.move(0.1)  # clearing alone moves nothing
    assert not arm.acknowledged()
    if arm.outputs.drives_on:
        assert [*arm.outputs.reference_rad] == held
    assert (arm.outputs.faults, arm.outputs.first_fault, list(arm.outputs.joint_faults)) == (0, 0, [0] * 6)


@pytest.mark.parametrize("name", AT_START)
def test_a_fault_of_the_start_keeps_the_arm_off(library, name):
    arm = LabArm(library, **AT_START[name])
    out = arm.enable()
    assert not arm.acknowledged()
    assert (out.state, out.first_fault, out.drives_on) == (c.STATE_FAULTED, FAULTS[name], 0)
    arm.command(c.COMMAND_CLEAR_FAULTS)
    assert arm.acknowledged() == (name == "WATCHDOG")


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


@pytest.mark.parametrize(("spoil", "limit"), [(supply(0), "supply_ticks"), (read_as(0, 0), "pot_ticks")])
def test_a_fault_takes_exactly_its_ticks(moving, spoil, limit):
    moving.spoil = spoil
    moving.tick(getattr(moving.config, limit) - 1)
    assert moving.outputs.faults == 0
    assert moving.tick().faults != 0


def test_a_fault_with_the_drives_off_keeps_them_off(arm):
    arm.tick(20)
    overrun(arm)
    assert arm.outputs.state == c.STATE_FAULTED
    arm.command(c.COMMAND_ENABLE)
    assert not arm.acknowledged()


def test_a_jump_of_the_reading_is_no_speed(moving):
    moving.wander(1500, amplitude_rad=0.0)
    moving.spoil = shift(3, 2000)
    out = next(out for out in iter(moving.tick, None) if out.faults)
    assert out.speed_rad_s[3] == 0.0


def test_a_joint_driven_hard_that_moves_does_not_stall(library):
    config = lab_config(library)
    for joint in config.joint:
        joint.stall_duty = 0.2
    arm = LabArm(library, config, angle_rad=-2.0)
    arm.enable()
    for _ in range(80):
        arm.move(2.0, ticks=4000)
        arm.tick(19)
    driven = [c.core_outputs.from_buffer_copy(raw).duty[0] > 0.2 for raw in arm.history]
    assert sum(driven) > config.stall_ticks
    assert arm.outputs.faults == 0


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


@pytest.mark.parametrize(
    ("which", "codes"),
    [("fault", FAULTS), ("state", STATES), ("rejection", REJECTIONS)],
    ids=["faults", "states", "rejections"],
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
