"""The demo: the experiment of ``armsight run`` in the simulated workcell, evaluated against the truth.

In: a :class:`Demo`. Out: a run's folder with report, and its summary. The workcell simulates the arm's dynamics, renders
the cameras' images, and runs the board's firmware under emulation; the cameras are calibrated first.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np

from armsight.app.demo.studies import rate_study, vision_studies
from armsight.app.run.calibrate import calibrated, handeye_poses
from armsight.app.run.experiment import Progress, RunResult, run_experiment
from armsight.app.run.folder import Finished, finish, make_room, open_folder
from armsight.app.run.metrics import Study
from armsight.app.run.motion_file import DEFAULT_MOTION, QUICK, MotionPlan, read_motions
from armsight.app.run.setup import setup_of
from armsight.app.run.summary import RunSummary
from armsight.app.stream.datum import Published
from armsight.app.stream.mcap_file import LazyMcap, properties
from armsight.data import Array, Shot
from armsight.errors import ArmsightError
from armsight.files import write_text
from armsight.geometry.pose import inverse
from armsight.processes import Process, caller
from armsight.robot.arm_file import open_arm
from armsight.robot.kinematics.arm import Arm
from armsight.sim.workcell.cameras import camera_name, open_cameras
from armsight.sim.workcell.controlled import CONTROLLED
from armsight.sim.workcell.workcell import DEFAULT_ARM, Workcell
from armsight.vision.calibrate.result import Calibration

#: Pairs of the calibration target, hand-eye poses, shots for each value of a study: by default, and with --quick.
_AMOUNTS = {False: (40, 30, 8), True: (30, 15, 0)}
_MOTIONS = {False: DEFAULT_MOTION, True: QUICK}
#: What the second process imports first: it evaluates lens models, and draws figures.
_SECOND = ("armsight.vision.calibrate.boards", "armsight.app.run.report", "matplotlib.figure")
#: Cameras of an arm with our firmware, and of one that keeps its own controller and is slower.
_CAMERAS, _SLOW_CAMERAS = "1280x720@60", "1280x720@30"
#: Rests of an arm with its own controller, s: from a command to its state it takes a tenth of a second and more.
_REST_S = 5.0
#: How far the line of another arm goes, of the way between its outermost poses, and its circle's radius, of its size.
_LINE, _RADIUS = 0.7, 0.1


@dataclass(frozen=True)
class Demo:
    """The options of a demo.

    Attributes:
        folder: the folder of the run.
        arm: the simulated arm: nominal, used, worn, or a TOML file.
        cameras: as the workcell names them, such as 1280x720@60 or webcam-good-light; None for what suits the arm.
        seed: of everything that is random.
        emulator: what runs the firmware: unicorn, qemu or host.
        layout: of the cameras: parallel or verging.
        model: the arm that is simulated, by its name: six_r, another of six joints, so101 or ar4.
        quick: fewer calibration shots and motions, and no studies.
        nominal_arm: the arm model that the estimators and the controller have; by default the table the arm was built to.
        nominal_arm_name: its name in the summary; by default the arm's own.
        follow_rig: whether a rig that moved is put right.
        sync_led: whether an LED on the board's clock is in view.
    """

    folder: Path
    arm: str = "worn"
    cameras: str | None = None
    seed: int = 0
    emulator: str = "unicorn"
    layout: str = "parallel"
    model: str = DEFAULT_ARM
    quick: bool = False
    nominal_arm: Arm | None = None
    nominal_arm_name: str | None = None
    follow_rig: bool = False
    sync_led: bool = False


def run_demo(demo: Demo, *, progress: Progress = lambda line: None) -> RunSummary:
    """Run the experiment in a workcell, and write its folder.

    Returns:
        The summary; its ``to_json`` is what summary.json holds.

    Raises:
        ArmsightError: an unknown name, a folder that cannot be written to, or the run failed; what was measured is in the
            folder.
    """
    began = time.perf_counter()
    pairs, handeyes, study_shots = _AMOUNTS[demo.quick]
    open_folder(demo.folder)
    progress("building the workcell")
    cameras = demo.cameras or (_SLOW_CAMERAS if demo.model in CONTROLLED else _CAMERAS)
    with _workcell(demo, cameras) as workcell, contextlib.ExitStack() as ended:
        motion = _motion_text(demo, workcell)
        make_room(demo.folder)
        write_text(demo.folder / "motion.toml", motion)
        plan = read_motions(workcell.model, demo.folder / "motion.toml")
        progress("rendering the calibration target")
        shots = _ahead(workcell.chessboard_shots(pairs))
        first = next(shots)  # begun before, the second process would take a core from those that render it
        second = ended.enter_context(contextlib.closing(Process(caller, *_SECOND)))
        calibration = calibrated(workcell.chessboard_spec, chain([first], shots), progress, second)
        calibration.rig.save(demo.folder / "rig.json")
        write_text(demo.folder / "body.toml", workcell.body_text)
        poses = np.vstack([workcell.model.home, workcell.poses])
        targets = handeye_poses(workcell.model, poses, handeyes, demo.seed)
        setup = setup_of(workcell)
        texts = properties(calibration.rig, workcell.body_text, setup.arm, command="demo")
        published = Published(calibration.rig, setup.target.body, setup.arm, texts)
        with contextlib.closing(LazyMcap(demo.folder, published, progress, process=True)) as file:
            outcome = run_experiment(
                setup,
                calibration.rig,
                plan,
                targets,
                progress=progress,
                cover=workcell.cover,
                publisher=file,
                follow_rig=demo.follow_rig,
            )
        workcell.source.close()  # its processes hold 300 MB
        studies: list[Study] = []
        try:
            if demo.model == DEFAULT_ARM:
                studies = _studies(demo, cameras, workcell, calibration, outcome, plan, study_shots, progress)
        except (ArmsightError, KeyboardInterrupt) as error:  # the run itself is complete, and is written
            outcome.interrupted = isinstance(error, KeyboardInterrupt)
            outcome.ended_by = error if isinstance(error, ArmsightError) else None
        workcell.forget_room()  # drawing takes as much
        progress("plotting")
        of_run = {
            "seed": demo.seed,
            "arm": demo.arm,
            "nominal_arm": demo.nominal_arm_name or workcell.model.name,
            "cameras": cameras,
            "board": workcell.board.welcome.board,
            "emulator": demo.emulator if workcell.link is not None else "own controller",
        }
        truth = _truth(workcell, outcome)
        with ThreadPoolExecutor(1) as beside:
            overview = beside.submit(workcell.picture)
            finished = Finished(
                workcell.model, calibration.rig, outcome, plan, truth, of_run, began, studies, overview.result, second
            )
            return finish(finished, demo.folder)


def _ahead(shots: Iterator[Shot]) -> Iterator[Shot]:
    """Yield shots, and render the next one while what is done with one is done."""
    with ThreadPoolExecutor(1) as beside:
        shot = next(shots, None)
        while shot is not None:
            begun = beside.submit(next, shots, None)
            yield shot
            shot = begun.result()


def _motion_text(demo: Demo, workcell: Workcell) -> str:
    """Return the motions of a demo as a motion file: poses, a line, a circle; another arm's are of the workcell's poses."""
    if demo.model == DEFAULT_ARM:
        return _MOTIONS[demo.quick].read_text(encoding="utf-8")
    return motion_text(workcell.model, workcell.poses, quick=demo.quick, slow=workcell.link is None)


def motion_text(model: Arm, poses: Array, *, quick: bool, slow: bool) -> str:
    """Return motions of an arm before the workcell's cameras as a motion file: poses, a line, a circle.

    Args:
        model: the arm.
        poses: (5, n) joint angles of the poses, rad.
        quick: one pose alone.
        slow: whether its controller takes long to come to rest.
    """
    rest = f"rest_s = {_REST_S}\n" if slow else ""
    first, second = (model.forward(q)[:3, 3] for q in poses[:2])
    step = 1e3 * _LINE * (second - first)
    center = 1e3 * (first + np.array([0.0, 0.0, -_RADIUS * model.size_m])) + step
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


def _truth(workcell: Workcell, outcome: RunResult) -> tuple[Array, Array] | None:
    """Return the true times (N,), s, and poses (N, 4, 4) of the tool in the base that the hand-eye calibration defined.

    The true poses are those of the body in the true cameras' frame. The base and tool frames are those of the hand-eye
    calibration, as the geometry of an arm with errors defines none.
    """
    if outcome.handeye is None:
        return None
    truth, mounting = workcell.truth, outcome.handeye.mounting
    T_left_body = inverse(truth.T_base_rig) @ truth.T_base_tool @ truth.T_tool_body
    return truth.t_s, mounting.T_base_rig @ T_left_body @ inverse(mounting.T_tool_body)


def cameras_at(cameras: str, rate_hz: float) -> str:
    """Return the name of the same cameras at another rate, Hz."""
    (width, height), (name, _) = open_cameras(cameras)[0].image_size_px, camera_name(cameras)
    return f"{name + ':' if name else ''}{width}x{height}@{rate_hz:g}"


def _studies(
    demo: Demo,
    cameras: str,
    workcell: Workcell,
    calibration: Calibration,
    outcome: RunResult,
    plan: MotionPlan,
    shots: int,
    progress: Progress,
) -> list[Study]:
    """Return the studies; none with --quick or after a run that ended early."""
    if not shots or outcome.closed_s is None or outcome.ended_by is not None or outcome.interrupted:
        return []

    def at_rate(rate_hz: float) -> Workcell:
        return _workcell(demo, cameras_at(cameras, rate_hz), workcell)

    # The rate's loops are mostly Python, which runs one at a time in a process: those of vision take the other core.
    with contextlib.closing(Process(caller, "armsight.app.demo.studies")) as other, ThreadPoolExecutor(1) as beside:
        of_vision = beside.submit(other, partial(vision_studies, seed=demo.seed, shots=shots))
        try:
            of_rate = rate_study(at_rate, setup_of, calibration.rig, outcome, plan, progress)
            progress("studies of vision")
            return [*of_vision.result(), of_rate]
        finally:  # after an interrupt nobody waits for what it computes
            other.kill()
