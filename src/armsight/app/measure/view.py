"""``armsight measure --view``: a folder of annotated pictures, one a shot, and the strip chart of all shots.

Each picture is written completely as soon as its shot is measured; of a shot only its record is kept, by the caller. A long
run gets a picture of every shot that was missed, searched for or jumped, and of every few others.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import cv2

from armsight.app.measure.chart import chart
from armsight.app.measure.picture import draw_shot, header, marks_of
from armsight.app.show.plotting import require_matplotlib
from armsight.data import Body, Missed, PoseEstimate, Shot
from armsight.errors import InputError
from armsight.files import check_folder, replacing
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.pose.shot_pose import ShotPose
from armsight.vision.rig import StereoRig

CHART, PREFIX = "run.png", "view-"
#: A run of more shots than this does not get a picture of each; nor of each odd one where so many are odd.
EACH_UP_TO, ODD_UP_TO = 60, 500
_LONGEST_NAME = 50  # a file system's 255 bytes hold that many letters of any script


def view_folder(directory: str | Path) -> Path:
    """Check that pictures can be written, before anything is measured."""
    try:
        require_matplotlib()
    except InputError:
        raise InputError(
            '--view plots a chart with matplotlib, which is not installed: pip install "armsight[report]"'
        ) from None
    return check_folder(directory, problem="no pictures can be written here", advice="; give a folder")


class PictureFolder:
    """Writes the pictures of a run, shot after shot."""

    def __init__(
        self, folder: Path, rig: StereoRig, body: Body, discs: DiscTarget | None = None, total: int | None = None
    ) -> None:
        """Begin a run; of ``body`` points of discs come last."""
        self.folder, self.rig, self.body, self.discs = folder, rig, body, discs
        self._every = None if total is None else -(-total // EACH_UP_TO)
        self._shots = self._odd = 0
        self._written: set[str] = set()
        self._earlier: set[str] | None = None

    def add(self, shot: Shot, result: PoseEstimate | Missed, record: ShotPose) -> None:
        """Write the picture of a shot, or leave it out of a long run."""
        if self._earlier is None:
            self._earlier = {path.name for path in self.folder.glob(f"{PREFIX}*.png")}
        number = self._shots
        odd = not record.ok or record.way == "searched" or bool(record.jump)
        step = _step(number, EACH_UP_TO) if self._every is None else self._every
        chosen = number % step == 0 or (odd and self._odd % _step(self._odd, ODD_UP_TO) == 0)
        self._shots += 1
        self._odd += odd
        if not chosen:
            return
        marks = marks_of(self.rig, self.body, self.discs, result) if isinstance(result, PoseEstimate) else None
        sizes = self.rig.left.image_size_px, self.rig.right.image_size_px
        problem = result.reason if isinstance(result, Missed) else None
        canvas = draw_shot(header(record), problem, (shot.left, shot.right), sizes, marks)
        self._put(self._file_name(shot.name), cv2.imencode(".png", canvas)[1].tobytes())

    def finish(self, records: Sequence[ShotPose]) -> None:
        """Write the chart of the shots so far; without a shot there is none."""
        if records:
            self._put(CHART, chart(records))

    def summary(self) -> str:
        """Return a text on the shots with a picture, and whether pictures of an earlier run are left."""
        pictures = len(self._written - {CHART})
        text = f"{CHART} and pictures of {pictures} of {self._shots} shots are in {self.folder}"
        if pictures < self._shots:
            kind = "every one" if self._odd <= ODD_UP_TO else "many"
            often = (
                f"one in {self._every} of the others" if self._every else "fewer and fewer of the others as it went on"
            )
            text += f": {kind} that was missed, searched or jumped, and {often}"
        old = len((self._earlier or set()) - self._written)
        return text + (f"; of an earlier run there are left: {old}" if old else "")

    def _file_name(self, shot: str) -> str:
        """Return a unique name for a shot's picture, of characters that any file system accepts."""
        stem = PREFIX + re.sub(r"[^\w.-]", "_", shot)[-_LONGEST_NAME:]
        name, again = f"{stem}.png", 1
        while name in self._written:
            again += 1
            name = f"{stem}~{again}.png"
        return name

    def _put(self, name: str, data: bytes) -> None:
        if not self._written:
            from armsight.app.show.page import writable_folder

            writable_folder(self.folder, "no pictures")
        with replacing(self.folder / name, "wb") as file:
            file.write(data)
        self._written.add(name)


def _step(number: int, most: int) -> int:
    """Return the step between shots with a picture: 1 up to ``most`` shots, doubled as often as their number doubles."""
    return 1 << (number // most).bit_length()
