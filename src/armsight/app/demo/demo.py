"""The demo: the experiment of ``armsight run`` in the simulated workcell, evaluated against the truth.

In: a :class:`Demo`. Out: a run's folder, and its report. The workcell simulates the arm's dynamics, renders the cameras'
images, and runs the board's firmware under emulation; the cameras are calibrated first.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.demo.studies import rate_study, true_track, vision_studies
from armsight.app.run.devices import setup_of, simulated_unit
from armsight.app.run.experiment import RunResult, run_experiment
from armsight.app.run.folder import finish, make_room, open_folder
from armsight.app.run.metrics import Study
from armsight.app.run.motion_file import DEFAULT_MOTION, QUICK, read_motions
from armsight.app.show.report import Report
from armsight.app.stream.datum import Published
from armsight.app.stream.mcap_file import REFERENCES, LazyMcap, properties
from armsight.data import Array, Shot
from armsight.errors import ArmsightError
from armsight.files import read_text, write_text
from armsight.loop.references.file import read_references
from armsight.loop.running.calibrate import Progress, handeye_poses
from armsight.loop.running.setup import the_one
from armsight.processes import Process, caller
from armsight.robot.arm_file import open_arm
from armsight.robot.kinematics.arm import Arm
from armsight.sim.workcell.cameras import camera_name, open_cameras
from armsight.sim.workcell.controlled import CONTROLLED
from armsight.sim.workcell.workcell import CHESSBOARD, DEFAULT_ARM, Workcell
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.calibrate.result import Calibration
from armsight.vision.image import grey
from armsight.vision.markers.board import open_board

#: Pairs of the calibration target, hand-eye poses, shots for each value of a study: by default, and with --quick.
_AMOUNTS = {False: (40, 30, 8), True: (30, 15, 0)}
_MOTIONS = {False: DEFAULT_MOTION, True: QUICK}
#: Cameras of an arm with our firmware, and of one that keeps its own controller and is slower.
_CAMERAS, _SLOW_CAMERAS = "1280x720@60", "1280x720@30"
#: Rests of an arm with its own controller, s: from a command to its state it takes a tenth of a second and more.
_REST_S = 5.0
#: How far the line of another arm goes, of the way between its outermost poses, and its circle's radius, of its size.
_LINE, _RADIUS = 0.7, 0.1


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
    unit = None if demo.references is None else the_one(read_references(demo.references), demo.references)
    folder = demo.folder
    progress("building the workcell")
    cameras = demo.cameras or (_SLOW_CAMERAS if demo.model in CONTROLLED else _CAMERAS)
    with open_folder(folder), _workcell(demo, cameras) as workcell:
        own = demo.model != DEFAULT_ARM
        motion = _MOTIONS[demo.quick].read_text(encoding="utf-8")
        if own:
            motion = motion_text(workcell.model, workcell.poses, quick=demo.quick, slow=workcell.link is None)
        make_room(folder)
        write_text(folder / "motion.toml", motion)
        plan = read_motions(workcell.model, folder / "motion.toml")
        progress("rendering the calibration target")
        shots = _ahead(workcell.board_shots(pairs))
        first = next(shots)  # begun before, the second process would take a core from those that render it
        with contextlib.closing(Process(caller, "armsight.vision.calibrate.boards")) as second:
            rig = _calibrated(CHESSBOARD, chain([first], shots), progress, second).rig
        rig.save(folder / "rig.json")
        write_text(folder / "body.toml", workcell.body_text)
        targets = handeye_poses(workcell.model, np.vstack([workcell.model.home, workcell.poses]), handeyes, demo.seed)
        setup, more = setup_of(workcell), dict[str, str]()
        if demo.references is not None and unit is not None:
            setup = replace(setup, beside=simulated_unit(workcell, unit, demo.seed))
            more[REFERENCES] = read_text(demo.references)
            write_text(folder / REFERENCES, more[REFERENCES])
        texts = properties(rig, workcell.body_text, setup.arm, command="demo", **more)
        published = Published(rig, setup.target.body, setup.arm, texts)
        with contextlib.closing(LazyMcap(folder, published, progress, process=True)) as file:
            result = run_experiment(
                setup,
                rig,
                plan,
                targets,
                progress=progress,
                cover=workcell.cover,
                publisher=file,
            )
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


def motion_text(model: Arm, poses: Array, *, quick: bool, slow: bool) -> str:
    """Return motions of an arm before the workcell's cameras as a motion file: poses (5, n), rad, a line, a circle.

    ``quick``: one pose alone; ``slow``: its controller takes long to come to rest.
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
    with contextlib.closing(Process(caller, "armsight.app.demo.studies")) as other, ThreadPoolExecutor(1) as beside:
        of_vision = beside.submit(other, partial(vision_studies, seed=demo.seed, shots=shots))
        try:
            of_rate = rate_study(at_rate, result, progress)
            progress("studies of vision")
            return [*of_vision.result(), of_rate]
        finally:  # after an interrupt nobody waits for what it computes
            other.kill()
