"""The summary of a run: what summary.json holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armsight.app.run.experiment import Outcome
from armsight.app.run.motion_file import MotionPlan
from armsight.app.run_data import RunData
from armsight.app.run.metrics import (judge, path_errors, rest_errors, rms, singular, spread, track_figures)
from armsight.app.run_tracks import ToolTrack
from armsight.app.demo.studies import Study
from armsight.robot.arm import Arm


def summary_of(
    arm: Arm,
    outcome: Outcome,
    plan: MotionPlan,
    run: RunData,
    before: RunData | None,
    after: RunData | None,
    studies: Sequence[Study],
    facts: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the figures of a run, SI units in the keys.

    Args:
        arm: the nominal arm.
        outcome: what was measured; its hand-eye calibration is there.
        plan: what was to be done.
        run: all of it.
        before: the motions with potentiometers alone; None where they were not made.
        after: the same with the loop closed; None likewise.
        studies: made after it.
        facts: what else to say.
    """
    assert outcome.handeye is not None
    position, angle = outcome.handeye.found.held_out.rms()
    summary: dict[str, Any] = {} if before is None else _against_truth(before, outcome.covered_s)
    if before is not None and after is not None:
        goals = {m.name: m.trajectory.at(m.trajectory.duration_s).q for m in plan.motions}
        summary["closed_loop"] = _closed(before, after, [n for n, q in goals.items() if singular(arm, q)])
    if len(run.latency_s):
        summary["latency_s"] = spread(run.latency_s)
    return summary | {
        "handeye": {
            "held_out_position_rms_m": position,
            "held_out_angle_rms_rad": angle,
            "poses": len(outcome.handeye.q),
        },
        "camera_delay_s": {"value": outcome.delay.delay_s, "sigma": outcome.delay.sigma_s},
        "shots": {"measured": len(run.vision), "missed": run.missed, "not_believed": run.outliers},
        "studies": [_study(study) for study in studies],
        **facts,
        "ended_by": outcome.said,
    }


def _study(study: Study) -> dict[str, Any]:
    """Return a study's figures."""
    return {
        "name": study.name,
        "unit": study.unit,
        "values": study.values.tolist(),
        "position_rms_m": study.position_rms_m.tolist(),
        "predicted_m": study.predicted_m.tolist(),
    }


def _against_truth(before: RunData, covered_s: tuple[float, float] | None) -> dict[str, Any]:
    """Return how far each track of the motions is from the truth, with the body in view and hidden; empty without one."""
    found: dict[str, Any] = {}
    if before.truth is None:
        return found
    for name in ("vision", "potentiometers", "fused", "live"):
        track: ToolTrack = getattr(before, name)
        seen = ~_hidden(track, covered_s)
        moving, resting = (track.phase == "open_loop") & seen, (track.phase == "rest") & seen
        if moving.any() and resting.any():
            at_rest = track_figures(track[resting], before.truth)["position_rms_m"]
            found[name] = {**track_figures(track[moving], before.truth), "rest_position_rms_m": at_rest}
    if covered_s is not None and (before.t_s > covered_s[0]).any():
        found["occlusion"] = {"duration_s": float(np.ptp(covered_s))}
        for name in ("fused", "live"):
            track = getattr(before, name)
            figures = track_figures(track[_hidden(track, covered_s)], before.truth)
            found["occlusion"] |= {
                f"{name}_position_rms_m": figures["position_rms_m"],
                f"{name}_position_max_m": figures["position_max_m"],
            }
    return found


def _closed(before: RunData, after: RunData, singular_at: list[str]) -> dict[str, Any]:
    """Return the error of the tool against where it was to be, with potentiometers alone and with the loop closed.

    Rests at which the arm is singular stand apart: there it cannot be moved to where it should be.
    """
    found: dict[str, Any] = {"singular_rests": {name: {} for name in singular_at}}
    for when, run in (("before", before), ("after", after)):
        rests = rest_errors(run, judge(run))
        for name in singular_at:
            if name in rests:
                found["singular_rests"][name][f"rest_error_{when}_m"] = rests.pop(name)
        paths = [away for _, away in path_errors(run, judge(run)).values()]
        if rests:
            found[f"rest_error_{when}_m"] = rms(np.array(list(rests.values())))
            found[f"rest_error_{when}_max_m"] = max(rests.values())
        if paths:
            found[f"path_error_{when}_m"] = rms(np.concatenate(paths))
    return found


def _hidden(track: ToolTrack, covered_s: tuple[float, float] | None) -> NDArray[np.bool_]:
    """Return (N,) which rows lie where the body was hidden on purpose, or just after."""
    if covered_s is None:
        return np.zeros(len(track), bool)
    return (track.t_s > covered_s[0] - 0.01) & (track.t_s < covered_s[1] + 0.05)
