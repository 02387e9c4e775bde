"""How the error goes with the rate of vision in the loop: the circle, closed on vision, in workcells of several rates."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from armsight.app.run.experiment import (PRIOR, Outcome, Progress, timing)
from armsight.app.run.motion_file import MotionPlan
from armsight.app.run_data import RunData, assembled
from armsight.app.run.metrics import track_figures
from armsight.app.run.record import Log
from armsight.app.run.loop import Loop
from armsight.app.run_passes import closed_on, drive
from armsight.app.run.setup import Station
from armsight.app.demo.studies import Study
from armsight.geometry.pose import inverse
from armsight.loop.estimators import KalmanEstimator
from armsight.loop.servo import PoseServo
from armsight.sim.workcell.workcell import Workcell
from armsight.vision.follow.follower import Follower
from armsight.vision.rig import StereoRig

RATES_HZ = (4.0, 15.0, 30.0, 60.0, 120.0)


def rate_study(
    open_cell: Callable[[float], Workcell],
    station_of: Callable[[Workcell], Station],
    rig: StereoRig,
    outcome: Outcome,
    plan: MotionPlan,
    progress: Progress,
) -> Study:
    """Make the last motions of a plan, up to its circle, with the loop closed at several rates.

    Args:
        open_cell: opens a workcell whose cameras have a rate; all else as in the run.
        station_of: makes a station of it.
        rig: the calibrated cameras.
        outcome: of the run, for where everything is.
        plan: the motions of the run.
        progress: called with a line about what is being done.
    """

    def at(rate: float) -> tuple[float, float, int]:
        progress(f"study: vision at {rate:g} Hz in the loop")
        with open_cell(rate) as cell:
            return _figures(_circle(cell, station_of(cell), rig, outcome, plan))

    with ThreadPoolExecutor(2) as both:  # the longest first
        rows = list(both.map(at, RATES_HZ[::-1]))[::-1]
    position, predicted, count = (np.array(column) for column in zip(*rows, strict=True))
    # A circle's errors hang together: about one independent error every tenth of a second.
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


def _circle(cell: Workcell, station: Station, rig: StereoRig, outcome: Outcome, plan: MotionPlan) -> RunData:
    """Drive to the circle and along it, without a rest."""
    assert outcome.handeye is not None
    station.board.enable()
    log = Log()
    loop = Loop(
        station,
        Follower(rig, station.target),
        log,
        KalmanEstimator(station.arm, prior=PRIOR, delay=outcome.delay, learns_delay=False),
    )
    loop.mounting = outcome.handeye.mounting
    servo = PoseServo(station.arm, timing(station, outcome.delay))
    kinds = [motion.kind for motion in plan.motions]
    first = kinds.index("home") + 1 if "home" in kinds else 0
    last = kinds.index("circle") + 1
    part = replace(plan, motions=tuple(replace(motion, rest_s=0.0) for motion in plan.motions[first:last]))
    drive(loop, part, closed_on(servo, station.gravity), closed=True, progress=lambda line: None)
    loop.close_record()
    truth, mounting = cell.truth, outcome.handeye.mounting
    T_left_body = inverse(truth.T_base_rig) @ truth.T_base_tool @ truth.T_tool_body
    Ts = mounting.T_base_rig @ T_left_body @ inverse(mounting.T_tool_body)
    return assembled(log, station.arm, mounting, outcome.delay, (truth.t_s, Ts))


def _figures(run: RunData) -> tuple[float, float, int]:
    """Return the fused estimate's error on the circle, RMS, m; what it claimed; how many readings."""
    assert run.truth is not None
    rows = (run.fused.motion == "circle") & (run.fused.phase == "closed_loop")
    found = track_figures(run.fused[rows], run.truth)
    return found["position_rms_m"], found["position_sigma_rms_m"], int(rows.sum())
