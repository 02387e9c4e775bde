"""Measure a target in all shots of a source.

from armsight import measure_all table = measure_all("rig.json", "chessboard:9x6:25mm", "recording")
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from armsight.errors import InputError
from armsight.vision.markers.marker import Target
from armsight.vision.markers.targets import open_target
from armsight.vision.pose.measure import measure, require_arguments
from armsight.vision.pose.shot_pose import ShotPose, ShotPoses, shot_pose
from armsight.vision.rig import StereoRig
from armsight.vision.sources import Source, lent


def measure_all(
    rig: StereoRig | str | Path,
    target: Target | str | Path,
    source: Source | str | Path,
    *,
    progress: Callable[[int, int | None], None] = lambda done, total: None,
) -> ShotPoses:
    """Measure every shot by itself, until the source ends.

    ``rig``: the calibrated pair, or its file. ``target``: the body to find, or its text as the command line takes it.
    ``source``: the shots, or what :func:`~armsight.vision.sources.open_source` opens; a source that was open stays open.
    ``progress``: called after each shot with how many are done, and how many there are (None: not known). Returns a row a
    shot, missed ones included, each with its reason. Raises InputError: a file or text is wrong, an argument has another
    type, or all shots were read before; DeviceError: a camera is gone.
    """
    rig = StereoRig.load(rig) if isinstance(rig, str | Path) else rig
    target = open_target(target) if isinstance(target, str | Path) else target
    poses = list[ShotPose]()
    with lent(source) as shots:
        require_arguments("measure_all(rig, target, source)", rig=rig, target=target, source=shots)
        for shot in shots:
            poses.append(shot_pose(shot.name, shot.t_s, target.body, measure(rig, target, shot)))
            progress(len(poses), shots.count)
    if not poses:
        raise InputError("measure_all(rig, target, source): the source has no shot left: open it again")
    return ShotPoses(tuple(poses))
