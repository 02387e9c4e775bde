"""The whole experiment in the workcell: real physics, rendered cameras, the real ARM binary, held against the truth."""

from __future__ import annotations

import numpy as np
import time
from armsight.app.demo.studies import Study, rate_study, vision_studies
from armsight.app.run.calibrate import calibrated, handeye_poses
from armsight.app.run.experiment import Outcome, Progress, run_experiment
from armsight.app.run.folder import Finished, finish, make_room, open_folder
from armsight.app.run.motion_file import DEFAULT_MOTION, MotionPlan, QUICK, read_motions
from armsight.app.run.setup import Setup
from armsight.data import Array
from armsight.errors import ArmsightError
from armsight.files import write_text
from armsight.geometry.pose import inverse
from armsight.robot.arm import Arm
from armsight.robot.models import open_arm
from armsight.sim.workcell.cameras import open_timing
from armsight.sim.workcell.workcell import Workcell
from armsight.vision.calibrate.result import Calibration
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

#: Pairs of the board, poses for the hand-eye calibration, shots for each value of a study: usually, and with --quick.
_AMOUNTS = {False: (40, 30, 8), True: (30, 15, 0)}
_MOTIONS = {False: DEFAULT_MOTION, True: QUICK}


@dataclass(frozen=True)
class Demo:
    """What to run.

    Attributes:
        folder: where to.
        arm: nominal, used, worn, or a TOML file.
        cameras: as the workcell takes them.
        seed: of everything.
        machine: what runs the firmware.
        rig: parallel or verging.
        quick: fewer calibration shots and motions, and no studies.
        believed: the table that the arm is believed to have, with whatever tool; the one it was built to by default.
        model: what the summary is to call it; its own name by default.
    """

    folder: Path
    arm: str = "worn"
    cameras: str = "1280x720@60"
    seed: int = 0
    machine: str = "unicorn"
    rig: str = "parallel"
    quick: bool = False
    believed: Arm | None = None
    model: str | None = None


def run_demo(demo: Demo, *, progress: Progress = lambda line: None) -> dict[str, Any]:
    """Run the experiment in a workcell, and write its folder.

    Returns:
        The summary, as summary.json has it.

    Raises:
        ArmsightError: an unknown name, a folder that cannot be written to, or the run could not be made; what was measured
            is in the folder.
    """
    began = time.perf_counter()
    boards, handeyes, study_shots = _AMOUNTS[demo.quick]
    progress("building the workcell")
    with _cell(demo, demo.cameras) as cell:
        plan = read_motions(cell.model, _MOTIONS[demo.quick])
        open_folder(demo.folder)
        make_room(demo.folder)
        progress("showing the board")
        calibration = calibrated(cell.board_spec, cell.board_shots(boards), progress)
        calibration.rig.save(demo.folder / "rig.json")
        write_text(demo.folder / "body.toml", cell.body_text)
        write_text(demo.folder / "motion.toml", _MOTIONS[demo.quick].read_text(encoding="utf-8"))
        targets = handeye_poses(cell.model, np.vstack([cell.model.home, cell.poses]), handeyes, demo.seed)
        outcome = run_experiment(setup_of(cell), calibration.rig, plan, targets, progress=progress, cover=cell.cover)
        studies: list[Study] = []
        try:
            studies = _studies(demo, cell, calibration, outcome, plan, study_shots, progress)
        except (ArmsightError, KeyboardInterrupt) as error:  # the run itself is whole, and is written
            outcome.interrupted = isinstance(error, KeyboardInterrupt)
            outcome.ended_by = error if isinstance(error, ArmsightError) else None
        progress("drawing")
        facts = {
            "seed": demo.seed,
            "arm": demo.arm,
            "model": demo.model or cell.model.name,
            "cameras": demo.cameras,
            "board": cell.board.welcome.board,
            "machine": demo.machine,
        }
        truth = _truth(cell, outcome)
        with ThreadPoolExecutor(1) as beside:
            picture = beside.submit(cell.picture)
            finished = Finished(
                cell.model, calibration.rig, outcome, plan, truth, facts, began, studies, picture.result
            )
            return finish(finished, demo.folder)


def _cell(demo: Demo, cameras: str, like: Workcell | None = None) -> Workcell:
    """Return the workcell of a demo, with some cameras; those of another that differs in their rate alone."""
    believed = demo.believed
    if believed is not None:  # its tool is whatever was seen; the motions are of the one that was drawn
        believed = replace(believed, T_flange_tool=open_arm("six_r").T_flange_tool)
    named: dict[str, Any] = {"arm": demo.arm, "seed": demo.seed, "machine": demo.machine, "rig": demo.rig}
    return Workcell(cameras=cameras, believed=believed, like=like, **named)


def setup_of(cell: Workcell) -> Setup:
    """Return a workcell as a station like any other."""
    sync_s = float(np.hypot(cell.timing.sync_s / np.sqrt(3), cell.timing.skew_s))
    return Setup(cell.model, cell.board, cell.poll, cell.target, cell.gravity_duty, cell.timing.rate_hz, sync_s)


def _truth(cell: Workcell, outcome: Outcome) -> tuple[Array, Array] | None:
    """Return where the tool really was: times and poses in the base that the hand-eye calibration defined.

    The true poses are those of the body before the true cameras; base and tool are what the calibration says they are, for
    an arm that is off has none of its own. How far they are from the frames of the true table stands in the summary.
    """
    if outcome.handeye is None:
        return None
    truth, mounting = cell.truth, outcome.handeye.mounting
    T_left_body = inverse(truth.T_base_rig) @ truth.T_base_tool @ truth.T_tool_body
    return truth.t_s, mounting.T_base_rig @ T_left_body @ inverse(mounting.T_tool_body)


def cameras_at(cameras: str, rate_hz: float) -> str:
    """Return the name of the same cameras at another rate."""
    width, height = open_timing(cameras).image_size_px
    kind = "webcams:" if cameras.strip().startswith("webcams") else ""
    return f"{kind}{width}x{height}@{rate_hz:g}"


def _studies(
    demo: Demo,
    cell: Workcell,
    calibration: Calibration,
    outcome: Outcome,
    plan: MotionPlan,
    shots: int,
    progress: Progress,
) -> list[Study]:
    """Make the studies, unless that is left out or the run ended early."""
    if not shots or outcome.closed_s is None or outcome.ended_by is not None or outcome.interrupted:
        return []

    def at_rate(rate_hz: float) -> Workcell:
        return _cell(demo, cameras_at(demo.cameras, rate_hz), cell)

    found = vision_studies(seed=demo.seed, shots=shots, progress=progress)
    return [*found, rate_study(at_rate, setup_of, calibration.rig, outcome, plan, progress)]
