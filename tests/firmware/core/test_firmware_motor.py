"""The motor as a witness: on drawn arms under load a healthy potentiometer is left alone, a broken one is named."""

import ctypes
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from firmware_layout import c

from armsight.robot.boards.codes import BoardState, Fault
from armsight.sim.joints import PotFault

PATH = Path(__file__).resolve().parents[3] / "benchmarks" / "board_arms.py"
SEEDS = range(900, 904)


@pytest.fixture(scope="module")
def arms():
    """The benchmark's module."""
    spec = importlib.util.spec_from_file_location("board_arms", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def swinging(arms, library, seed):
    """An arm in motion, without a fault."""
    arm = arms.Arm(library, seed)
    arm.enable()
    arm.swing(1200)
    assert arm.first == (None, None)
    return arm


@pytest.mark.parametrize("seed", SEEDS)
def test_a_healthy_arm_under_load_has_no_fault(arms, library, seed):
    arm = swinging(arms, library, seed)
    arm.rest(400)
    assert arm.first == (None, None)


def test_a_resistance_learnt_wrongly_under_a_hand_is_learnt_rightly_afterwards(arms, library):
    arm, joint = arms.Arm(library, 502012333), 5  # of 10,080 arms the one that this took for a frozen potentiometer
    arm.enable()
    arm.rest(1200)
    assert arm.first == (None, None)
    seen = arm.model.resistance_ohm[joint] / arms.RESISTANCE_OHM / arm.model.current_gain[joint]
    assert arm.core.joint[joint].motor.resistance_scale == pytest.approx(seen, rel=0.02)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_stuck_potentiometer_is_named_and_the_other_joints_are_held(arms, library, seed):
    arm = swinging(arms, library, seed)
    joint = int(np.argmax(np.abs(arm.plant.qd)))
    arm.plant.break_pot(joint, PotFault.STUCK)
    arm.swing(1000)
    assert arm.first == (Fault.POT_FROZEN, joint)
    at = arm.plant.link[joint]
    arm.tick(600)
    out = arm.out[0]
    assert abs(arm.plant.link[joint] - at) < 0.2  # by its motor
    assert out["state"] == BoardState.HOLDING
    others = np.arange(6) != joint
    assert np.abs(arm.plant.link - out["reference_rad"])[others].max() < 0.05


def test_an_inverted_potentiometer_is_named_from_the_first_motion(arms, library):
    arm = arms.Arm(library, 910)
    arm.plant.break_pot(2, PotFault.INVERTED)
    arm.enable()
    arm.swing(1000)
    assert arm.first == (Fault.POT_INVERTED, 2)


@pytest.mark.parametrize(("share", "most"), [(1.0, 1.05), (0.35, 1.15)])
def test_a_joint_is_careful_until_motor_and_reading_went_the_same_way(arms, library, share, most):
    for seed in (930, 931, 932):
        arm = arms.Arm(library, seed)
        arm.plant.break_pot(2, PotFault.SCALED, share)
        arm.enable()
        motor = arm.core.joint[2].motor
        assert motor.trust == pytest.approx(0.5)
        arm.swing(1500)
        assert (motor.trust == 1.0) == (share == 1.0)
        assert arm.fastest < most


def test_a_slow_joint_earns_its_speed_too(arms, library):
    arm = arms.Arm(library, 960, load=0.05)  # hardly any current: its resistance remains unknown
    for joint in arm.core.config.joint:
        joint.speed_limit_rad_s = 0.4
    arm.core.crc, arm.core.crc_at, arm.core.crc_known = 0xFFFFFFFF, 0, 0
    arm.enable()
    aim = np.linspace(arm.start, arm.start + 1.0, 1000)  # at 0.25 rad/s
    arm.follow(aim, np.full_like(aim, 0.25))
    assert arm.first == (None, None)
    assert [joint.motor.trust for joint in arm.core.joint] == [1.0] * 6


def test_slow_joints_carry_their_loads(arms, library):
    """Fell before: what drove a joint to its reference was bounded by its speed limit, and a load was not taken up."""
    table = arms.Table()
    for seed in (711000291, 711000388, 711000485, 711000873, 703008216):
        arms.slow(library, seed, table)
    assert not table.false["slow swing"]
    assert table.apart["slow swing"] < 0.12


def test_a_motor_whose_resistance_is_not_known_is_not_watched(arms, library):
    arm = swinging(arms, library, 900)
    for joint in arm.core.config.joint:
        joint.motor.resistance_ohm = 0.0
    arm.core.crc, arm.core.crc_at, arm.core.crc_known = 0xFFFFFFFF, 0, 0
    arm.plant.break_pot(1, PotFault.DRIFT, 0.1)
    arm.swing(400)
    assert arm.first == (None, None)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    ("kind", "size"), [(PotFault.JUMP, 0.4), (PotFault.SLIP, 0.3), (PotFault.DRIFT, 0.3), (PotFault.INVERTED, 0.0)]
)
def test_a_potentiometer_that_breaks_in_motion_is_noticed_at_its_joint(arms, library, kind, size, seed):
    arm = swinging(arms, library, seed)
    joint = int(np.argmax(np.abs(arm.plant.qd)))
    arm.plant.break_pot(joint, kind, size)
    arm.swing(2000)
    arm.tick(arms.NAMED_TICKS)
    assert arm.first[1] == joint
    if kind is PotFault.JUMP:
        assert arm.first[0] is Fault.POT_JUMP


@pytest.mark.parametrize(("kind", "size"), [(PotFault.SCALED, 1.6), (PotFault.SCALED, 0.4), (PotFault.LAG, 0.15)])
def test_a_potentiometer_that_was_wrong_from_the_beginning_is_noticed_at_its_joint(arms, library, kind, size):
    for seed in (920, 921, 922):
        arm = arms.Arm(library, seed)
        arm.plant.break_pot(2, kind, size)
        arm.enable()
        arm.swing(4000)
        arm.tick(arms.NAMED_TICKS)
        assert arm.first[1] == 2
        assert arm.first[0] is not Fault.POT_FROZEN


@pytest.mark.parametrize("size", [0.2, -0.2])
def test_a_reading_that_drifts_at_rest_is_noticed(arms, library, size):
    for seed in SEEDS:
        arm = swinging(arms, library, seed)
        arm.rest(600)
        arm.plant.break_pot(1, PotFault.DRIFT, size)
        arm.rest(4000)
        arm.tick(arms.NAMED_TICKS)
        assert arm.first[1] == 1


def test_a_drift_is_distinguished_from_a_slip_once_the_joint_was_let_go_of(arms, library):
    for seed, kind, size, code in (
        (941, PotFault.DRIFT, 0.5, Fault.POT_DRIFT),
        (942, PotFault.DRIFT, -0.5, Fault.POT_DRIFT),
        (943, PotFault.SLIP, 0.4, Fault.POT_SLIP),
    ):
        arm = swinging(arms, library, seed)
        joint = int(np.argmax(np.abs(arm.plant.qd)))
        arm.plant.break_pot(joint, kind, size)
        arm.swing(2000)
        at_first = arm.first
        arm.tick(arms.NAMED_TICKS)
        assert (at_first[1], arm.first) == (joint, (code, joint))
        assert arm.out[0]["joint_faults"][joint] == arm.out[0]["faults"] == 1 << code


class Kept:
    """Keeps the arm of a case, once its fault has its name."""

    def __init__(self, arms, library, seed, kind, size):
        self.named_ticks = arms.NAMED_TICKS
        arms.broken(library, seed, self, kind, size)

    def add(self, kind, arm, *_):
        arm.tick(self.named_ticks)
        self.arm = arm


@pytest.mark.parametrize(
    ("kind", "size", "code", "seed"),
    [
        (PotFault.LAG, 0.17605843552036962, Fault.POT_LAG, 71000512),  # called POT_INVERTED once
        (PotFault.SCALED, 1.6231190434530514, Fault.POT_SCALE, 72002273),  # MOTOR alone
        (PotFault.SCALED, 2.3936734940067215, Fault.POT_SCALE, 72004601),
    ],
)
def test_what_cannot_be_distinguished_has_both_names(arms, library, kind, size, code, seed):
    arm = Kept(arms, library, seed, kind, size).arm
    assert int(arm.out[0]["joint_faults"][arm.first[1]]) >> code & 1


@pytest.mark.parametrize("rows", [{}, {"drum_rad": 0.05}, {"stiffness_n_m": 60.0, "pose_share": 0.1, "drum_rad": 0.03}])
def test_the_arm_that_runs_in_c_is_the_plant_of_sim(arms, library, rows):
    between = arms.plain_transmission(damping_n_m_s=0.1, back_share=0.8, drum_per_rev=3.0, **rows)
    arm, twin = (arms.Arm(library, 950, transmission=between) for _ in range(2))
    for each in (arm, twin):
        each.plant.break_pot(1, PotFault.LAG, 0.05)
        each.plant.break_pot(2, PotFault.SLIP, 0.1)
        each.plant.hand_n_m[3] = 1.5
        each.tick(5)
        each.command(arms.c.COMMAND_ENABLE)
    for _ in range(300):
        sensed, out = twin.plant.sense(), twin.out[0]
        twin.inputs.tick += 1
        twin.inputs.counts[:], twin.inputs.current_ma[:] = sensed.counts.tolist(), sensed.current_ma.tolist()
        library.core_tick(twin.loop.core, twin.loop.inputs, twin.loop.outputs)
        twin.plant.step(out["duty"], bool(out["drives_on"] or out["windings_shorted"]), not out["brakes_open"])
    arm.tick(300)
    assert arm.plant.q.tobytes() == twin.plant.q.tobytes()
    assert arm.plant.link.tobytes() == twin.plant.link.tobytes()
    assert bytes(arm.outputs) == bytes(twin.outputs)


def test_elastic_joints_are_held_and_not_taken_for_broken_ones(arms, library):
    table = arms.Table()
    for seed in range(81, 87):
        arms.elastic(library, seed, table)
        arms.eccentric(library, seed, table)
    assert table.fast["elastic 8 to 40 Hz"] < 1.4
    for seed in (99500300763, 99500317835, 99500316962):  # light ones with backlash, and one that its load takes far
        arms.elastic(library, seed, table)
    # One whose gains have no kd goes beyond its limit, another's current steps with the noise as it is enabled.
    for seed in (740002234486, 861002599911, 863002595338):  # the last one sinks into its springs as it is let go of
        arms.softest(library, seed, table)
    arms.elastic(library, 862002598254, table)  # its teeth change sides while it moves, which taught a resistance
    assert not sum(table.false.values())


def test_an_elastic_joint_swings_where_it_is_damped_by_the_reading(arms, library):
    """The law's damping by the motor is what holds it: the same gains on the reading's speed are a fault."""
    model = arms.drawn_model(91)
    between = arms.plain_transmission(**arms.sprung(model, np.full(6, 20.0), np.full(6, 0.02), np.full(6, 0.5)))
    faults = []
    for share in (1.0, 0.0):
        config = arms.found_configuration(model, between, np.random.default_rng(91))
        config["joint"]["transmission"]["damping_share"] = share
        arm = arms.Arm(library, 91, model=model, config=config, supply_v=12.0, transmission=between)
        arm.speed_rad_s = np.minimum(arm.speed_rad_s, 0.5 * config["joint"]["speed_limit_rad_s"])
        arm.enable()
        arm.swing(2000)
        faults.append(arm.first[0])
    assert faults[0] is None
    assert faults[1] is not None


def test_a_twist_that_the_current_shows_is_no_gap(library):
    config = c.motor_config(6.0, 2.4, 0.03, 0.01)
    gaps = []
    for twist in (0.0, 0.1):
        motor = c.motor_state()
        library.motor_start(ctypes.byref(motor), ctypes.c_float(0.0), ctypes.c_float(2.0), 0)
        for tick in range(200):  # the motor moves by 0.1 rad against a spring of 1 A, the reading rests
            current_a = tick / 200
            motor.duty = (6.0 * current_a + 2.4 * 0.5) / 12.0
            seen = (ctypes.c_float(each) for each in (12.0, current_a, twist * current_a))
            library.motor_measure(ctypes.byref(motor), ctypes.byref(config), *seen)
        gaps.append(abs(motor.gap_rad))
    assert gaps[0] > 0.06
    assert gaps[1] < 0.01


def test_a_current_that_is_never_there_is_the_sensors_fault(arms, library):
    arm = arms.Arm(library, 901)
    arm.plant._model[[9, 10]] = 0.0
    arm.enable()
    arm.swing(1000)
    assert arm.first[0] is Fault.CURRENT_SENSOR


def test_a_jump_too_small_for_the_reading_alone_is_named_by_its_step(arms, library):
    arm = swinging(arms, library, 902)
    arm.plant.break_pot(4, PotFault.JUMP, 0.085)
    arm.swing(400)
    arm.tick(arms.NAMED_TICKS)
    assert arm.first == (Fault.POT_JUMP, 4)


def test_gains_that_make_a_joint_swing_are_noticed(arms, library):
    named = []
    for seed in range(930, 939):
        arm = arms.Arm(library, seed)
        for joint in arm.core.config.joint:
            joint.gains.kp_per_rad, joint.gains.kd_s_per_rad = 60.0, 6.0
        arm.core.crc, arm.core.crc_at, arm.core.crc_known = 0xFFFFFFFF, 0, 0
        arm.enable()
        arm.swing(3000)
        named.append(arm.first and arm.first[0])
    assert named.count(Fault.OSCILLATION) >= 6, named  # the others swing by less, or overload the motor first


@pytest.mark.parametrize("name", ["a reading", "a current beside an uncertain resistance"])
def test_noise_is_no_swing_and_a_swing_is_one(library, name):
    """White noise as large as its term, here 0.4 rad/s, and blips on either side are none; swings of 20 and 40 Hz are."""

    def alarms(speeds):
        motor = c.motor_state()
        library.motor_start(ctypes.byref(motor), ctypes.c_float(0.0), ctypes.c_float(2.0), 0)
        motor.last_a, motor.unsure_per_a = 0.5, 0.8
        for speed in speeds:
            motor.driven_ticks += 3
            if library.motor_swings_far(ctypes.byref(motor), ctypes.c_float(speed), name != "a reading"):
                return True
        return False

    draw = np.random.default_rng(8).normal
    assert not alarms(0.5 * (-1) ** np.arange(200))
    assert not any(alarms(draw(0, 0.4, 1000)) for _ in range(40))
    for size, hz in ((0.7, 20), (0.8, 40)):
        swing = size * np.sin(2 * np.pi * hz * 3e-3 * np.arange(1000))
        assert sum(alarms(swing + draw(0, 0.3, 1000)) for _ in range(10)) >= 9, hz


def test_backlash_teaches_no_resistance(arms, library):
    table = arms.Table()
    for seed in (61000774, 61000871, 62001844, 63003108, 871027156, 871045392):
        arms.loaded_suddenly(library, seed, table)
    assert not table.false["unloaded, then 1 N m"]


@pytest.fixture
def watched(library):
    """A motor of 6 ohm and 2.4 V s/rad that is driven at 1 A, and a function that lets a window of it pass."""
    config, motor = c.motor_config(6.0, 2.4, 0.03, 0.01), c.motor_state()
    library.motor_start(ctypes.byref(motor), ctypes.c_float(0.0), ctypes.c_float(2.0), 0)

    def window(way_rad, ahead_rad=0.0, *, ticks=32, current_a=1.0):  # the motor goes on further than the reading
        start_rad = motor.last_rad
        for tick in range(1, ticks + 1):
            motor.duty = (6.0 * current_a + 2.4e3 * (way_rad + ahead_rad) / ticks) / 12.0
            numbers = (ctypes.c_float(each) for each in (12.0, current_a, start_rad + way_rad * tick / ticks))
            library.motor_measure(ctypes.byref(motor), ctypes.byref(config), *numbers)

    window(0.0, ticks=3)  # currents settle
    return motor, window


def test_backlash_crossed_while_a_driver_limits_the_current_teaches_no_resistance(library, watched):
    motor, window = watched
    for _ in range(3):
        window(0.03)
    before = motor.resistance_scale
    library.motor_limit(ctypes.byref(motor))
    window(0.03, 0.007)
    assert motor.resistance_scale - before < 0.01


def test_a_motor_that_moves_within_its_backlash_at_rest_teaches_no_resistance(watched):
    motor, window = watched
    window(0.0, ticks=256, current_a=0.15)
    window(0.0, 0.008, ticks=256, current_a=0.15)
    assert motor.resistance_scale - 1.0 < 0.035


def test_windows_at_rest_in_backlash_do_not_add_up(watched):
    """What a joint hides in its backlash goes with its current: each window has the same error."""
    motor, window = watched
    for side in 30 * (1.0, -1.0):
        window(0.0, 0.008 * side, ticks=256, current_a=0.1 * side)
    assert abs(motor.resistance_scale - 1.0) < 2.0 * np.sqrt(motor.variance_rr)  # three where they count as independent
