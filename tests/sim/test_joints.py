"""Six joints to drive: their motion against the motor's equations solved by hand, their readings, and what breaks."""

import math

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.sim import joints
from armsight.sim.joints import JointPlant, PotFault

ON = np.full(6, 0.5)
#: K and R as in the module: volts that friction takes away at rest and per rad/s.
DRY_V = joints.DRY_N_M * joints.RESISTANCE_OHM / joints.CONSTANT_V_S
PER_RAD_S = joints.CONSTANT_V_S + joints.VISCOUS_N_M_S * joints.RESISTANCE_OHM / joints.CONSTANT_V_S
TAU_S = joints.INERTIA_KG_M2 * joints.RESISTANCE_OHM / joints.CONSTANT_V_S / PER_RAD_S
#: Backward Euler's share of a step in the time constant: its error in a transient, by steps of 0.25 ms.
STEP = 0.25e-3 / TAU_S


def run(plant, duty, ticks, on=True):
    for _ in range(ticks):
        plant.sense()
        plant.step(duty, on)
    return plant


def test_the_speed_rises_as_the_motors_equation_says():
    plant = JointPlant()
    final = (0.5 * 12.0 - DRY_V) / PER_RAD_S
    for tick in range(1, 151):
        run(plant, ON, 1)
        exact = final * (1 - math.exp(-tick * 1e-3 / TAU_S))
        assert np.abs(plant.qd - exact).max() < STEP * final
    assert final == pytest.approx(2.25, abs=0.05)


def test_the_current_is_what_drives_it():
    plant = run(JointPlant(), ON, 400)
    torque = joints.DRY_N_M + joints.VISCOUS_N_M_S * plant.qd
    expected_ma = torque / joints.CONSTANT_V_S * 1e3
    assert np.abs(plant.sense().current_ma - expected_ma).max() < 2  # whole mA of the tick's end
    assert plant.sense().current_ma.dtype == np.int32


def test_a_motor_without_drive_coasts_and_a_shorted_one_brakes():
    coasting, braking = (run(JointPlant(), ON, 300) for _ in range(2))
    start = coasting.qd[0]
    run(coasting, np.zeros(6), 100, on=False)
    run(braking, np.zeros(6), 100, on=True)
    assert coasting.sense().current_ma.tolist() == [0] * 6
    # Only friction: qd falls by (dry + viscous qd) / J.
    assert coasting.qd[0] == pytest.approx(start - 0.1 * 0.21 / 0.03, abs=0.1)
    assert braking.qd.tolist() == [0.0] * 6
    run(coasting, np.zeros(6), 400, on=False)
    assert coasting.qd.tolist() == [0.0] * 6


def test_dry_friction_holds_a_joint_at_rest():
    plant = run(JointPlant(), np.full(6, 0.99 * DRY_V / 12), 500)
    assert plant.q.tolist() == [0.0] * 6
    run(plant, np.full(6, 1.05 * DRY_V / 12), 500)
    assert (plant.q > 0).all()


def test_stops_stop_and_what_is_blocked_stands():
    plant = JointPlant(np.full(6, 2.4))
    plant.blocked[3] = True
    run(plant, np.full(6, 1.0), 500)
    assert plant.q[0] == joints.STOP_RAD
    assert plant.q[3] == 2.4
    assert plant.sense().current_ma[3] == 2000
    run(plant, np.full(6, -1.0), 2500)
    assert plant.q[0] == -joints.STOP_RAD


def test_a_lower_supply_drives_less():
    plant = JointPlant()
    plant.supply_mv = 6000
    run(plant, ON, 400)
    assert plant.qd[0] == pytest.approx((3.0 - DRY_V) / PER_RAD_S, abs=0.01)


def test_readings_are_the_angles_with_noise_of_the_size_said():
    plant = JointPlant(np.linspace(-2.5, 2.5, 6))
    counts = np.array([plant.sense().counts for _ in range(4000)], dtype=float)
    # The factory's table: 3277 counts at -2.6 rad, 62258 at 2.6; rounding down loses half a step.
    true = 3277 + (plant.q + 2.6) * (62258 - 3277) / 5.2
    sigma = math.hypot(joints.NOISE_COUNTS, joints.STEP_COUNTS / math.sqrt(12))
    assert np.abs(counts.mean(0) - true + joints.STEP_COUNTS / 2).max() < 5 * sigma / math.sqrt(4000) + 0.1
    assert np.abs(counts.std(0) / sigma - 1).max() < 0.06
    assert (counts % joints.STEP_COUNTS == 0).all()
    assert np.abs(np.corrcoef(counts.T) - np.eye(6)).max() < 0.08


def test_the_same_seed_gives_the_same_readings():
    readings = [[tuple(plant.sense().counts) for _ in range(20)] for plant in (JointPlant(seed=3), JointPlant(seed=3))]
    assert readings[0] == readings[1]
    assert tuple(JointPlant(seed=4).sense().counts) != readings[0][0]


@pytest.mark.parametrize(
    ("fault", "shows"),
    [
        (PotFault.OPEN, lambda before, after: after == 65535),
        (PotFault.SHORT, lambda before, after: after == 0),
        (PotFault.FROZEN, lambda before, after: after == before),
        (PotFault.JUMP, lambda before, after: 6000 < abs(after - before) < 9000),
        (PotFault.INVERTED, lambda before, after: -5000 < after - before < -2500),
    ],
)
def test_a_broken_potentiometer_shows_as_it_says(fault, shows):
    plant = JointPlant()
    before = int(plant.sense().counts[2])
    plant.break_pot(2, fault)
    run(plant, ON, 180)  # 0.34 rad, 3800 counts further
    assert shows(before, int(plant.sense().counts[2]))
    assert 3500 < int(plant.sense().counts[1]) - before < 4200
    plant.break_pot(2, PotFault.NONE)
    assert abs(int(plant.sense().counts[2]) - int(plant.sense().counts[1])) < 50


@pytest.mark.parametrize("q", [np.zeros(5), np.full(6, 2.6), [np.nan] * 6])
def test_angles_beyond_the_stops_are_rejected(q):
    with pytest.raises(InputError, match="six angles within the stops"):
        JointPlant(q)
