"""Faults of rig, body and mounting in light simulations: projected points with noise, and an arm with errors.

Used by the tests beside it and by benchmarks/health.py.
"""

from dataclasses import replace

import numpy as np
from arm_rig import ARM, MIDDLE, Workcell, distance_mm, legs, mounts, run, small, worn

from armsight.data import Body, Correspondences, JointCommand, Points, PoseEstimate
from armsight.geometry.pose import adjoint, exp_se3, inverse, log_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.loop.estimators import Delay, KalmanEstimator, Mounting
from armsight.loop.frame_clock import FrameClock
from armsight.loop.health import HealthMonitor
from armsight.loop.health.change import widened
from armsight.loop.health.follow import RigFollower
from armsight.loop.health.rig import RigWatch
from armsight.loop.servo import LoopTiming, PoseServo
from armsight.robot.trajectories import point_to_point
from armsight.sim.example_rig import example_rig
from armsight.sim.workcell.body import body_target
from armsight.vision.pose.posefit import PixelObservations, fit_pose, whitened
from armsight.vision.triangulate import triangulate
from views import both_pixels

RATE_HZ, SIGMA_PX, SYNC_S = 30.0, 0.03, 6e-5
TRUE = example_rig(convergence_deg=1.0)
#: As of a calibration with 30 pairs: focal lengths and centre, distortion; translation m, rotation rad.
SIGMAS = np.concatenate([*2 * [[0.05] * 4 + [5e-4, 1e-3, 2e-5, 2e-5, 1e-3]], 3 * [1e-5], 3 * [2e-5]])
BODY = body_target().body


def measured(rig, body, T_start, uv):
    """The pose of a body from pixels (N, 2, 2), as vision makes it."""
    seen = Correspondences(np.arange(len(uv)), uv, np.tile(SIGMA_PX**2 * np.eye(2), (len(uv), 2, 1, 1)))
    observations = PixelObservations.of(seen, rig.sigma_px)
    fit = fit_pose(rig.cameras, rig.T_left_right, body.points, observations, T_start, robust=False)
    _, A, B = whitened(rig.cameras, rig.T_left_right, body.points, observations, fit.T_left_body)
    noise = np.linalg.inv(fit.information)
    gain = noise @ A.T @ B
    points = triangulate(rig, body, seen)
    points = Points(points.ids, points.p_left, points.cov, points.calibration, seen)
    return PoseEstimate(fit.T_left_body, noise + gain @ rig.cov @ gain.T, noise, 0.0, 0.0, 1.0, points)


def ripple(amplitude_px, waves, phase):
    """A lens that displaces by so much, with so many waves over width and height."""

    def displaced(side, uv):
        angle = 2 * np.pi * (uv / TRUE.cameras[side].image_size_px) @ waves + phase + side
        return uv + amplitude_px * np.stack([np.sin(angle), np.cos(angle)], axis=-1)

    return displaced


def tilt(deg):
    """Sensors that are tilted, each about another axis."""

    def displaced(side, uv):
        f, centre = TRUE.cameras[side].intrinsics[0], TRUE.cameras[side].intrinsics[2:]
        return centre + (uv - centre) / (1 - np.radians(deg) * (uv - centre)[..., side, None] / f)

    return displaced


def calibrated_with(lens, rng):
    """The rig that a calibration finds with such lenses, and the true frame of the left camera in its own.

    Its model cannot express them: what is left is its noise.
    """
    free = replace(TRUE, cov=np.diag((300 * SIGMAS) ** 2), sigma_px=0.1)
    for _ in range(3):
        watch, seen = RigWatch(free, BODY, 0.0), []
        for _ in range(40):
            T = pose(exp_so3(rng.uniform(-0.6, 0.6, 3)), np.array([0.1, 0, 0.9]) + rng.uniform(-0.25, 0.25, 3))
            uv = both_pixels(TRUE, BODY.points @ T[:3, :3].T + T[:3, 3])
            seen.append((T, measured(free, BODY, T, np.stack([lens(side, uv[:, side]) for side in range(2)], axis=1))))
        sums, _ = watch.information([each for _, each in seen])
        count, L = free.parameter_count, watch.prior[: free.parameter_count, : free.parameter_count]
        H, b = L.T @ sums.H[:count, :count] @ L + np.eye(count), L.T @ sums.b[:count]
        free = free.perturbed(L @ np.linalg.solve(H, b))
    left = (sums.square - b @ np.linalg.solve(H, b)) / sums.freedom
    sigma_px = float(np.hypot(0.1, SIGMA_PX) * np.sqrt(left))
    wider = np.hypot(1.0, sigma_px / SIGMA_PX)
    # Rotated cameras are shifted images: the frame of the left one is the calibration's own.
    moved = [measured(free, BODY, T, each.points.seen.uv).T_left_body @ np.linalg.inv(T) for T, each in seen]
    middle = pose(np.eye(3), [0.1, 0, 0.9])
    mean = middle @ exp_se3(np.mean([log_se3(inverse(middle) @ D @ middle) for D in moved], axis=0)) @ inverse(middle)
    given = free.perturbed(wider * SIGMAS * rng.normal(size=count))
    return replace(given, cov=np.diag((wider * SIGMAS) ** 2), sigma_px=sigma_px), mean


def strained(matrix, bent=0.0):
    """Displacements of the body's points, m: by a matrix (3, 3) of strains, and bent by so much, 1/m, about y.

    A shear is taken with half of it across either axis: the rest is a rotation of the body's axes, which are its points'.
    """
    from_middle = BODY.points - BODY.points.mean(axis=0)
    return from_middle @ (0.5 * (matrix + np.transpose(matrix))) + 0.5 * bent * np.outer(
        from_middle[:, 0] ** 2, [0.0, 0.0, 1.0]
    )


def watched_body(
    seed,
    *,
    rotated=None,
    scale=1.0,
    skew_s=0.0,
    row_s=0.0,
    focal=None,
    at_s=0.0,
    seconds=12.0,
    lens=None,
    shift=0.0,
    nod=None,
    measure=None,
):
    """Watch a body that moves and rests; yield the monitor, the time, the true pose, and what it returned for each shot.

    From ``at_s`` on cameras and points of the body are displaced, the right camera exposes late by ``skew_s`` (or that of
    the number of the shot, s) and each row of it (of both, where two are given) by ``row_s`` later than the one above,
    and focal lengths change by a share of themselves, ``focal`` of the time since then, left and right. ``nod``: of a
    side, its camera rotates about its own axes by (side, amplitude (3,), rad, frequency, Hz, or a function of the time
    since then, s, that the amplitude is multiplied by). ``measure``: returns the pose of a shot at a time, s, from rig,
    body, pixels and the true pose as a function of time; as by simultaneous cameras if None.
    """
    rng = np.random.default_rng(seed)
    if lens is None:
        given, frame = TRUE.perturbed(SIGMAS * rng.normal(size=len(SIGMAS))), np.eye(4)
        given = replace(given, cov=np.diag(SIGMAS**2), sigma_px=0.0)
    else:
        given, frame = calibrated_with(lens, rng)
    moved = (
        TRUE
        if rotated is None
        else replace(TRUE, T_left_right=TRUE.T_left_right @ exp_se3(np.append(np.zeros(3), rotated)))
    )
    body = Body(BODY.name, BODY.point_names, scale * BODY.points)
    points = BODY.points + 2e-5 * rng.normal(size=BODY.points.shape)
    monitor = HealthMonitor(given, body, SYNC_S)
    rates, phases = rng.uniform(0.05, 0.2, 6), rng.uniform(0, 2 * np.pi, 6)

    def body_at(t):
        u = np.sin(2 * np.pi * rates * min(t, 0.6 * seconds) + phases)  # it rests at the end
        return pose(exp_so3(0.3 * u[3:]), np.array([0.1, 0.0, 0.9]) + np.array([0.12, 0.08, 0.12]) * u[:3])

    for k in range(round(seconds * RATE_HZ)):
        t = k / RATE_HZ
        on, T = t >= at_s, body_at(t)
        late_s = (skew_s(k) if callable(skew_s) else skew_s) * on
        late = body_at(t + late_s)
        true = moved if on else TRUE
        there = points + shift * on
        uv, uv_late = (both_pixels(true, there @ each[:3, :3].T + each[:3, 3]) for each in (T, late))
        uv[:, 1] = uv_late[:, 1]
        if nod is not None and t >= at_s:
            side, amplitude, hz = nod
            by = exp_so3(amplitude * (hz(t - at_s) if callable(hz) else np.sin(2 * np.pi * hz * t))).T
            frame_of = [np.eye(4), inverse(true.T_left_right)][side] @ T
            at = (there @ frame_of[:3, :3].T + frame_of[:3, 3]) @ by.T
            uv[:, side] = true.cameras[side].project(at)
        for side, each_s in enumerate(np.broadcast_to(row_s, 2) * ([1, 1] if np.ndim(row_s) else [0, 1]) * on):
            for n, row in enumerate(uv[:, side, 1] + 0.5 - TRUE.right.image_size_px[1] / 2 if each_s else ()):
                rolled = body_at(t + side * late_s + each_s * row)
                uv[n, side] = both_pixels(true, (there @ rolled[:3, :3].T + rolled[:3, 3])[n : n + 1])[0, side]
        if focal is not None and on:
            for side, share in enumerate(focal(t - at_s)):
                middle = TRUE.cameras[side].intrinsics[2:]
                uv[:, side] = middle + (1.0 + share) * (uv[:, side] - middle)
        if lens is not None:
            uv = np.stack([lens(side, uv[:, side]) for side in range(2)], axis=1)
        noisy = uv + SIGMA_PX * rng.normal(size=uv.shape)
        estimate = (
            measured(given, body, frame @ T, noisy) if measure is None else measure(given, body, t, noisy, body_at)
        )
        yield monitor, t, frame @ T, estimate, monitor.measured(estimate, t)


def ended(seed, **fault):
    """The findings at the end of a run."""
    *_, (monitor, *_) = watched_body(seed, **fault)
    return monitor.findings()


def bending(rad, along=(0.0, 0.0, 1.0)):
    """A bracket, along an axis of the tool, that bends by so much under gravity: by how much it rotates the body (6,)."""
    return lambda R: np.append(np.zeros(3), rad * np.cross(along, R.T @ [0.0, 0.0, -1.0]))


LEARNED_S, AT_S = 5.0, 6.5
#: From the rig of ``arm_rig``, whose axes are any, to cameras that look at the arm.
LOOKS = pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))


class Moved:
    """An estimator whose cameras move at a time, which it does not know; it is watched once it has learned the arm."""

    def __init__(self, estimator, T_base_rig, motion, slip=None, late=None, follows=False, zoom=None):
        self.zoom = zoom  # by which share both focal lengths are longer, at seconds after AT_S
        self.estimator, self.motion, self.T_base_rig = estimator, motion, T_base_rig
        self.slip = slip  # of the body on the tool (6,), [m; rad], or a function of the tool's rotation that returns it
        self.late = late  # by how much the stamps are late, s, at seconds after AT_S
        self.monitor = HealthMonitor(example_rig(), body_target().body, 0.0)
        self.monitor.stamps = FrameClock()
        self.found_s = None
        self.follower = RigFollower(example_rig(), body_target().body) if follows else None
        self.mounting = Mounting(T_base_rig, np.eye(4), np.zeros((12, 12)))
        self.corrections, self.looked_s = [], 0.0

    @staticmethod
    def zoomed(T_left_body, by):
        """The pose of the body as images show it that are larger by a factor."""
        uv = both_pixels(TRUE, BODY.points @ T_left_body[:3, :3].T + T_left_body[:3, 3])
        middles = np.array([camera.intrinsics[2:] for camera in TRUE.cameras])
        return measured(TRUE, BODY, T_left_body, middles + by * (uv - middles)).T_left_body

    def joints(self, states):
        self.estimator.joints(states)

    def track(self, t_s):
        return self.estimator.track(t_s)

    def estimate(self):
        return self.estimator.estimate()

    def tool(self, q, qd, *, pressed=False):
        return self.estimator.tool(q, qd, pressed=pressed)

    def vision(self, measurement):
        t_s, T = measurement.t_s, self.T_base_rig
        if t_s >= LEARNED_S and self.estimator.on_innovation is None:
            self.monitor.follow(self.estimator, ARM, replace(self.mounting, T_base_rig=T @ LOOKS))
        if t_s >= AT_S:
            D = T @ np.linalg.inv(small(self.motion(t_s - AT_S))) @ np.linalg.inv(T)
            measurement = replace(measurement, T_base_tool=D @ measurement.T_base_tool)
            if self.zoom is not None:
                zoomed = self.zoomed(inverse(T @ LOOKS) @ measurement.T_base_tool, 1.0 + self.zoom(t_s - AT_S))
                measurement = replace(measurement, T_base_tool=T @ LOOKS @ zoomed)
            if self.slip is not None:
                slip = self.slip(measurement.T_base_tool[:3, :3]) if callable(self.slip) else self.slip
                measurement = replace(measurement, T_base_tool=measurement.T_base_tool @ small(slip))
        if self.late is not None:
            late_s = self.late(t_s - AT_S) if t_s >= AT_S else 0.0
            sane_s = self.monitor.stamps.time(t_s + late_s, self.estimator.span_s[1])
            if self.monitor.stamps_ran:
                self.monitor.stamps_right()
            if sane_s is None:
                return None
            measurement = replace(measurement, t_s=sane_s)
        if self.corrections:
            T = self.mounting.T_base_rig @ np.linalg.inv(T) @ measurement.T_base_tool
            by = adjoint(np.linalg.inv(T) @ self.mounting.T_base_rig)
            common = measurement.cov_common + by @ self.mounting.cov[:6, :6] @ by.T
            measurement = replace(measurement, T_base_tool=T, cov_common=common)
        outcome = self.estimator.vision(widened(measurement, self.monitor.every_change))
        self.monitor.work()
        if self.follower is not None and t_s - self.looked_s > 0.25:
            self.looked_s = t_s
            found = self.follower.look(self.monitor, list, self.mounting.T_base_rig, t_s)
            correction = None if found is None else found()
            if correction is not None:
                self.mounting = correction.mounting(self.mounting)
                self.monitor.put_right(correction)
                self.follower.put_right(correction)
                self.corrections.append(correction)
        if self.found_s is None and self.monitor.findings():
            self.found_s = t_s
        return outcome


def closed_loop(seed, motion=lambda t_s: np.zeros(6), *, closes=True, follows=False, seconds=24.0):
    """A closed loop between poses, its rig moved at AT_S.

    Args:
        seed: of the arm.
        motion: of the rig.
        closes: whether the loop is closed; else the potentiometers alone bring the tool there.
        follows: whether the rig is put right.
        seconds: duration.

    Returns:
        Of each 16 ms the time, s, the distance of the true tool from its reference, mm, whether the arm rests, the mode;
        and what was put right.
    """
    rng = np.random.default_rng(seed)
    true, said = mounts(rng)
    mount = true, Mounting(true[0], true[1], said.cov)
    moved = Moved(KalmanEstimator(ARM, delay=Delay(0.0, 2e-4), learns_delay=False), true[0], motion, follows=follows)
    workcell = Workcell(rng, worn(rng), moved, mount=mount)
    workcell.advance(None, 300)
    servo, goals = PoseServo(ARM, LoopTiming(0.016, 1 / 60, 0.061)), [MIDDLE]
    rows = []
    while workcell.t_s < seconds:
        goals.append(MIDDLE + np.radians(18.0) * rng.uniform(-1, 1, 6))
        way, begin_s = point_to_point(ARM, goals[-2], goals[-1]), workcell.t_s
        while workcell.t_s < begin_s + way.duration_s + 1.0:
            t_s = workcell.t_s - begin_s
            health = moved.monitor
            step = servo.step(servo.aim(way, t_s), moved, health.trust, health.before)
            ahead = way.at(t_s + 0.016)
            alone = JointCommand(ahead.q, ahead.qd, np.zeros(6), 0.016)
            T = workcell.advance(step.command if closes else alone, 16)[-1]
            off = distance_mm(T, ARM.forward(way.at(workcell.t_s - begin_s).q))
            rows.append((workcell.t_s, float(off), t_s > way.duration_s + 0.5, step.mode))
    return rows, moved.corrections


class SlippingArm:
    """An arm of which one potentiometer slips on its shaft, by so much, or whose backlash grows, at AT_S."""

    def __init__(self, arm, joint, slip_rad, more_rad):
        self.arm, self.joint, self.slip_rad, self.more_rad = arm, joint, slip_rad, more_rad

    def tool(self, shaft):
        at = round(AT_S / 1e-3)
        before = self.arm.tool(shaft[:at])
        self.arm.backlash = self.arm.backlash + np.eye(6)[self.joint] * self.more_rad
        beyond = self.slip_rad * np.eye(6)[self.joint]
        zeros, self.arm.linearity = self.arm.linearity, lambda q: zeros(q) + beyond
        return np.concatenate([before, self.arm.tool(shaft[at:])])


def watched_arm(
    seed, motion=lambda t_s: np.zeros(6), seconds=9.0, *, slip=None, joint=0, slip_rad=0.0, more_rad=0.0, late=None,
    delay=(0.0, 1e-4), zoom=None,
):  # fmt: skip
    """Run an arm with errors; return the estimator with its monitor, its track and the true poses.

    The faults, at AT_S: a motion of the rig, a slip of the body on the tool (6,), [m; rad], a slip of a joint's
    potentiometer or more backlash of it, rad; stamps that are late, s. ``delay``: by how much the delay of the images is
    off from the beginning, and its sigma, s; ``zoom``: by which share both focal lengths are longer, seconds after AT_S.
    """
    rng = np.random.default_rng(seed)
    mount = mounts(rng)
    estimator = KalmanEstimator(ARM, delay=Delay(0.0, delay[1]), learns_delay=False)
    moved = Moved(estimator, mount[1].T_base_rig, motion, slip, late, zoom=zoom)
    arm = worn(rng)
    if slip_rad or more_rad:
        arm = SlippingArm(arm, joint, slip_rad, more_rad)
    moved.tracked, moved.Ts_true = run(rng, moved, arm, legs(rng, seconds), mount=mount, late_s=delay[0])
    return moved
