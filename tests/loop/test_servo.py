"""The loop closed on vision: what it gains, that it does not swing, its limits, and what it does when vision is lost."""

from dataclasses import replace

import numpy as np
import pytest
from arm_rig import ARM, MIDDLE, TICK_S, Workcell, distance_mm, mounts, rms, worn

from armsight.app.replay.run import ESTIMATORS
from armsight.data import JointCommand
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3
from armsight.loop.estimators import ArmEstimate, Delay, Mounting
from armsight.loop.health import Trust
from armsight.loop.servo import (
    MAX_CORRECTION_RAD,
    RATE_SHARE,
    STEP_LEVER_M,
    JointLoops,
    LoopTiming,
    Mode,
    PoseServo,
    likely_joint_errors,
    whole_steps,
)
from armsight.robot.arm_file import open_arm
from armsight.robot.trajectories import point_to_point

PERIOD_S = 0.016
RATES_HZ = (4, 30, 120)
GOAL = MIDDLE + np.radians([15, -10, 12, -14, 10, 20])


def timing(rate_hz, response_s=0.05):
    return LoopTiming(PERIOD_S, 1 / rate_hz, 0.045 + PERIOD_S, response_s)


def workcell_of(seed, rate_hz, kind="kalman", **more):
    """A worn arm under cameras whose pose is known: the error that the loop itself leaves shows."""
    rng = np.random.default_rng(seed)
    true, said = mounts(rng)
    mount = true, Mounting(true[0], true[1], said.cov)
    workcell = Workcell(
        rng, worn(rng), ESTIMATORS[kind](ARM, delay=Delay(0.0, 2e-4)), rate_hz=rate_hz, mount=mount, **more
    )
    workcell.advance(None, 300)
    return workcell


def follow(workcell, motion, servo, seconds, each=lambda step: None):
    """Run a motion and stay at its end, ``seconds`` in all; return the true tool's distances from the reference, mm."""
    ticks, apart = round(PERIOD_S / TICK_S), []
    for k in range(round(seconds / PERIOD_S)):
        t_s = k * PERIOD_S
        if servo is None:
            ahead = motion.at(t_s + PERIOD_S)
            command = JointCommand(ahead.q, ahead.qd, np.zeros(6), PERIOD_S)
        else:
            step = servo.step(servo.aim(motion, t_s), workcell.estimator)
            each(step)
            command = step.command
        reference = ARM.forward(motion.at(t_s + np.arange(1, ticks + 1) * TICK_S).q)
        apart.append(distance_mm(workcell.advance(command, ticks), reference))
    return np.concatenate(apart)


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_the_error_at_rest_falls_to_a_tenth_and_that_along_the_path_to_a_third_without_swinging(rate_hz):
    there, back = point_to_point(ARM, MIDDLE, GOAL), point_to_point(ARM, GOAL, MIDDLE)
    for seed in (21, 31, 32):
        workcell = workcell_of(seed, rate_hz)
        servo = PoseServo(ARM, timing(rate_hz))
        settle_s = 4 * servo.timing.period_s / servo.timing.gain + 1.0
        alone = follow(workcell, there, None, there.duration_s + 0.5)
        closing = follow(workcell, point_to_point(ARM, GOAL, GOAL + 1e-9), servo, settle_s)
        path = follow(workcell, back, servo, back.duration_s + settle_s)
        moving = round(back.duration_s / TICK_S)
        before, after = rms(alone[-100:]), rms([rms(closing[-100:]), rms(path[-100:])])
        assert after <= min(0.15, before / 10)
        assert rms(path[:moving]) <= rms(alone[: round(there.duration_s / TICK_S)]) / 3
        # Swinging would show as a rise after a fall: at rest the error may rise by what vision's noise makes it, and
        # backlash that is crossed by its learned width, a tenth of a millimetre each.
        for rest in (closing, path[moving + 200 :]):
            assert (rest - np.minimum.accumulate(rest)).max() < 0.2


@pytest.mark.parametrize("loose", [0.0, 1.0], ids=["tight gears", "loose gears"])
@pytest.mark.parametrize("rate_hz", [4, 60])
def test_on_bare_vision_it_does_not_swing_either(rate_hz, loose):
    workcell = workcell_of(22, rate_hz, "latest", response_s=0.08)  # slower joints than the loop assumes
    workcell.arm.backlash = loose * workcell.arm.backlash
    servo = PoseServo(ARM, timing(rate_hz))
    before = follow(workcell, point_to_point(ARM, MIDDLE, MIDDLE + 1e-9), None, 0.5)
    closing = follow(workcell, point_to_point(ARM, MIDDLE, MIDDLE + 1e-9), servo, 5 * PERIOD_S / servo.timing.gain + 1)
    assert rms(closing[-100:]) < before[-1] / 10
    assert np.ptp(closing[-500:]) < 0.15
    # While gears are crossed one after the other the distance need not fall all the way; without them it must.
    assert (closing - np.minimum.accumulate(closing)).max() < (0.15 if loose == 0.0 else before[-1] / 5)


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_the_gain_rule_is_the_edge_of_overshoot_and_far_from_that_of_stability(rate_hz):
    t = timing(rate_hz)
    delay = round((t.latency_s + t.vision_period_s + t.response_s) / t.period_s)
    exact = LoopTiming(t.period_s, delay * t.period_s / 2, delay * t.period_s / 4, delay * t.period_s / 4).gain

    def response(gain):
        c = [1.0] * (delay + 1)
        for _ in range(60 * (delay + 1)):
            c.append(c[-1] - gain * c[-1 - delay])
        return np.array(c)

    assert exact == pytest.approx(delay**delay / (delay + 1) ** (delay + 1))
    assert response(exact).min() > -1e-9
    assert response(1.2 * exact).min() < -1e-9
    limit = 2 * np.sin(np.pi / (4 * delay + 2))
    assert limit / exact > 4
    assert np.abs(response(0.97 * limit)[-delay - 1 :]).max() < np.abs(response(1.03 * limit)[-delay - 1 :]).max() / 2


def test_when_vision_is_lost_it_says_so_holds_and_comes_back():
    left = []
    for seed in (22, 23, 24):
        workcell = workcell_of(seed, 60)
        servo = PoseServo(ARM, timing(60))
        still = point_to_point(ARM, MIDDLE, MIDDLE + 1e-9)
        follow(workcell, still, servo, 3.0)
        steps = []
        workcell.blind = True
        apart = follow(workcell, point_to_point(ARM, MIDDLE, GOAL), servo, 3.0, steps.append)
        modes = [step.mode for step in steps]
        assert modes[0] is Mode.VISION
        assert Mode.BRIDGED in modes
        assert modes[-1] is Mode.POTENTIOMETERS
        assert "vision is lost" in modes[-1].value
        lost = len(modes) - next(n for n, mode in enumerate(modes[::-1]) if mode is not Mode.POTENTIOMETERS)
        held = np.array([step.correction for step in steps[lost:]])
        assert len(held) > 100
        assert np.allclose(held, held[0], rtol=0, atol=1e-14)
        workcell.blind = False
        seeing = follow(workcell, point_to_point(ARM, GOAL, GOAL + 1e-9), servo, 3.0, steps.append)
        assert steps[-1].mode is Mode.VISION
        assert seeing[-1] < apart[-1] / 3
        left.append(seeing[-1])
    assert rms(left) < 0.2


def test_without_any_vision_the_motion_is_commanded_as_it_is():
    workcell = workcell_of(24, 60)
    workcell.estimator = ESTIMATORS["kalman"](ARM, delay=Delay(0.0, 2e-4))
    workcell.blind = True
    workcell.coming.clear()
    workcell.advance(None, 100)
    motion = point_to_point(ARM, MIDDLE, GOAL)
    servo = PoseServo(ARM, timing(60))
    step = servo.step(servo.aim(motion, 0.3, lambda q: np.full(6, 0.1)), workcell.estimator)
    ahead = motion.at(0.3 + PERIOD_S)
    assert step.mode is Mode.POTENTIOMETERS
    assert np.array_equal(step.command.q_ref, ahead.q)
    assert np.array_equal(step.command.qd_ref, ahead.qd)
    assert (step.command.gravity_duty == 0.1).all()
    assert step.command.duration_s == PERIOD_S


def test_a_tool_that_is_displaced_is_brought_back_no_faster_than_it_may():
    """Without noise: the tool is 10 mm from where the joints put it, and the estimator says so."""
    shift = np.array([8e-3, -4e-3, 4e-3])

    class Displaced:
        def __init__(self):
            self.q = MIDDLE

        def estimate(self):
            T, none = self.tool(self.q[None], None)[0], np.zeros(6)
            return ArmEstimate(0.0, T, np.eye(6) * 1e-12, np.eye(6) * 1e-12, self.q, none, 0.01)

        def tool(self, q, qd, *, pressed=False):
            Ts = ARM.forward(q)
            Ts[:, :3, 3] += shift
            return Ts

    estimator, servo, motion = Displaced(), PoseServo(ARM, timing(60)), point_to_point(ARM, MIDDLE, MIDDLE + 0.1)
    before = np.zeros(6)
    for k in range(60):
        step = servo.step(servo.aim(motion, k * PERIOD_S), estimator)
        assert (np.abs(step.correction - before) <= RATE_SHARE * ARM.qd_max * PERIOD_S * (1 + 1e-9)).all()
        before, estimator.q = step.correction, step.command.q_ref
    reached = estimator.estimate().T_base_tool[:3, 3]
    assert np.linalg.norm(reached - ARM.forward(motion.at(60 * PERIOD_S).q)[:3, 3]) < 0.1 * np.linalg.norm(shift)


def test_commands_stay_within_every_limit_and_do_not_jump():
    workcell = workcell_of(25, 60)
    # The arm's foot is knocked: 40 mm to make up for, towards joints that are at their limits already.
    workcell.arm.smalls[0] = workcell.arm.smalls[0].copy()
    workcell.arm.smalls[0][:3, 3] += [0.04, 0.03, -0.03]
    edge = MIDDLE.copy()
    edge[[1, 2]] = [ARM.q_max[1] - 2.5, ARM.q_max[2] - 0.01]
    for q in (MIDDLE, edge):
        workcell.shaft = workcell.reference = q
        workcell.advance(None, 400)
        servo, steps = PoseServo(ARM, timing(60)), []
        follow(workcell, point_to_point(ARM, q, q - 0.3), servo, 3.0, steps.append)
        refs = np.array([step.command.q_ref for step in steps])
        assert (refs >= ARM.q_min).all()
        assert (refs <= ARM.q_max).all()
        assert (np.abs([step.command.qd_ref for step in steps]) <= ARM.qd_max).all()
        assert (np.abs(np.diff(refs, axis=0)) <= ARM.qd_max * PERIOD_S * (1 + 1e-9)).all()
        corrections = np.array([step.correction for step in steps])
        assert (np.abs(corrections) <= MAX_CORRECTION_RAD + 1e-12).all()
        moved = np.abs(np.diff(corrections, axis=0))
        free = [not step.limited for step in steps[1:]]
        assert (moved[free] <= RATE_SHARE * ARM.qd_max * PERIOD_S * (1 + 1e-9)).all()
    assert any("largest correction" in text or "limit of its angle" in text for step in steps for text in step.limited)


@pytest.mark.parametrize("q", [ARM.home, np.radians([10, -100, 100, -20, 0, 5])], ids=["extended", "wrist"])
def test_singular_poses_do_not_make_it_wild(q):
    rng = np.random.default_rng(26)
    true, said = mounts(rng)
    workcell = Workcell(rng, worn(rng), ESTIMATORS["kalman"](ARM, delay=Delay(0.0, 2e-4)), q=q, mount=(true, said))
    workcell.advance(None, 300)
    servo, steps = PoseServo(ARM, timing(60)), []
    apart = follow(workcell, point_to_point(ARM, q, q + 1e-9), servo, 3.0, steps.append)
    assert apart[-1] <= apart[0] + 0.3
    assert np.abs(steps[-1].correction).max() < MAX_CORRECTION_RAD


def test_times_must_be_positive():
    with pytest.raises(InputError, match=r"latency_s is -0\.1; it must be a positive number of seconds"):
        LoopTiming(0.016, 0.016, -0.1)


def test_what_must_not_be_trusted_is_taken_back_and_what_is_doubted_is_held():
    workcell = workcell_of(25, 60)
    servo = PoseServo(ARM, timing(60))
    still = point_to_point(ARM, MIDDLE, MIDDLE + 1e-9)
    follow(workcell, still, servo, 2.0)
    closed = servo.step(servo.aim(still, 1.0), workcell.estimator)
    held = servo.step(servo.aim(still, 1.0), workcell.estimator, Trust.DOUBTED)
    assert held.mode is Mode.HELD
    assert np.abs(held.correction - closed.correction).max() < 1e-12
    assert np.abs(held.correction).max() > 1e-3
    before = workcell.estimator.as_before(workcell.estimator.remembered())
    for _ in range(60):
        kept = servo.step(servo.aim(still, 1.0), workcell.estimator, Trust.NONE, before)
    assert kept.mode is Mode.DISTRUSTED
    assert np.abs(kept.correction - closed.correction).max() < 0.1 * np.abs(closed.correction).max()
    for _ in range(60):
        back = servo.step(servo.aim(still, 1.0), workcell.estimator, Trust.NONE)
    assert back.mode is Mode.DISTRUSTED
    assert np.abs(back.correction).max() < 1e-12
    assert servo.step(servo.aim(still, 1.0), workcell.estimator).mode is Mode.VISION


def test_the_correction_displaces_the_tool_by_no_more_than_its_bound(monkeypatch):
    monkeypatch.setattr("armsight.loop.servo.MAX_CORRECTION_M", 0.01)

    class Misled:
        """An estimator that has the tool half a metre from where it is."""

        def __init__(self, estimator):
            self._estimator = estimator

        def estimate(self):
            there = self._estimator.estimate()
            T = there.T_base_tool.copy()
            T[:3, 3] += [0.5, 0.0, 0.0]
            return replace(there, T_base_tool=T)

        def tool(self, q, qd, *, pressed=False):
            return self._estimator.tool(q, qd, pressed=pressed)

    workcell = workcell_of(26, 60)
    servo = PoseServo(ARM, timing(60))
    still = point_to_point(ARM, MIDDLE, MIDDLE + 1e-9)
    limited = set()
    for _ in range(200):
        step = servo.step(servo.aim(still, 1.0), Misled(workcell.estimator))
        limited |= set(step.limited)
        assert np.linalg.norm(ARM.jacobian(MIDDLE)[:3] @ step.correction) < 0.01001
        workcell.advance(step.command, 16)
    assert "tool: largest correction" in limited


def test_whole_steps_are_whole_and_no_worse_than_each_joint_rounded():
    rng = np.random.default_rng(4)
    arm = open_arm("ar4")
    steps = np.radians(1 / np.array([44.4, 55.6, 55.6, 49.8, 21.9, 22.2]))
    left, rounded = np.empty(20), np.empty(20)
    for k in range(20):
        J = arm.jacobian(arm.home + rng.uniform(-0.5, 0.5, 6))
        requested = steps * rng.uniform(-4, 4, 6)
        change = whole_steps(J, requested, steps)
        np.testing.assert_allclose(change / steps, np.rint(change / steps), atol=1e-9)
        lever = np.repeat([1.0, STEP_LEVER_M], 3)
        left[k] = np.linalg.norm(lever * (J @ (requested - change)))
        rounded[k] = np.linalg.norm(lever * (J @ (requested - steps * np.rint(requested / steps))))
        np.testing.assert_array_equal(whole_steps(J, 0.05 * requested / 4, steps), 0.0)  # it would hunt
    assert (left <= rounded + 1e-9).all()
    assert left.mean() < 0.95 * rounded.mean()


def test_backlash_is_crossed_by_whole_steps_where_that_is_worth_it_and_not_known_to_be_wrong():
    J, steps = np.zeros((6, 2)), np.full(2, 1e-3)
    J[0] = [0.3, 0.29]
    gaps = np.array([[0.0, 5.2e-3], [5.2e-3, 0.0]])
    up = whole_steps(J, np.array([0.0, 3e-3]), steps, gaps)
    np.testing.assert_allclose(
        up, [3e-3, 0.0], atol=1e-12
    )  # the joint that has no backlash to cross moves for the other
    down = whole_steps(J, np.array([-3e-3, 0.0]), steps, gaps)
    np.testing.assert_allclose(down, [0.0, -3e-3], atol=1e-12)
    alone = whole_steps(J[:, :1], np.array([-12e-3]), steps[:1], gaps[:, :1])
    np.testing.assert_allclose(alone, [-17e-3], atol=1e-12)  # 17 steps less 5.2 of backlash
    none = whole_steps(J[:, :1], np.array([-2e-3]), steps[:1], gaps[:, :1])
    np.testing.assert_array_equal(none, 0.0)  # half of 5.2 is more than 2


@pytest.mark.parametrize(("rest_s", "moves"), [(0.9, False), (1.5, True)])
def test_no_change_of_whole_steps_is_begun_that_would_not_be_over_when_the_arm_moves_on(rest_s, moves):
    class Off:
        """Sees a tool that is 2 mm from where its joints would bring it."""

        def estimate(self):
            return ArmEstimate(0.0, self.tool(GOAL[None], None)[0], *[np.eye(6) * 1e-12] * 2, GOAL, np.zeros(6), 0.01)

        def tool(self, q, qd, *, pressed=False):
            Ts = ARM.forward(q)
            Ts[:, :3, 3] += 0.002
            return Ts

    servo = PoseServo(ARM, timing(60, 0.3), JointLoops((np.radians(0.02),) * 6, 0.055))
    motion, seen, at_rest = point_to_point(ARM, MIDDLE, GOAL), Off(), []
    for k in range(round((motion.duration_s + rest_s) / PERIOD_S)):
        aim = servo.aim(motion, k * PERIOD_S, rest_s=rest_s)
        correction = servo.step(aim, seen).correction
        if aim.left_s < rest_s - 0.2:
            at_rest.append(correction)
    assert (np.ptp(at_rest, axis=0).max() > 0) == moves


def test_before_the_first_image_nothing_is_asked_of_the_loop():
    timing = LoopTiming(PERIOD_S, 1 / 60, 0.045)
    assert timing.gain_at(np.inf) == 0.0  # the age of no measurement: never NaN, which commands would take
    assert 0.0 < timing.gain_at(10.0) < timing.gain_at(0.0) == timing.gain


def test_a_singular_arm_does_not_explain_a_millimetre_by_degrees():
    arm, q = ARM, ARM.home
    T = arm.forward(q) @ exp_se3(np.array([0.0, 0.0, 1e-3, 0.0, 0.0, 0.0]))
    assert np.degrees(np.abs(likely_joint_errors(arm, q, T))).max() < 0.8
    bent = q + np.radians([5, -20, 30, 10, 20, 5])
    errors = np.radians([0.2, -0.1, 0.3, 0.1, -0.2, 0.1])
    assert likely_joint_errors(arm, bent, arm.forward(bent + errors)) == pytest.approx(errors, abs=1e-3)
