"""A shot's pose as a record, as a line of JSON, and as a row of CSV.

In: what vision measured in a shot. Out: a :class:`ShotPose`. All is in the left camera's frame. ``covariance`` is that of
[translation m; rotation rad] along the axes of the left camera (the true pose is the estimate rotated by the rotation
vector about the body's origin, and shifted); ``covariance_body`` is the same along the body's axes, as
docs/concepts/conventions.md defines it (perturbation on the right). ``covariance`` is the sum of two shares:
``covariance_precision`` differs from shot to shot (noise of the images), ``covariance_calibration`` is common to all shots
of a rig: no mean over shots lowers it.

``euler_zyx_deg`` are the angles about z, y and x, in this order: R = R_z R_y R_x. ROS lists the same three angles the other
way round, as roll (about x), pitch, yaw (about z).
"""

from __future__ import annotations

import importlib
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from armsight.data import Array, Body, Dropped, Missed, PoseEstimate, SeenPose
from armsight.errors import InputError
from armsight.files import table_text, write_text
from armsight.geometry.pose import left_axes, pose
from armsight.geometry.rotation import euler_zyx, from_quaternion_wxyz, quaternion_wxyz
from armsight.plots import new_figure
from armsight.vision.rig import Shutters

#: Elements of a 6x6 covariance that are written.
UPPER = [(i, j) for i in range(6) for j in range(i, 6)]
#: Names of the three angles for people: about z, y, x.
ANGLES = ("rz", "ry", "rx")
_AXES = (*(f"{axis}_m" for axis in "xyz"), *(f"r{axis}_rad" for axis in "xyz"))
CSV_COLUMNS = (
    "shot",
    "status",
    "reason",
    "t_s",
    *(f"{axis}_m" for axis in "xyz"),
    *(f"q{axis}" for axis in "wxyz"),
    *(f"euler_{axis}_deg" for axis in "zyx"),
    *(f"sigma_{axis}" for axis in _AXES),
    "residual_rms_m",
    "reprojection_rms_px",
    "misfit",
    "points",
    "dropped",
    *(f"cov_{i}{j}" for i, j in UPPER),
    *(f"sigma_{share}_{axis}" for share in ("precision", "calibration") for axis in _AXES),
)

SHUTTER_COLUMNS = ("skew_s", "readout_s", "sigma_skew_s", "sigma_readout_s")


@dataclass(frozen=True, eq=False)
class ShotPose(SeenPose):
    """What was measured in one shot; the values after ``reason`` hold only where ``reason`` is None."""

    shot: str  #: name of the shot
    t_s: float | None  #: its time, s; None where it has none
    reason: str | None = None  #: why no pose was measured; None where one was
    position_m: Array = field(default_factory=lambda: np.full(3, np.nan))  #: (3,) position of the body's origin, m
    quaternion_wxyz: Array = field(default_factory=lambda: np.full(4, np.nan))  #: (4,) orientation of the body
    #: (3,) the same as angles about z, y, x, degrees
    euler_zyx_deg: Array = field(default_factory=lambda: np.full(3, np.nan))
    #: whether the angle about y is +-90 degrees: then only those about z and x together are determined
    pitch_singular: bool = False
    #: (6, 6) covariance [m; rad] along the left camera's axes
    cov_left: Array = field(default_factory=lambda: np.full((6, 6), np.nan))
    #: (6, 6) the share of ``cov_left`` that differs from shot to shot; the rest is the calibration's
    cov_precision: Array = field(default_factory=lambda: np.full((6, 6), np.nan))
    #: (6, 6) covariance [m; rad] along the body's axes
    cov_body: Array = field(default_factory=lambda: np.full((6, 6), np.nan))
    residual_rms_m: float | None = None  #: RMS distance of the points from the body's, m; None where it is not known
    reprojection_rms_px: float = math.nan  #: RMS reprojection error, px
    #: Birge ratio: how many times larger the residuals are than the pixel noise allows, 1 where they are not larger;
    #: the covariances include it
    misfit: float = math.nan
    points_m: Mapping[str, Array] = field(default_factory=dict)  #: triangulated points by name, m
    dropped: tuple[Dropped, ...] = ()  #: points that were left out, and why
    way: str | None = None  #: how the follower found the body; None where it was not followed
    jump: str | None = None  #: what was noticed about a jump of the pose; None without
    took_ms: float | None = None  #: duration of the measurement, ms; None where it was not followed
    #: by which all observations were moved to the shot's time; None where they were taken as simultaneous
    shutters: Shutters | None = None

    @property
    def T_left_body(self) -> Array:  # type: ignore[override]
        """(4, 4) pose of the body in the left camera's frame; NaN where none was measured."""
        return pose(from_quaternion_wxyz(self.quaternion_wxyz), self.position_m)

    @property
    def ok(self) -> bool:
        """Whether a pose was measured."""
        return self.reason is None

    @property
    def cov_calibration(self) -> Array:
        """(6, 6) the share of ``cov_left`` that is common to all shots of the rig."""
        return self.cov_left - self.cov_precision

    @property
    def position_sigmas_m(self) -> tuple[float, float, float]:
        """Sigmas of the position in space (roots of the traces), m: in all, precision, calibration."""
        traces = (float(np.trace(cov[:3, :3])) for cov in (self.cov_left, self.cov_precision, self.cov_calibration))
        total, precision, calibration = (math.sqrt(max(trace, 0.0)) for trace in traces)
        return total, precision, calibration

    @property
    def angle_sigmas_deg(self) -> Array:
        """(3,) one sigma of ``euler_zyx_deg``, degrees; NaN at the singularity."""
        return np.full(3, np.nan) if self.pitch_singular else self.sigma_deg

    @property
    def status(self) -> str:
        """Status as JSON and CSV have it: ok or missed."""
        return "ok" if self.ok else "missed"

    def to_json(self) -> dict[str, Any]:
        """Return the object that ``measure --json`` prints."""
        found: dict[str, Any] = {"shot": self.shot, "t_s": self.t_s, "status": self.status, "reason": self.reason}
        if self.ok:
            found |= {
                "position_m": self.position_m.tolist(),
                "quaternion_wxyz": self.quaternion_wxyz.tolist(),
                "euler_zyx_deg": self.euler_zyx_deg.tolist(),
                "pitch_singular": self.pitch_singular,
                "covariance": self.cov_left.tolist(),
                "covariance_precision": self.cov_precision.tolist(),
                "covariance_calibration": self.cov_calibration.tolist(),
                "covariance_body": self.cov_body.tolist(),
                "residual_rms_m": self.residual_rms_m,
                "reprojection_rms_px": self.reprojection_rms_px,
                "misfit": self.misfit,
                "points_m": {name: p.tolist() for name, p in self.points_m.items()},
                "dropped": [{"point": d.point, "reason": d.reason} for d in self.dropped],
            }
        if self.way is not None:
            found |= {"way": self.way, "jump": self.jump, "took_ms": self.took_ms}
        if self.shutters is not None:
            found["shutters"] = self.shutters.to_json()
        return found


def shot_pose(name: str, t_s: float | None, body: Body, result: PoseEstimate | Missed) -> ShotPose:
    """Return the record of one shot at t_s, s, of a body."""
    if isinstance(result, Missed):
        return ShotPose(name, t_s, result.reason)
    T = result.T_left_body
    angles, singular = euler_zyx(T[:3, :3])
    names = body.point_names
    return ShotPose(
        name,
        t_s,
        None,
        T[:3, 3],
        quaternion_wxyz(T[:3, :3]),
        np.degrees(angles),
        singular,
        left_axes(T, result.cov),
        left_axes(T, result.cov_noise),
        result.cov,
        result.residual_rms_m if math.isfinite(result.residual_rms_m) else None,
        result.reprojection_rms_px,
        result.misfit,
        {names[i]: p for i, p in zip(result.points.ids, result.points.p_left, strict=True)},
        tuple(result.dropped),
    )


def row_of(p: ShotPose, columns: Sequence[str] = CSV_COLUMNS) -> list[Any]:
    """Return a shot's row of a table with CSV_COLUMNS, and SHUTTER_COLUMNS behind them or not; None where it has no value.

    ``cov_ij`` is the upper triangle of ``covariance``.
    """
    row: list[Any] = [p.shot, p.status, p.reason, p.t_s]
    if p.ok:
        row += [*p.position_m.tolist(), *p.quaternion_wxyz.tolist(), *p.euler_zyx_deg.tolist()]
        row += np.sqrt(np.diag(p.cov_left)).tolist()
        row += [p.residual_rms_m, p.reprojection_rms_px, p.misfit, len(p.points_m), len(p.dropped)]
        row += [float(p.cov_left[i, j]) for i, j in UPPER]
        for share in (p.cov_precision, p.cov_calibration):
            row += np.sqrt(np.maximum(np.diag(share), 0.0)).tolist()
    if p.shutters is not None:
        row += [None] * (len(CSV_COLUMNS) - len(row))
        row += [p.shutters.skew_s, p.shutters.readout_s, *p.shutters.sigmas.tolist()]
    return row + [None] * (len(columns) - len(row))


def rows_of(poses: Sequence[ShotPose]) -> tuple[tuple[str, ...], list[list[Any]]]:
    """Return the columns of a table of shots, SHUTTER_COLUMNS where shots were moved to one time, and its rows."""
    columns = CSV_COLUMNS + (SHUTTER_COLUMNS if any(p.shutters is not None for p in poses) else ())
    return columns, [row_of(p, columns) for p in poses]


def csv_text(poses: Sequence[ShotPose]) -> str:
    """Return the CSV of many shots."""
    return table_text(*rows_of(poses))


@dataclass(frozen=True, repr=False)
class ShotPoses:
    """The poses of many shots, as :func:`~armsight.vision.pose.measure_all.measure_all` returns them.

    ``pandas.DataFrame(table.columns())`` and ``polars.DataFrame(table.columns())`` make a frame of it, as does whatever
    reads Arrow's interface where pyarrow is installed. The columns are those of ``armsight measure -o``.
    """

    poses: tuple[ShotPose, ...]  #: one a shot, missed ones included

    def __len__(self) -> int:
        """Return how many shots there are."""
        return len(self.poses)

    def __getitem__(self, row: int) -> ShotPose:
        """Return the pose of one shot."""
        return self.poses[row]

    def columns(self, lengths: str = "m") -> dict[str, Array | list[str | None]]:
        """Return the columns by name: (N,) numbers, NaN where a shot was missed; lists of text.

        ``lengths``: "m", the columns of ``armsight measure -o``; "mm": lengths in mm, as x_mm and sigma_x_mm. Raises
        InputError: another unit.
        """
        if lengths not in ("m", "mm"):
            raise InputError(f'columns({lengths!r}): lengths are in "m" or "mm"')
        names, rows = rows_of(self.poses)
        found: dict[str, Array | list[str | None]] = {}
        for k, name in enumerate(names):
            cells = [row[k] for row in rows]
            found[name] = (
                cells
                if k < CSV_COLUMNS.index("t_s")
                else np.array([math.nan if v is None else v for v in cells], float)
            )
        if lengths == "m":
            return found
        return {
            f"{name}m" if name.endswith("_m") else name: 1e3 * np.asarray(each) if name.endswith("_m") else each
            for name, each in found.items()
        }

    def write_csv(self, path: str | Path) -> None:
        """Write the file that ``armsight measure -o`` writes. Raises InputError: it cannot be written; then nothing is."""
        write_text(Path(path), csv_text(self.poses))

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        """Return the table by Arrow's C interface; it needs pyarrow."""
        import pyarrow

        return pyarrow.table(self.columns()).__arrow_c_stream__(requested_schema)

    def to_pandas(self, lengths: str = "m") -> Any:  # noqa: ANN401 - pandas is no dependency
        """Return pandas' DataFrame of the columns.

        ``lengths``: "m" or "mm", as :meth:`columns` takes it. Raises InputError: pandas is not installed, or another unit.
        """
        try:
            return importlib.import_module("pandas").DataFrame(self.columns(lengths))
        except ImportError:
            raise InputError("pandas is not installed: pip install pandas; columns() is the same table") from None

    def plot(self) -> Any:  # noqa: ANN401 - matplotlib is no dependency
        """Draw position, mm, and angles, degrees, over time or shots, with two sigmas; return matplotlib's figure.

        Raises InputError: matplotlib is not installed, or no shot was measured.
        """
        figure, axes = new_figure(3, 2, sharex=True)
        good = [each for each in self.poses if each.ok]
        if not good:
            raise InputError(f"nothing to draw: {self!r}")
        timed = all(each.t_s is not None for each in self.poses)
        at = [each.t_s if timed else k for k, each in enumerate(self.poses) if each.ok]
        for column, values, sigmas, names in (
            (0, [each.position_mm for each in good], [each.sigma_mm for each in good], ("x, mm", "y, mm", "z, mm")),
            (1, [each.angles_deg for each in good], [each.sigma_deg for each in good], [f"{a}, deg" for a in ANGLES]),
        ):
            for ax, centre, sigma, name in zip(
                axes[:, column], np.transpose(values), np.transpose(sigmas), names, strict=True
            ):
                ax.fill_between(at, centre - 2 * sigma, centre + 2 * sigma, alpha=0.3, linewidth=0)
                ax.plot(at, centre, ".-", markersize=3)
                ax.set_ylabel(name)
            axes[-1, column].set_xlabel("time, s" if timed else "shot")
        figure.suptitle(f"{len(good)} of {len(self)} shots measured; band: two sigmas", fontsize="medium")
        return figure

    def __repr__(self) -> str:
        """Return how many shots were measured, and the sigma of a position in the middle, mm."""
        good = [1e3 * each.position_sigmas_m[0] for each in self.poses if each.ok]
        sigma = f", sigma {np.median(good):.3f} mm (median)" if good else ""
        reasons = Counter(each.reason for each in self.poses if not each.ok).most_common(1)
        missed = "".join(f"; missed {count} times: {reason}" for reason, count in reasons)
        return f"ShotPoses({len(good)} of {len(self)} shots measured{sigma}{missed})"
