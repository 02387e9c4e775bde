"""``armsight measure --view``: a folder of annotated pictures, one a shot, and the strip chart of all shots.

A long run gets a picture of every shot that was missed, searched for or jumped, and of every few others. The chart
(:func:`chart`) shows how each was found, the pose, its sigmas and the residuals, one above the other.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.app.measure.picture import draw_shot, header, marks_of
from armsight.app.show.messages import require
from armsight.app.show.plotting import BLUE, INK, MUTED, ORANGE, RED, drawing, new_figure, png, require_matplotlib
from armsight.data import Array, Body, Missed, PoseEstimate, Record, Shot
from armsight.files import check_folder, replacing
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.pose.shot_pose import ANGLES, ShotPose
from armsight.vision.rig import StereoRig

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_GREEN, _PURPLE, _LOST = "#3f8f5f", "#7b52ab", "#f6dcdc"
TIME, SHOT = "time since the first shot, s", "shot"
#: How a shot was found -> its colour in the band, the usual ones first.
_WAYS = {"followed": _GREEN, "measured": BLUE, "searched": ORANGE, "lost": RED, "missed": RED}
#: Strips: the pose, two of sigmas, one of residuals.
_STRIPS = 2 * len(ANGLES) + 3
#: So many shots can be distinguished as dots; from so many on lines are thinner.
_DOTS_UP_TO, _THIN_FROM = 80, 1000
#: Sigmas that differ by a larger factor are plotted on a logarithmic scale; a longer interval, in median steps, is a gap.
_LOG_FROM, _GAP_STEPS = 20.0, 3.0
#: Where a legend stands.
_LEGEND: dict[str, Any] = {"borderaxespad": 0.0, "handlelength": 1.2}


@dataclass(frozen=True, eq=False)
class ChartData(Record):
    """N shots as they are plotted; NaN where one was missed."""

    along: Array  #: (N,) time since the first shot, s, or the number of the shot
    label: str  #: of that axis
    way: tuple[str, ...]  #: how each was found: a key of the band's colours
    jumped: NDArray[np.bool_]  #: (N,) whether the pose jumped
    pose: Array  #: (N, 6) x, y, z, mm; angles about z, y, x, degrees, without steps of 360 degrees
    pose_sigma: Array  #: (N, 6) one sigma of these
    rotation_sigma: Array  #: (N, 3) one sigma of the rotation about the left camera's axes, degrees
    rms_px: Array  #: (N,) reprojection RMS, px


def chart_data(poses: Sequence[ShotPose]) -> ChartData:
    """Return what is plotted of many shots."""
    count = len(poses)
    times = np.array([np.nan if p.t_s is None else p.t_s for p in poses], float)
    timed = count > 1 and bool((np.diff(times) > 0).all())
    pose, sigma, rotation, rms = (np.full((count, width), np.nan) for width in (6, 6, 3, 1))
    for n, p in enumerate(poses):
        if p.ok:
            each = np.sqrt(np.diag(p.cov_left))
            pose[n] = [*(1e3 * p.position_m), *p.euler_zyx_deg]
            sigma[n] = [*(1e3 * each[:3]), *p.angle_sigmas_deg]
            rotation[n], rms[n] = np.degrees(each[3:]), p.reprojection_rms_px
    good = np.isfinite(rms[:, 0])
    pose[good, 3:] = np.unwrap(pose[good, 3:], period=360.0, axis=0)
    way = tuple(p.way or ("measured" if p.ok else "missed") for p in poses)
    jumped = np.array([bool(p.jump) for p in poses], bool)
    along = times - times[0] if timed else np.arange(1.0, count + 1)
    return ChartData(along, TIME if timed else SHOT, way, jumped, pose, sigma, rotation, rms[:, 0])


def chart(poses: Sequence[ShotPose]) -> bytes:
    """Return the strip chart of at least one shot as PNG."""
    with drawing():
        return png(_figure(chart_data(poses)))


def _figure(run: ChartData) -> Figure:
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(11.5)
    grid = figure.add_gridspec(_STRIPS + 1, 1, height_ratios=[0.3, *[1.0] * _STRIPS])
    top = figure.add_subplot(grid[0])
    strips = [figure.add_subplot(grid[1 + k], sharex=top) for k in range(_STRIPS)]
    _band(top, run)
    for k, name in enumerate([*(f"{n}\nmm" for n in "xyz"), *(f"{n}\ndeg" for n in ANGLES)]):
        _strip(strips[k], run, run.pose[:, k], run.pose_sigma[:, k], name)
    _sigmas(strips[6], run, run.pose_sigma[:, :3], "sigma of\nposition\nmm")
    _sigmas(strips[7], run, run.rotation_sigma, "sigma of\nrotation\ndeg")
    _line(strips[8], run, run.rms_px, INK)
    _from_zero(strips[8], run.rms_px[np.isfinite(run.rms_px)])
    strips[8].set_ylabel("reprojection\nRMS, px")
    for axes in strips:
        for begin, end, way in _intervals(run):
            if way in ("lost", "missed"):
                axes.axvspan(begin, end, color=_LOST, linewidth=0.8, zorder=0)
        axes.grid(axis="y", color="#e4e7eb", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(labelbottom=axes is strips[-1])
        if not np.isfinite(run.rms_px).any():
            axes.set_yticks([])
    strips[-1].set_xlabel(run.label)
    strips[-1].xaxis.set_major_locator(MaxNLocator(integer=run.label == SHOT))
    figure.align_ylabels(strips)
    return figure


def _gaps(along: Array) -> NDArray[np.bool_]:
    steps = np.diff(along)
    return np.asarray(steps > _GAP_STEPS * np.median(steps)) if len(steps) else np.zeros(0, bool)


def _broken(along: Array, values: Array) -> Array:
    """Return values with a NaN inserted at every gap, which interrupts the line."""
    return np.insert(values, np.flatnonzero(_gaps(along)) + 1, np.nan)


def _edges(along: Array) -> tuple[Array, Array]:
    """Return the begin (N,) and the end (N,) of each shot's interval on the axis: half way to its neighbours."""
    if len(along) == 1:
        return along - 0.5, along + 0.5
    steps = np.diff(along)
    usual = float(np.median(steps))
    half = np.where(_gaps(along), usual, steps) / 2
    return along - np.append(half[0], half), along + np.append(half, half[-1])


def _intervals(run: ChartData) -> Iterator[tuple[float, float, str]]:
    """Yield begin, end and way of every interval of consecutive shots that were found the same way; gaps separate them."""
    low, high = _edges(run.along)
    begin = 0
    for n in range(1, len(low) + 1):
        if n == len(low) or run.way[n] != run.way[begin] or low[n] > high[n - 1] + 1e-9 * abs(high[n - 1]):
            yield float(low[begin]), float(high[n - 1]), run.way[begin]
            begin = n


def _band(axes: Axes, run: ChartData) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    counts = Counter(run.way)
    for way, count in counts.most_common():
        bars = [(begin, end - begin) for begin, end, w in _intervals(run) if w == way]
        rare = 0.8 if count < len(run.way) / 2 else 0.0
        axes.broken_barh(bars, (0.0, 1.0), facecolor=_WAYS[way], edgecolor=_WAYS[way], linewidth=rare, clip_on=False)
    handles: list[Any] = [Patch(color=colour, label=f"{counts[w]} {w}") for w, colour in _WAYS.items() if counts[w]]
    if run.jumped.any():
        style: Any = {"marker": "v", "color": _PURPLE, "linestyle": "none", "clip_on": False}
        axes.plot(run.along[run.jumped], np.full(int(run.jumped.sum()), 1.25), **style)
        handles.append(Line2D([], [], label=f"{run.jumped.sum()} jumped", **style))
    said: Any = {"title": f"shots: {len(run.way)}", "alignment": "left", "ncols": len(handles)}
    axes.legend(handles=handles, loc="lower left", bbox_to_anchor=(0.0, 1.15), **said, **_LEGEND)
    axes.set_ylim(0.0, 1.0)
    low, high = _edges(run.along)
    axes.set_xlim(float(low[0]), float(high[-1]))
    axes.set_yticks([])
    axes.tick_params(labelbottom=False, bottom=False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _line(axes: Axes, run: ChartData, values: Array, colour: str, width: float = 0.9, label: str | None = None) -> None:
    good = np.isfinite(values)
    linked = good[1:] & good[:-1] & ~_gaps(run.along)
    beside = np.append(linked, False) | np.append(False, linked)
    dots = good if len(good) <= _DOTS_UP_TO else good & ~beside
    x, y = _broken(run.along, run.along), _broken(run.along, values)
    axes.plot(x, y, color=colour, linewidth=width if len(good) <= _THIN_FROM else 0.6 * width, label=label)
    axes.plot(run.along[dots], values[dots], ".", color=colour, markersize=3.5)


def _strip(axes: Axes, run: ChartData, values: Array, sigma: Array, name: str) -> None:
    """Plot one coordinate with its band of 3 sigma, and print the band's width, as it may be thinner than the line."""
    x, low, high = (_broken(run.along, v) for v in (run.along, values - 3 * sigma, values + 3 * sigma))
    axes.fill_between(x, low, high, color=BLUE, alpha=0.25, linewidth=0.0)
    _line(axes, run, values, BLUE)
    axes.set_ylabel(name)
    axes.ticklabel_format(axis="y", useOffset=False)
    if np.isfinite(sigma).any():
        width = f"band: 3 sigma, ±{3 * np.nanmedian(sigma):.2g} {name.split()[-1]} (median)"
        axes.text(1.0, 1.02, width, transform=axes.transAxes, ha="right", va="bottom", fontsize=7.0, color=MUTED)


def _from_zero(axes: Axes, values: Array) -> None:
    if len(values) and values.max() > 0:
        axes.set_ylim(0.0, 1.12 * float(values.max()))


def _sigmas(axes: Axes, run: ChartData, sigma: Array, name: str) -> None:
    # The wider line beneath the narrower: where they coincide both can be seen.
    for k, (letter, colour, width) in enumerate(zip("xyz", (BLUE, ORANGE, _GREEN), (2.2, 1.3, 0.7), strict=True)):
        _line(axes, run, sigma[:, k], colour, width, letter)
    good = sigma[np.isfinite(sigma)]
    if len(good) and good.min() > 0 and good.max() > _LOG_FROM * good.min():
        axes.set_yscale("log")
    else:
        _from_zero(axes, good)
    axes.legend(ncols=3, fontsize=7.0, columnspacing=1.2, loc="lower right", bbox_to_anchor=(1.0, 0.96), **_LEGEND)
    axes.set_ylabel(name)


CHART, PREFIX = "run.png", "view-"
#: A run of more shots than this does not get a picture of each; nor of each odd one where so many are odd.
EACH_UP_TO, ODD_UP_TO = 60, 500


def view_folder(directory: str | Path) -> Path:
    """Check that pictures can be written, before anything is measured."""
    require("--view", "report", "matplotlib.figure")
    require_matplotlib()
    return check_folder(directory, problem="no pictures can be written here")


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
            often = f"one in {self._every} of the others" if self._every else "ever fewer of the others as it went on"
            text += f": {kind} that was missed, searched or jumped, and {often}"
        old = len((self._earlier or set()) - self._written)
        return text + (f"; of an earlier run there are left: {old}" if old else "")

    def _file_name(self, shot: str) -> str:
        """Return a unique name for a shot's picture, of characters that any file system accepts."""
        stem = PREFIX + re.sub(r"[^\w.-]", "_", shot)[-50:]  # a file system's 255 bytes hold that many of any script
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
