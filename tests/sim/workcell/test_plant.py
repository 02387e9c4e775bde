"""The arm at the motors, against what can be worked out by hand."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from armsight.robot.arm_file import open_arm
from armsight.robot.boards.link import TICK_S
from armsight.robot.models import MODELS
from armsight.sim.workcell import plant as module
from armsight.sim.workcell.arm import PRESETS, pot_travel, sample_arm
from armsight.sim.workcell.motors import GRAVITY_M_S2, SUPPLY_V, chosen, gravity_torque, row_frames, solids
from armsight.sim.workcell.plant import ArmPlant, mjcf
from armsight.sim.workcell.workcell import gravity_duty

MODEL = open_arm("six_r")
OFF = np.zeros(6)


def test_hours_of_motion_fit(monkeypatch):
    monkeypatch.setattr(module, "_RECENT", 64)
    travelled = module.Travelled(np.zeros(2))
    for tick in range(1, 10_000):
        travelled.add(np.array([tick, -tick]))
        if tick in (100, 128, 700, 9_999):
            assert 64 <= len(travelled.recent) <= 128
            np.testing.assert_array_equal(travelled.recent[:, 0], travelled.begin + np.arange(len(travelled.recent)))
            ticks, rows = travelled.whole()
            np.testing.assert_array_equal(rows, np.column_stack([ticks, -ticks]))
            assert ticks[0] == 0
            assert ticks[-1] == tick
            assert (np.diff(ticks) > 0).all()
    assert len(ticks) < 400


def plant(name: str = "nominal", seed: int = 0, **changes) -> ArmPlant:
    given = replace(PRESETS[name], **changes)
    return ArmPlant(MODEL, sample_arm(MODEL, given, seed), seed)


def run(arm: ArmPlant, duty, ticks: int, braked: bool = False) -> np.ndarray:
    """Run on with one duty and return (ticks, 12) shafts and links."""
    for _ in range(ticks):
        arm.step(np.asarray(duty, dtype=float), not braked, braked)
    return arm.path[-ticks:]


def bare(model, *, friction: float = 0.0):
    """A MuJoCo model of an arm, rigid, without backlash, with so much of its friction; and its solids and motors."""
    parts, motors = solids(model), chosen(model, solids(model), friction)
    none = replace(motors, brake_nm=0.0 * motors.brake_nm, bearing_nm=friction * motors.bearing_nm)
    text = mjcf(model, parts, none, OFF, np.full(6, 1e4), OFF)
    return mujoco.MjModel.from_xml_string(text), parts, motors


@pytest.mark.parametrize("name", [name for name, arm in MODELS.items() if arm.joints == 6])
def test_the_tool_is_where_the_table_says(name):
    model = open_arm(name)
    built, _, _ = bare(model)
    data = mujoco.MjData(built)
    for q in np.random.default_rng(0).uniform(model.q_min, model.q_max, (20, 6)):
        data.qpos[6:] = q
        mujoco.mj_kinematics(built, data)
        T = model.forward(q)
        assert np.abs(data.site_xpos[0] - T[:3, 3]).max() < 1e-9
        assert np.abs(data.site_xmat[0].reshape(3, 3) - T[:3, :3]).max() < 1e-9


@pytest.mark.parametrize("name", ["six_r", "puma560"])
def test_the_torque_of_the_weight(name):
    """Against the gradient of the height of every solid, and against MuJoCo's own recursion."""
    model = open_arm(name)
    built, parts, _ = bare(model)
    data = mujoco.MjData(built)

    def energy(q):
        Ts = row_frames(model, q)[parts.link]
        return GRAVITY_M_S2 * parts.mass @ (Ts[:, 2, :3] * parts.ends.mean(axis=1) + Ts[:, 2, 3:] / 3).sum(axis=1)

    for q in np.random.default_rng(1).uniform(model.q_min, model.q_max, (10, 6)):
        torque = gravity_torque(model, parts, q)
        step = 1e-6
        slope = [(energy(q + d) - energy(q - d)) / (2 * step) for d in step * np.eye(6)]
        assert np.abs(torque + slope).max() < 1e-7  # round-off of the difference: 1e-14 J / 1e-6
        data.qpos[6:] = q
        mujoco.mj_forward(built, data)
        assert np.abs(torque + data.qfrc_bias[6:]).max() < 1e-9


def test_an_arm_that_falls_freely_keeps_its_energy():
    built, _, _ = bare(MODEL)
    built.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(built)
    data.qpos[:] = np.tile(MODEL.home, 2)
    mujoco.mj_forward(built, data)
    start = data.energy.sum()
    fallen = 0.0
    for _ in range(300):
        mujoco.mj_step(built, data, nstep=4)
        fallen = max(fallen, data.energy[1])
        # The integrator is of the first order: an error of h w of what swings to and fro (w < 100 rad/s, h = 0.25 ms).
        assert abs(data.energy.sum() - start) < 0.025 * max(data.energy[1], 1.0)
    assert fallen > 5.0  # J


def test_a_motor_takes_the_current_that_its_winding_lets_through():
    arm = plant()
    motors = arm.motors
    duty = gravity_duty(MODEL, arm.parts, motors, MODEL.home) + 0.01  # friction takes the rest: nothing moves
    path = run(arm, duty, 50)
    assert np.abs(path[-1] - path[-2]).max() < 1e-8
    assert np.abs(arm.sense().current_ma - duty * SUPPLY_V / motors.resistance_ohm * 1e3).max() <= 0.5 + 1e-2
    run(arm, np.ones(6), 1)
    assert arm.sense().current_ma.tolist() == np.rint(1e3 * motors.current_max_a).tolist()


def test_free_running_speed_falls_short_of_no_load_speed_by_the_friction():
    """w = (U/kn - Tc R / (kn)^2) / (1 + viscous share), of joint 1, which carries no weight."""
    arm = plant(friction=1.0)
    motors = arm.motors
    duty = gravity_duty(MODEL, arm.parts, motors, MODEL.home)
    duty[0] = 0.2
    path = run(arm, duty, 1500)
    torque = 0.2 * motors.stall_nm[0] - motors.coulomb_nm[0] - motors.bearing_nm[0]
    expected = torque / (motors.emf_damping[0] + motors.viscous[0])
    assert path[-1, 0] - path[-101, 0] == pytest.approx(0.1 * expected, rel=1e-3)


def test_dry_friction_holds_what_is_weaker():
    arm = plant()
    arm.step(OFF, True)
    # Joint 1 carries no weight: nine tenths of its friction do not move it.
    path = run(arm, [0.9 * arm.motors.coulomb_nm[0] / arm.motors.stall_nm[0], 0, 0, 0, 0, 0], 300)
    assert abs(path[-1, 0] - path[0, 0]) < 1e-6
    path = run(arm, [1.5 * arm.motors.coulomb_nm[0] / arm.motors.stall_nm[0], 0, 0, 0, 0, 0], 300)
    assert abs(path[-1, 0] - path[0, 0]) > 1e-3


def test_brakes_hold_the_arm():
    arm = plant("worn")
    path = run(arm, OFF, 1000, braked=True)
    assert np.abs(path[-1] - path[0]).max() < 2e-6


def test_backlash_is_as_wide_as_it_was_sampled():
    """Rotated slowly to and fro, the shaft leads the link by half the backlash, and by the bearing's drag on the twist."""
    arm = plant("worn")
    motors = arm.motors
    push = 1.6 * (motors.coulomb_nm[0] + motors.bearing_nm[0]) / motors.stall_nm[0]
    leads = []
    for way in (1.0, -1.0, 1.0, -1.0):
        path = run(arm, [way * push, 0, 0, 0, 0, 0], 600)
        leads.append((path[-200:, 0] - path[-200:, 6]).mean())
    width = np.mean(leads[::2]) - np.mean(leads[1::2])
    drag = 2 * motors.bearing_nm[0] / arm.stiffness[0]
    true = sample_arm(MODEL, PRESETS["worn"], 0)
    assert drag < 0.1 * true.backlash_rad[0]
    assert width == pytest.approx(true.backlash_rad[0] + drag, rel=0.02)


def test_gravity_pulls_the_links_through_backlash_and_twist():
    arm = plant("worn")
    shaft, link = arm.path[-1, :6], arm.path[-1, 6:]
    true = sample_arm(MODEL, PRESETS["worn"], 0)
    torque = gravity_torque(true.arm, arm.parts, link)
    expected = np.sign(torque) * 0.5 * true.backlash_rad + torque / arm.stiffness
    heavy = np.abs(torque) > 5 * arm.motors.bearing_nm
    assert heavy[1:4].all()
    # The bearing may hold the link wherever its drag allows.
    drag = arm.motors.bearing_nm / arm.stiffness + 1e-6
    assert (np.abs(link - shaft - expected)[heavy] < drag[heavy]).all()


def test_potentiometers_are_straight_where_nothing_is_wrong():
    arm = plant(pot_noise_lsb=0.6, oversampling=256)
    travel = pot_travel(MODEL)
    span = np.ptp(travel, axis=1)
    for share in np.linspace(0.02, 0.98, 25):
        counts = np.mean([arm.pots.read(travel[:, 0] + share * span) for _ in range(20)], axis=0)
        expected = (0.05 + 0.9 * share) * 65536
        # 20 x 256 conversions of 0.6 steps of 16 counts each, and counts rounded to whole ones with little to dither them.
        assert np.abs(counts - expected).max() < 5 * 16 * 0.67 / np.sqrt(20 * 256) + 0.5


def test_potentiometer_errors_are_as_large_as_asked():
    arm = plant("worn", pot_offset_rad=0.0)
    travel = pot_travel(MODEL)
    span = np.ptp(travel, axis=1)
    along = travel[:, 0] + np.linspace(0, 1, 4001)[:, None] * span
    largest = np.abs(arm.pots.error(along)).max(axis=0) / span
    assert (largest <= PRESETS["worn"].pot_linearity * (1 + 1e-12)).all()
    assert (largest > 0.5 * PRESETS["worn"].pot_linearity).all()
    shaft = MODEL.home
    readings = np.array([arm.pots.read(shaft) for _ in range(2000)], dtype=float)
    # Of 64 conversions: their noise, and the twelfth of a step that rounding adds; 2000 readings determine it to 1.6 %.
    expected = 16 * np.sqrt((PRESETS["worn"].pot_noise_lsb ** 2 + 1 / 12) / 64 + 1 / (12 * 16**2))
    assert readings.std(axis=0) == pytest.approx(expected, rel=0.07)


def test_the_same_seed_gives_the_same_numbers():
    duty = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 6))
    runs = []
    for _ in range(2):
        arm = plant("worn", 5)
        counts = []
        for d in duty:
            counts.append(arm.sense().counts)
            arm.step(d, True)
        runs.append((np.array(counts), arm.path.copy()))
    assert (runs[0][0] == runs[1][0]).all()
    assert (runs[0][1] == runs[1][1]).all()


@pytest.mark.parametrize("name", [name for name, arm in MODELS.items() if arm.joints == 6])
def test_every_arm_can_be_built_and_driven(name):
    model = open_arm(name)
    arm = ArmPlant(model, sample_arm(model, PRESETS["worn"], 0), 0)
    rng = np.random.default_rng(0)
    for _ in range(300):
        arm.step(rng.uniform(-1, 1, 6), True)
    speed = np.abs(np.diff(arm.path, axis=0)) / TICK_S
    assert np.isfinite(speed).all()
    assert (speed[:, :6] < 1.5 * arm.motors.no_load_rad_s).all()
