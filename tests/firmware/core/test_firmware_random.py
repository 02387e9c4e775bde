"""Whatever comes in, what goes out is finite, within its limits and no faster than its slew."""

import ctypes
import math

import pytest
from firmware_arm import JOINTS, LabArm, lab_config
from firmware_layout import c
from hypothesis import given
from hypothesis import strategies as st

ANY = st.floats(width=32)  # NaN and infinities too
TAME = st.floats(-3, 3, width=32)
SIX = {"min_size": 6, "max_size": 6}


@st.composite
def commands(draw):
    """Any command: most of them sensible, so that the arm also moves."""
    kind = draw(st.sampled_from([c.COMMAND_NONE, c.COMMAND_MOVE, c.COMMAND_MOVE, *range(1, 9)]))
    numbers = draw(st.sampled_from([TAME, TAME, ANY]))
    command = c.core_command(kind=kind, sequence=draw(st.integers(0, 2**32 - 1)))
    if kind == c.COMMAND_MOVE:
        command.move.position_rad[:] = draw(st.lists(numbers, **SIX))
        command.move.speed_rad_s[:] = draw(st.lists(numbers, **SIX))
        command.move.gravity_duty[:] = [0.3 * value for value in draw(st.lists(numbers, **SIX))]
        command.move.duration_ticks = draw(st.sampled_from([0, 1, 5, 16, 16, 100, 2**32 - 1]))
    elif kind == c.COMMAND_GAINS:
        gain = draw(st.sampled_from([st.floats(0, 50, width=32), ANY]))
        for joint in command.gains.joint:
            joint.__init__(*draw(st.lists(gain, min_size=4, max_size=4)), 0.0, 0.0, 0.005, draw(gain))
    return command


#: What happens before a command: so many ticks of it.
EVENTS = st.sampled_from(["nothing"] * 6 + ["counts", "current", "supply", "stop", "overrun", "tick"])


def spoiler(event, number):
    def spoil(arm):
        if event == "counts":
            arm.inputs.counts[number % 6] = (number * 7919 + arm.inputs.tick * (number % 5) * 977) % 65536
        elif event == "current":
            arm.inputs.current_ma[number % 6] = number
        elif event == "supply":
            arm.inputs.supply_mv = number
        elif event == "overrun":
            arm.inputs.overrun = number % 2
        elif event == "tick":
            arm.inputs.tick = (arm.inputs.tick + number) % 2**32

    return spoil


def check(arm, last, config):
    """What must hold after every tick."""
    out = arm.outputs
    assert out.state in range(6)
    assert out.drives_on == (out.state in (c.STATE_ENABLED, c.STATE_STOPPING, c.STATE_HOLDING))
    assert (out.first_fault == c.FAULT_NONE) == (out.faults == 0)
    assert out.state not in (c.STATE_FAULTED, c.STATE_STOPPING) or out.faults
    for i in JOINTS:
        joint, duty = config.joint[i], out.duty[i]
        assert abs(duty) <= 1.0
        assert out.drives_on or duty == 0.0
        # The drives going off is no slewing, nor is another supply; anything else is.
        slews = out.drives_on and duty != 0.0 and arm.inputs.supply_mv == 12000 and last[i] is not None
        assert not slews or abs(duty - last[i]) <= joint.duty_slew_per_s * 0.001 + 1e-7
        values = (out.angle_rad[i], out.speed_rad_s[i], out.reference_rad[i], out.reference_rad_s[i])
        assert all(math.isfinite(value) for value in (duty, *values))
        assert abs(out.reference_rad_s[i]) <= joint.speed_limit_rad_s * (1 + 1e-4) + 1e-4
    return [duty if arm.inputs.supply_mv == 12000 else None for duty in out.duty]


@given(st.lists(st.tuples(commands(), EVENTS, st.integers(0, 70000), st.integers(1, 12)), min_size=1, max_size=15))
def test_no_input_breaks_the_limits(library, script):
    config = lab_config(library)
    arm = LabArm(library, config)
    arm.enable()
    last = list(arm.outputs.duty)
    for command, event, number, ticks in script:
        arm.spoil = spoiler(event, number)
        arm.inputs.stop_pressed = event == "stop"
        arm.inputs.command = command
        for _ in range(ticks):
            arm.tick()
            last = check(arm, last, config)
        arm.inputs.stop_pressed, arm.inputs.overrun, arm.inputs.supply_mv = 0, 0, 12000
        if number % 3 == 0:  # bring it back up, so that the next command meets a moving arm
            arm.spoil = lambda arm: None
            for kind in (c.COMMAND_CLEAR_STOP, c.COMMAND_NONE, c.COMMAND_CLEAR_FAULTS, c.COMMAND_ENABLE_INWARD):
                arm.command(kind)
                last = check(arm, last, config)


@given(st.binary(min_size=ctypes.sizeof(c.core_command), max_size=ctypes.sizeof(c.core_command)))
def test_no_bytes_make_a_command_that_breaks_the_limits(library, raw):
    config = lab_config(library)
    arm = LabArm(library, config)
    arm.enable()
    for kind in range(9):
        last = list(arm.outputs.duty)
        arm.inputs.command = c.core_command.from_buffer_copy(raw)
        arm.inputs.command.kind = kind
        arm.tick()
        check(arm, last, config)


@pytest.mark.parametrize("amplitude_rad", [0.1, 0.5])
@pytest.mark.parametrize("period", [4, 10, 16], ids=["250 Hz", "100 Hz", "62 Hz"])
def test_the_arm_follows_a_slow_sine_without_a_word(arm, amplitude_rad, period):
    """The whole loop on the plant: never a fault, and never further behind than the law allows."""
    arm.enable()
    arm.wander(1000, amplitude_rad=0.0)  # at rest, the converter's noise is all there is
    arm.wander(4000, amplitude_rad=amplitude_rad, period=period)
    outputs = [c.core_outputs.from_buffer_copy(raw) for raw in arm.history[-3000:]]
    assert max(out.faults for out in outputs) == 0
    # The feed-forward carries the speed; kp has to carry the damping and what speeding up takes off the motor:
    # (kd w + 0.03 w^2 / 5) A / kp with w = pi, and a tenth for the delay of a tick and the filter.
    allowed = 1.1 * amplitude_rad * (0.1 * math.pi + 0.006 * math.pi**2) / 4.0 + 2e-4
    assert max(abs(out.reference_rad[0] - out.angle_rad[0]) for out in outputs) < allowed
