"""What a run keeps: its stretches, and all that was measured and commanded, as it came."""

from __future__ import annotations

from dataclasses import dataclass, field

from armsight.app.run_tracks import ToolTrack
from armsight.data import JointCommand, JointStates, Missed, PoseEstimate
from armsight.loop.estimators import ArmEstimate, Verdict
from armsight.robot.trajectories import Trajectory


@dataclass(frozen=True)
class Segment:
    """A stretch of a run.

    Attributes:
        phase: calibration, open_loop, closed_loop or rest.
        motion: name of the motion, or of the one whose end the arm stands at; "" before the first.
        kind: joints, home, line or circle, of that motion.
        closed: whether the loop was closed on vision.
        begin_s: on the board's clock.
        end_s: likewise.
        trajectory: what the joints were to do from ``begin_s`` on; None where nothing was planned.
    """

    phase: str
    motion: str
    kind: str
    closed: bool
    begin_s: float = 0.0
    end_s: float = 0.0
    trajectory: Trajectory | None = None


@dataclass
class Log:
    """All that a run measured, as it came.

    Attributes:
        joints: the potentiometers, batch by batch.
        fused: where the estimator has the tool at each reading, RECORD_LAG_S later, batch by batch.
        live: where it had the tool at the newest reading, turn by turn: what the loop goes by.
        poses: each shot's name, stamp and pose (the cameras' skew in its covariance), or why there is none.
        verdicts: what the estimator made of those it was given.
        commands: when each was sent, and what.
        modes: what each was based on.
        latency_s: our time from an image to the command that knows it, image by image, s.
        segments: what happened when.
    """

    joints: list[JointStates] = field(default_factory=list)
    fused: list[ToolTrack] = field(default_factory=list)
    live: list[ArmEstimate] = field(default_factory=list)
    poses: list[tuple[str, float, PoseEstimate | Missed]] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)
    commands: list[tuple[float, JointCommand]] = field(default_factory=list)
    modes: list[str] = field(default_factory=list)
    latency_s: list[float] = field(default_factory=list)
    segments: list[Segment] = field(default_factory=list)
