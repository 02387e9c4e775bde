"""Studies of the error: its dependence on distance, baseline, resolution, noise, calibration, and rate of vision.

Out: a :class:`Study` each. :func:`vision_studies` changes one quantity at a time: it renders shots of the tool's body,
measures them with the same functions as every other command, and compares the errors with the truth and with what the
covariance predicts. :func:`rate_study` closes the loop on the circle of a run, in workcells with cameras of several rates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.special import chdtri

from armsight.app.run.devices import setup_of
from armsight.app.run.experiment import RunResult, closed_on, drive, prior_of, timing
from armsight.app.run.metrics import Study, track_metrics
from armsight.app.run.tracks import Tracks
from armsight.data import Array, PoseEstimate, Record, Shot
from armsight.geometry.pose import inverse, log_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.loop.estimators import KalmanEstimator, Mounting
from armsight.loop.running.calibrate import Progress
from armsight.loop.running.log import Log
from armsight.loop.running.loop import Loop
from armsight.loop.servo import PoseServo
from armsight.sim.example_rig import board_poses, example_rig
from armsight.sim.render.background import plain
from armsight.sim.render.optics import Sensor
from armsight.sim.render.render import kept_rays, render_pair
from armsight.sim.render.scene import PosedBody, chessboard
from armsight.sim.workcell.body import body_patterns, body_target
from armsight.sim.workcell.workcell import Workcell
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.follow.follower import Follower
from armsight.vision.markers.board import open_board
from armsight.vision.pose.measure import measure
from armsight.vision.rig import StereoRig

_BOARD = "chessboard:9x6:25mm"
_TILT = np.radians(30.0)
_SIZE, _FOCAL, _BASELINE, _DISTANCE, _NOISE = (1280, 720), 900.0, 0.2, 0.8, 2.0
_REPEATS = 3  # calibrations of each size


@dataclass(frozen=True, eq=False)
class _Errors(Record):
    """Errors (N, 3) of positions, m, the traces (N,) of their covariances, and how many shots gave none."""

    error: Array
    variance: Array
    missed: int


@dataclass(frozen=True)
class _Conditions:
    """How shots of the body at rest are rendered, with an exactly known rig."""

    distance_m: float = _DISTANCE
    baseline_m: float = _BASELINE
    width: int = _SIZE[0]
    noise: float = _NOISE


def vision_studies(*, seed: int, shots: int, progress: Callable[[str], None] = lambda line: None) -> list[Study]:
    """Make the five studies of vision, with so many shots rendered for each value."""

    def changed(name: str, unit: str, values: Sequence[float], errors: Callable[[float], _Errors]) -> Study:
        progress(f"study: error against {name}")
        with ThreadPoolExecutor(2) as both:
            return _study(name, unit, values, list(both.map(errors, values)))

    @lru_cache  # the default conditions are a value of three studies
    def seen(given: _Conditions) -> _Errors:
        rig = _rig(given.width, given.baseline_m)
        return _measured(rig, *_rendered(rig, seed, shots, given.distance_m, given.noise))

    studies = [
        changed("distance", "m", (0.5, 0.7, 0.9, 1.2, 1.6), lambda v: seen(_Conditions(distance_m=v))),
        changed("baseline", "m", (0.05, 0.1, 0.2, 0.4), lambda v: seen(_Conditions(baseline_m=v))),
        changed("image width", "px", (640, 960, 1280, 1920), lambda v: seen(_Conditions(width=int(v)))),
        changed("pixel noise", "grey levels", (1.0, 2.0, 5.0, 10.0), lambda v: seen(_Conditions(noise=v))),
        _calibration_study(seed, shots, progress),
    ]
    kept_rays.cache_clear()
    return studies


def _study(name: str, unit: str, values: Sequence[float], found: Sequence[_Errors]) -> Study:
    """Return the study of the errors at each value; its interval counts three coordinates of unequal size as two."""
    squares = np.array([(e.error**2).sum(axis=1).mean() if len(e.error) else np.nan for e in found])
    freedom = np.array([max(2 * len(e.error), 1) for e in found])
    return Study(
        name,
        unit,
        np.array(values, float),
        np.sqrt(squares),
        np.sqrt(squares * freedom / chdtri(freedom, 0.025)),
        np.sqrt(squares * freedom / chdtri(freedom, 0.975)),
        np.sqrt([e.variance.mean() if len(e.variance) else np.nan for e in found]),
        np.array([e.missed for e in found]),
    )


@lru_cache
def _default_rig(width: int) -> StereoRig:
    """Return the true rig for an image width, px; the same cameras each time, so that their rays are computed once."""
    size = (width, width * 9 // 16)
    return example_rig(size, focal_px=_FOCAL * width / _SIZE[0], baseline_m=_BASELINE, convergence_deg=0.0)


def _rig(width: int = _SIZE[0], baseline_m: float = _BASELINE) -> StereoRig:
    return replace(
        _default_rig(width), T_left_right=example_rig(baseline_m=baseline_m, convergence_deg=0.0).T_left_right
    )


def _rendered(rig: StereoRig, seed: int, shots: int, distance_m: float, noise: float) -> tuple[list[Shot], Array]:
    """Render shots of the body near the middle of the view; return them, and the body's poses (N, 4, 4), left camera."""
    rng = np.random.default_rng([seed, 7])
    across = rng.uniform(-1, 1, (shots, 3)) * (0.12, 0.06, 0.05)
    rotations = rng.uniform(-1, 1, (shots, 3)) * _TILT
    middle = np.array([rig.baseline_m / 2, 0.0, distance_m])
    Ts = np.array([pose(exp_so3(w), middle + distance_m * shift) for w, shift in zip(rotations, across, strict=True)])
    behind = tuple(plain(camera.image_size_px, rng) for camera in rig.cameras)
    patterns = body_patterns()

    def shot(k: int) -> Shot:
        own = np.random.default_rng([seed, 8, k])
        bodies = [PosedBody(patterns, Ts[k])]
        images = render_pair(
            rig.cameras, rig.T_left_right, bodies, (behind[0], behind[1]), sensor=Sensor(read_noise=noise), rng=own
        )
        return Shot(f"{k}", *images)

    return [shot(k) for k in range(shots)], Ts


def _measured(rig: StereoRig, shots: Sequence[Shot], Ts_left_body: Array) -> _Errors:
    """Measure shots and compare the positions with the true poses (N, 4, 4)."""
    target = body_target()
    error, variance = [], []
    for shot, T in zip(shots, Ts_left_body, strict=True):
        result = measure(rig, target, shot)
        if isinstance(result, PoseEstimate):
            error.append(log_se3(inverse(result.T_left_body) @ T)[:3])
            variance.append(float(np.trace(result.cov[:3, :3])))
    return _Errors(np.array(error).reshape(-1, 3), np.array(variance), len(shots) - len(error))


def _calibration_study(seed: int, shots: int, progress: Callable[[str], None]) -> Study:
    """Calibrate with more and more pairs of a target, several times each, and measure the same shots with each rig."""
    sizes, true, board = (4, 8, 16, 32), _rig(), open_board(_BOARD)
    rng = np.random.default_rng([seed, 9])
    pattern = chessboard(9, 6, 0.025)
    Ts = board_poses(rng, true, pattern, max(sizes) * 2)
    grey = (0.4, 0.4)
    progress("study: images for calibrations of several sizes")

    def pair(k: int) -> Pair:
        images = render_pair(
            true.cameras,
            true.T_left_right,
            [PosedBody((pattern,), Ts[k])],
            grey,
            rng=np.random.default_rng([seed, 10, k]),
        )
        return Pair(f"{k}", board.detect(images[0]), board.detect(images[1]))

    with ThreadPoolExecutor(2) as both:
        pairs = list(both.map(pair, range(len(Ts))))
    rendered = _rendered(true, seed, max(4, shots // 2), _DISTANCE, _NOISE)
    # Sampled beforehand, so that the samples do not depend on which calibration is done first.
    samples = [[rng.choice(len(pairs), size, replace=False) for _ in range(_REPEATS)] for size in sizes]

    def calibrated(chosen: Array) -> _Errors:
        rig = calibrate_boards(board, [pairs[k] for k in chosen], (_SIZE, _SIZE), models=("brown5",), flat=True).rig
        return _measured(rig, *rendered)

    found = []
    for size, chosen_pairs in zip(sizes, samples, strict=True):
        progress(f"study: calibrations of {size} pairs")
        with ThreadPoolExecutor(2) as both:
            each = list(both.map(calibrated, chosen_pairs))
        found.append(
            _Errors(
                np.concatenate([e.error for e in each]),
                np.concatenate([e.variance for e in each]),
                sum(e.missed for e in each),
            )
        )
    study = _study("calibration size", "pairs of the target", sizes, found)
    # The errors of the shots of one calibration are correlated: the number of calibrations counts.
    freedom = 3.0 * _REPEATS
    wide = study.position_rms_m * np.sqrt(freedom / chdtri(freedom, [[0.025], [0.975]]))
    return replace(study, low_m=wide[0], high_m=wide[1])


RATES_HZ = (4.0, 15.0, 30.0, 60.0, 120.0)


def rate_study(open_workcell: Callable[[float], Workcell], result: RunResult, progress: Progress) -> Study:
    """Make the last motions of a run, up to its circle, with the loop closed at several rates of the cameras."""

    def at(rate: float) -> tuple[float, float, int]:
        progress(f"study: vision at {rate:g} Hz in the loop")
        with open_workcell(rate) as workcell:
            return _circle(workcell, result)

    with ThreadPoolExecutor(2) as both:  # the longest first
        rows = list(both.map(at, RATES_HZ[::-1]))[::-1]
    position, predicted, count = (np.array(column) for column in zip(*rows, strict=True))
    # The errors along a circle are correlated: about one independent error every tenth of a second.
    spread = 1.96 / np.sqrt(2 * 3 * np.maximum(count / 100.0, 1.0))
    return Study(
        "rate of vision in the loop",
        "Hz",
        np.array(RATES_HZ),
        position,
        position * (1 - spread),
        position * (1 + spread),
        predicted,
        np.zeros(len(rows), int),
    )


def _circle(workcell: Workcell, result: RunResult) -> tuple[float, float, int]:
    """Move to the circle and along it; return the fused RMS error, m, the claimed one, and the readings' count."""
    assert result.handeye is not None
    setup, mounting, plan = setup_of(workcell), result.handeye.mounting, result.plan
    setup.board.enable()
    follower, log = Follower(result.rig, setup.target, setup.sync_s), Log()
    estimator = KalmanEstimator(setup.arm, prior=prior_of(setup.board), delay=result.delay, learns_delay=False)
    loop = Loop.open(setup, follower, log, estimator)
    loop.mounting, loop.delay_s, loop.shutters = mounting, result.delay.delay_s, result.shutters
    servo = PoseServo(setup.arm, timing(setup, result.delay))
    kinds = [motion.kind for motion in plan.motions]
    first, last = max(kinds.index("line") - 1, 0), kinds.index("circle") + 1  # from the motion to the line's start
    part = replace(plan, motions=tuple(replace(motion, rest_s=0.0) for motion in plan.motions[first:last]))
    drive(loop, part, closed_on(servo, lambda: loop.health, setup.gravity), closed=True)
    loop.close_record()
    run = Tracks(log, setup.arm, mounting, result.delay, true_track(workcell, mounting)).between()
    assert run.truth is not None
    rows = (run.fused.motion == "circle") & (run.fused.phase == "closed_loop")
    found = track_metrics(run.fused[rows], run.truth)
    assert found.position_sigma_rms_m is not None
    return found.position_rms_m, found.position_sigma_rms_m, int(rows.sum())


def true_track(workcell: Workcell, mounting: Mounting) -> tuple[Array, Array]:
    """Return the true times (N,), s, and poses (N, 4, 4) of the tool in the base that the hand-eye calibration defined.

    The true poses are those of the body in the true cameras' frame: the geometry of an arm with errors defines no base.
    """
    truth = workcell.truth
    T_left_body = inverse(truth.T_base_rig) @ truth.T_base_tool @ truth.T_tool_body
    return truth.t_s, mounting.T_base_rig @ T_left_body @ inverse(mounting.T_tool_body)
