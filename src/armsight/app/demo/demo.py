"""The demo: the experiment of ``armsight run`` in the simulated workcell, evaluated against the truth.

In: a :class:`Demo`. Out: a run's folder, and its report. The workcell simulates the arm's dynamics, renders the cameras'
images, and runs the board's firmware under emulation; the cameras are calibrated first. Studies (:class:`Study`):
:func:`vision_studies` changes one quantity at a time, renders shots and compares errors with the truth and with what the
covariance predicts; :func:`rate_study` closes the loop on a circle with cameras of several rates.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtri

from armsight.app.run.devices import setup_of, simulated_unit
from armsight.app.run.experiment import RunResult, closed_on, drive, prior_of, timing
from armsight.app.run.folder import finish, make_room, open_folder, run_in
from armsight.app.run.metrics import Study, track_metrics
from armsight.app.run.motion_file import DEFAULT_MOTION, QUICK, MotionPlan, read_motions
from armsight.app.run.tracks import Tracks
from armsight.app.show.report import Report
from armsight.app.stream.mcap_file import REFERENCES
from armsight.data import Array, PoseEstimate, Record, Shot
from armsight.errors import ArmsightError, InputError
from armsight.files import read_text, write_text
from armsight.geometry.pose import inverse, log_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.loop.estimators import KalmanEstimator, Mounting
from armsight.loop.references.file import read_references
from armsight.loop.running.beside import the_one
from armsight.loop.running.calibrate import Progress, handeye_poses
from armsight.loop.running.log import Log
from armsight.loop.running.loop import Loop
from armsight.loop.servo import PoseServo
from armsight.processes import Process, caller
from armsight.robot.arm_file import open_arm
from armsight.robot.kinematics.arm import Arm
from armsight.sim.example_rig import board_poses, example_rig
from armsight.sim.render.background import plain
from armsight.sim.render.optics import Sensor
from armsight.sim.render.render import kept_rays, render_pair
from armsight.sim.render.scene import PosedBody, chessboard
from armsight.sim.workcell.body import body_patterns, body_target
from armsight.sim.workcell.cameras import camera_name, open_cameras
from armsight.sim.workcell.controlled import CONTROLLED
from armsight.sim.workcell.workcell import CHESSBOARD, DEFAULT_ARM, Workcell
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.calibrate.result import Calibration
from armsight.vision.follow.follower import Follower
from armsight.vision.image import grey
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


#: Pairs of the calibration target, hand-eye poses, shots for each value of a study: by default, and with --quick.
_AMOUNTS = {False: (40, 30, 8), True: (30, 15, 0)}
_MOTIONS = {False: DEFAULT_MOTION, True: QUICK}
#: Cameras of an arm with our firmware, and of one that keeps its own controller and is slower.
_CAMERAS, _SLOW_CAMERAS = "1280x720@60", "1280x720@30"
#: Rests of an arm with its own controller, s: from a command to its state it takes a tenth of a second and more.
_REST_S = 5.0
#: How far the line of another arm goes, of the way between its outermost poses, and its circle's radius, of its size.
_LINE, _RADIUS = 0.7, 0.1
_SIZES = (1.0, 0.6, 0.35, 0.2)  # shares of both that are tried; half: less of the arm moves, double: limits


@dataclass(frozen=True)
class Demo:
    """The options of a demo."""

    folder: Path  #: the folder of the run
    arm: str = "worn"  #: the simulated arm: nominal, used, worn, or a TOML file
    #: as the workcell names them, such as 1280x720@60 or webcam-good-light; None for what suits the arm.
    cameras: str | None = None
    seed: int = 0  #: of everything that is random
    emulator: str = "unicorn"  #: what runs the firmware: unicorn, qemu or host
    layout: str = "parallel"  #: of the cameras: parallel or verging
    model: str = DEFAULT_ARM  #: the arm that is simulated, by its name: six_r, another of six joints, so101 or ar4
    quick: bool = False  #: fewer calibration shots and motions, and no studies
    #: the arm model that the estimators and the controller have; by default the table the arm was built to.
    nominal_arm: Arm | None = None
    nominal_arm_name: str | None = None  #: its name in the summary; by default the arm's own
    sync_led: bool = False  #: whether an LED on the board's clock is in view
    references: Path | None = None  #: names an inertial unit, which is simulated on the tool


def run_demo(demo: Demo, *, progress: Progress = lambda line: None) -> Report:
    """Run the experiment in a workcell, and write its folder; the report's JSON is what summary.json holds."""
    began = time.perf_counter()
    pairs, handeyes, study_shots = _AMOUNTS[demo.quick]
    unit = None if demo.references is None else the_one(read_references(demo.references))
    folder = demo.folder
    progress("building the workcell")
    cameras = demo.cameras or (_SLOW_CAMERAS if demo.model in CONTROLLED else _CAMERAS)
    with open_folder(folder, simulated=True), _workcell(demo, cameras) as workcell:
        own = demo.model != DEFAULT_ARM
        make_room(folder)
        if own:
            model, slow = workcell.model, workcell.link is None
            motion, plan = motions_of(model, workcell.poses, folder / "motion.toml", quick=demo.quick, slow=slow)
        else:
            motion = _MOTIONS[demo.quick].read_text(encoding="utf-8")
            write_text(folder / "motion.toml", motion)
            plan = read_motions(workcell.model, folder / "motion.toml")
        progress("rendering the calibration target")
        shots = _ahead(workcell.board_shots(pairs))
        first = next(shots)  # begun before, the second process would take a core from those that render it
        with contextlib.closing(Process(caller, "armsight.vision.calibrate.boards")) as second:
            rig = _calibrated(CHESSBOARD, chain([first], shots), progress, second).rig
        targets = handeye_poses(workcell.model, np.vstack([workcell.model.home, workcell.poses]), handeyes, demo.seed)
        setup, files = setup_of(workcell), {"motion.toml": motion, "body.toml": workcell.body_text}
        if demo.references is not None and unit is not None:
            setup = replace(setup, beside=simulated_unit(workcell, unit, demo.seed))
            files[REFERENCES] = read_text(demo.references)
        how: dict[str, Any] = {"process": True, "progress": progress, "cover": workcell.cover}
        result = run_in(folder, setup, rig, plan, targets, files, command="demo", say=progress, **how)
        workcell.source.close()  # its processes hold 300 MB
        studies: list[Study] = []
        try:
            if not own:
                studies = _studies(demo, cameras, workcell, result, study_shots, progress)
        except (ArmsightError, KeyboardInterrupt) as error:  # the run itself is complete, and is written
            result.ended(error)
        workcell.forget_room()  # drawing takes as much
        progress("plotting")
        result.began = began
        result.properties = {
            "seed": demo.seed,
            "arm": demo.arm,
            "nominal_arm": demo.nominal_arm_name or workcell.model.name,
            "cameras": cameras,
            "board": workcell.board.welcome.board,
            "emulator": demo.emulator if workcell.link is not None else "own controller",
        }
        truth = None if result.handeye is None else true_track(workcell, result.handeye.mounting)
        with ThreadPoolExecutor(1) as beside:
            aside = beside.submit(workcell.picture).result
            return finish(result, folder, truth=truth, studies=studies, workcell=aside)


def _ahead(shots: Iterator[Shot]) -> Iterator[Shot]:
    """Yield shots, and render the next one while what is done with one is done."""
    with ThreadPoolExecutor(1) as beside:
        shot = next(shots, None)
        while shot is not None:
            begun = beside.submit(next, shots, None)
            yield shot
            shot = begun.result()


def _calibrated(
    target_spec: str, shots: Iterable[Shot], progress: Progress, second: Callable[..., Any] | None = None
) -> Calibration:
    """Calibrate a rig from shots of a flat calibration target, such as chessboard:9x6:25mm; ``second`` calls beside."""
    board = open_board(target_spec)
    pairs, sizes = list[Pair](), ((0, 0), (0, 0))
    for shot in shots:
        assert shot.left is not None
        assert shot.right is not None
        left, right = grey(shot.left), grey(shot.right)
        sizes = ((left.shape[1], left.shape[0]), (right.shape[1], right.shape[0]))
        pairs.append(Pair(shot.name, board.detect(left), board.detect(right)))
        progress(f"detecting the calibration target: {len(pairs)} pairs")
    return calibrate_boards(board, pairs, sizes, progress=progress, second=second)


def motions_of(model: Arm, poses: Array, path: Path, *, quick: bool, slow: bool) -> tuple[str, MotionPlan]:
    """Write and plan :func:`motion_text`, line and circle as large as the arm's limits allow; else InputError."""
    for size in _SIZES:
        write_text(path, text := motion_text(model, poses, quick=quick, slow=slow, size=size))
        try:
            return text, read_motions(model, path)
        except InputError as error:
            reason = error
    raise reason


def motion_text(model: Arm, poses: Array, *, quick: bool, slow: bool, size: float = 1.0) -> str:
    """Return motions of an arm before the workcell's cameras as a motion file: poses (5, n), rad, a line, a circle.

    ``quick``: one pose alone; ``slow``: its controller takes long to come to rest; ``size``: of line and circle.
    """
    rest = f"rest_s = {_REST_S}\n" if slow else ""
    first, second = (model.forward(q)[:3, 3] for q in poses[:2])
    step = 1e3 * size * _LINE * (second - first)
    center = 1e3 * (first + np.array([0.0, 0.0, -size * _RADIUS * model.size_m])) + step
    axis = np.round(np.cross(second - first, [0.0, 0.0, 1.0]) / np.linalg.norm(second - first), 3)
    motions = [
        f'kind = "joints"\nname = "pose {n}"\nq_deg = {np.degrees(q).round(2).tolist()}\n{rest}'
        for n, q in enumerate(poses[: 1 if quick else len(poses)], start=1)
    ]
    if not quick:
        motions.append(
            f'kind = "joints"\nname = "line\'s start"\nq_deg = {np.degrees(poses[0]).round(2).tolist()}\n{rest}'
        )
    motions += [
        f'kind = "line"\nname = "line"\nby_mm = {step.round(1).tolist()}\n{rest}',
        f'kind = "circle"\nname = "circle"\ncenter_mm = {center.round(1).tolist()}\naxis = {axis.tolist()}\n{rest}',
    ]
    if not quick:
        motions.append(f'kind = "home"\nname = "park"\n{rest}')
    start = f"start_deg = {np.degrees(model.home).round(4).tolist()}\n"
    return start + "".join(f"\n[[motion]]\n{motion}" for motion in motions)


def _workcell(demo: Demo, cameras: str, like: Workcell | None = None) -> Workcell:
    """Return the workcell of a demo; ``like`` is one that differs in the rate of the cameras alone."""
    nominal = demo.nominal_arm
    if nominal is not None:  # an identified tool is that of the measured body; the motions are of the built-in tool
        nominal = replace(nominal, T_flange_tool=open_arm(demo.model).T_flange_tool)
    return Workcell.open(
        arm=demo.arm,
        cameras=cameras,
        seed=demo.seed,
        emulator=demo.emulator,
        rig=demo.layout,
        model=open_arm(demo.model),
        assumed=nominal,
        like=like,
        sync_led=demo.sync_led and like is None,
        processes=like is None,
    )


def cameras_at(cameras: str, rate_hz: float) -> str:
    """Return the name of the same cameras at another rate, Hz."""
    (width, height), (name, _) = open_cameras(cameras)[0].image_size_px, camera_name(cameras)
    return f"{name + ':' if name else ''}{width}x{height}@{rate_hz:g}"


def _studies(
    demo: Demo, cameras: str, workcell: Workcell, result: RunResult, shots: int, progress: Progress
) -> list[Study]:
    if not shots or result.closed_s is None or result.ended_text is not None:
        return []

    def at_rate(rate_hz: float) -> Workcell:
        return _workcell(demo, cameras_at(cameras, rate_hz), workcell)

    # The rate's loops are mostly Python, which runs one at a time in a process: those of vision take the other core.
    with contextlib.closing(Process(caller, "armsight.app.demo.demo")) as other, ThreadPoolExecutor(1) as beside:
        of_vision = beside.submit(other, partial(vision_studies, seed=demo.seed, shots=shots))
        try:
            of_rate = rate_study(at_rate, result, progress)
            progress("studies of vision")
            return [*of_vision.result(), of_rate]
        finally:  # after an interrupt nobody waits for what it computes
            other.kill()
