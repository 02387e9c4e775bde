"""The frozen records that flow through armsight, in pipeline order.

    camera --Shot--> markers --Detections--> match --Correspondences--> triangulate --Points--> locate --PoseEstimate-->

Arrays in a record are read-only. Frames, units and the meaning of a covariance: the documentation's page on conventions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ids = NDArray[np.int64]
Image = NDArray[Any]
Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")


@dataclass(frozen=True, eq=False)
class Record:
    """A frozen record whose arrays are read-only views of what it was given, printed as one line."""

    def __init_subclass__(cls) -> None:
        """Keep the short form: ``dataclass`` writes one of its own only where a class has none."""
        if "__repr__" not in cls.__dict__:
            type.__setattr__(cls, "__repr__", Record.__repr__)
        super().__init_subclass__()

    def __repr__(self) -> str:
        """Return the fields in one line: short arrays whole, of poses the position, of others the shape."""
        shown = (f"{name}={_short(name, value)}" for name, value in self.__dict__.items() if not name.startswith("_"))
        return f"{type(self).__name__}({', '.join(shown)})"

    def __post_init__(self) -> None:
        """Make every array field a read-only view."""
        fields = self.__dict__  # not dataclasses.fields: records are made for every shot of a live loop
        for name, value in fields.items():
            if isinstance(value, np.ndarray) and value.flags.writeable:
                fields[name] = view = value.view()
                view.setflags(write=False)


#: Longest array and tuple that the text of a record has whole, and longest text, characters.
_WHOLE, _LETTERS = 6, 60


def _short(name: str, value: object) -> str:
    """Return the value of a record's field in a few words."""
    if isinstance(value, np.ndarray):
        if value.shape == (4, 4) and name.startswith("T_"):
            return f"<pose at {', '.join(f'{x:.6g}' for x in value[:3, 3])} m>"
        if value.ndim == 1 and value.size <= _WHOLE:
            return f"[{', '.join(f'{x:.6g}' if value.dtype.kind == 'f' else str(x) for x in value)}]"
        return f"<{' x '.join(map(str, value.shape))} {value.dtype}>"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Record):
        inner = repr(value)
        return inner if len(inner) <= 2 * _LETTERS else f"{type(value).__name__}(...)"
    if isinstance(value, (tuple, list, Mapping)) and len(value) > _WHOLE:
        return f"<{len(value)} entries>"
    text = repr(value)
    return text if len(text) <= _LETTERS else f"{text[: _LETTERS - 3]}..."


@dataclass(frozen=True, eq=False)
class Shot(Record):
    """Two simultaneous images, or the reason there are none.

    Attributes:
        name: what the source calls it, unique in a run.
        left: (H, W) grey or (H, W, 3) BGR image of the left camera, uint8 or uint16; None with a problem.
        right: the same of the right camera.
        t_s: time of the grab, s, on the source's clock; None where it has none.
        problem: why the shot cannot be used; None when it can.
        encoded: both images as the cameras delivered them, each the bytes of a JPEG or PNG file; None where they were
            delivered as pixels, or are not kept.
    """

    name: str
    left: Image | None
    right: Image | None
    t_s: float | None = None
    problem: str | None = None
    encoded: tuple[bytes, bytes] | None = None

    def image(self, side: Side) -> Image | None:
        """Return the image of one side."""
        return self.left if side == "left" else self.right

    def plot(self) -> Any:  # noqa: ANN401 - matplotlib is no dependency
        """Draw both images side by side; return matplotlib's figure.

        Raises:
            InputError: matplotlib is not installed.
        """
        from armsight.plots import new_figure

        figure, axes = new_figure(1, 2)
        for side, ax in zip(SIDES, axes, strict=True):
            image = self.image(side)
            if image is not None:
                ax.imshow(image if image.ndim == 2 else image[..., ::-1], cmap="gray")
            ax.set(title=side if image is not None else f"{side}: {self.problem}", xticks=[], yticks=[])
        figure.suptitle(self.name)
        return figure


@dataclass(frozen=True, eq=False)
class Body(Record):
    """A rigid body: named points in its own frame.

    Attributes:
        name: what the body is called.
        point_names: one name a point; "P1", "12", a board's corner number.
        points: (M, 3) positions, m, body frame.
    """

    name: str
    point_names: tuple[str, ...]
    points: Array


@dataclass(frozen=True, eq=False)
class Detections(Record):
    """What one camera saw of one body.

    Attributes:
        ids: (N,) rows of the body's points, strictly increasing.
        uv: (N, 2) their positions, raw pixels.
        cov_uv: (N, 2, 2) covariance of the positions from the image's own noise, px^2; zero where unknown.
        problem: why nothing was found; None when something was.
        shape: (N, 3) S11, S12, S22 of the ellipses of a board's discs, px^2, as in :class:`Discs`; (0, 3) for other points.
        common: (2, 3) as in :class:`Discs`; zero for other points.
    """

    ids: Ids
    uv: Array
    cov_uv: Array
    problem: str | None = None
    shape: Array = field(default_factory=lambda: np.zeros((0, 3)))
    common: Array = field(default_factory=lambda: np.zeros((2, 3)))

    @staticmethod
    def none(problem: str) -> Detections:
        """Return empty detections with the reason."""
        return Detections(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)), problem)


class Rejected(NamedTuple):
    """A position in an image that looked like a marker and is none, and why.

    Attributes:
        uv: (column, row), raw pixels.
        reason: why.
    """

    uv: tuple[float, float]
    reason: str


@dataclass(frozen=True, eq=False)
class Discs(Record):
    """The discs that one camera saw; which of a body's discs each one is, a single image does not say.

    Attributes:
        uv: (N, 2) centres of their image ellipses, raw pixels.
        cov_uv: (N, 2, 2) covariance of the centres from the image's own noise, px^2.
        shape: (N, 3) S11, S12, S22 of each ellipse, px^2: its rim is uv + x with x^T S^-1 x = 1.
        bright: (N,) whether a disc is brighter than its surround.
        rejected: what was looked at and is no disc.
        common: (2, 3) c (2), px, and k of two shifts c + k x, at a pixel x, by which all of them may have been moved
            together, beyond ``cov_uv``: by blur or sharpening, and by vignetting; each one standard deviation.
    """

    uv: Array
    cov_uv: Array
    shape: Array
    bright: NDArray[np.bool_]
    rejected: tuple[Rejected, ...] = ()
    common: Array = field(default_factory=lambda: np.zeros((2, 3)))

    @property
    def radius_px(self) -> Array:
        """(N,) the longer half axis of each ellipse, px: a disc's radius over its distance, whatever its orientation."""
        mean, half = (self.shape[:, 0] + self.shape[:, 2]) / 2, (self.shape[:, 0] - self.shape[:, 2]) / 2
        return np.asarray(np.sqrt(mean + np.hypot(half, self.shape[:, 1])))


@dataclass(frozen=True)
class Dropped:
    """A point that was seen and not used, and why.

    Attributes:
        point: its name.
        reason: why, for people.
        contradicts: whether it was seen well, but where neither the other camera nor the body's other points allow it.
    """

    point: str
    reason: str
    contradicts: bool = False


@dataclass(frozen=True, eq=False)
class Correspondences(Record):
    """What both cameras saw of one body in one shot; camera 0 is left, 1 right.

    Attributes:
        ids: (N,) rows of the body's points, strictly increasing, seen by at least one camera.
        uv: (N, 2, 2) point, camera, raw pixel; NaN where that camera did not see the point.
        cov_uv: (N, 2, 2, 2) covariance of each position, px^2.
        dropped: what was thrown away, and why.
        common: (2, 2, 3) camera; what may have moved its detections together, as in :class:`Discs`.
    """

    ids: Ids
    uv: Array
    cov_uv: Array
    dropped: tuple[Dropped, ...] = ()
    common: Array = field(default_factory=lambda: np.zeros((2, 2, 3)))

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(N, 2) whether a camera saw a point."""
        return np.asarray(np.isfinite(self.uv[..., 0]))

    @property
    def paired(self) -> NDArray[np.bool_]:
        """(N,) whether both cameras saw a point."""
        return np.asarray(self.seen.all(axis=1))


@dataclass(frozen=True, eq=False)
class Points(Record):
    """Triangulated points of one shot.

    Attributes:
        ids: (N,) rows of the body's points.
        p_left: (N, 3) positions, m, left camera's frame.
        cov: (N, 3, 3) covariance from the pixel noise alone, m^2.
        calibration: (N, 3, P) derivative of each position by the rig's parameters: what a wrong calibration does to
            all points together.
        seen: the correspondences they came from, one-camera points included.
        dropped: what was thrown away up to here, and why.
    """

    ids: Ids
    p_left: Array
    cov: Array
    calibration: Array
    seen: Correspondences
    dropped: tuple[Dropped, ...] = ()


@dataclass(frozen=True)
class Missed:
    """An expected miss: no measurement in this shot, and why. It is false: ``if pose := measure(...)``."""

    reason: str

    def __bool__(self) -> bool:
        """Return False: nothing was measured."""
        return False

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - it never returns
        """Raise an AttributeError with the reason; it names what a pose would have."""
        raise AttributeError(f"{name}: nothing was measured: {self.__dict__.get('reason')}")


class SeenPose(Record):
    """What people read of a pose in the left camera's frame: mm, degrees, and one sigma of each, along its axes."""

    T_left_body: Array
    cov_left: Any  # a field, or a property of ``cov``

    @property
    def position_mm(self) -> Array:
        """(3,) x, y, z of the body's origin in the left camera's frame, mm."""
        return np.asarray(1e3 * self.T_left_body[:3, 3])

    @property
    def sigma_mm(self) -> Array:
        """(3,) one sigma of ``position_mm``, mm."""
        return np.asarray(1e3 * np.sqrt(np.diag(self.cov_left[:3, :3])))

    @property
    def angles_deg(self) -> Array:
        """(3,) rz, ry, rx, degrees: the body's rotation is R_z R_y R_x, about the left camera's axes."""
        from armsight.geometry.rotation import (
            euler_zyx,  # not above: it takes compiled kernels, which records do without
        )

        return np.degrees(euler_zyx(self.T_left_body[:3, :3])[0])

    @property
    def sigma_deg(self) -> Array:
        """(3,) one sigma of ``angles_deg``, degrees; NaN where ry is +-90 and only rz and rx together are determined."""
        from armsight.geometry.rotation import euler_zyx_sigmas

        return np.degrees(euler_zyx_sigmas(self.T_left_body[:3, :3], self.cov_left[3:, 3:]))


@dataclass(frozen=True, eq=False)
class ExposureErrors(Record):
    """What is not known of when a shot's N detections were exposed, where they were moved to its time.

    Attributes:
        own: (N, 2, 6, K) by how much the body is displaced at each, left and right, by one sigma of K errors that the shot
            has of its own: right tangent [m; rad]; zero where nothing was detected.
        cov_shared: (2, 2) covariance of skew and readout, s^2, which all shots share.
    """

    own: Array
    cov_shared: Array


@dataclass(frozen=True, eq=False)
class PoseEstimate(SeenPose):
    """Where a body is.

    Attributes:
        T_left_body: (4, 4) pose of the body in the left camera's frame.
        cov: (6, 6) covariance of the tangent [translation m; rotation rad] along the body's axes, perturbation on the
            right; pixel noise and the rig's calibration together. ``cov_left`` is the same along the left camera's axes.
        cov_noise: (6, 6) the same from the pixel noise alone.
        residual_rms_m: RMS distance of the triangulated points from the fitted body.
        reprojection_rms_px: RMS distance of the detections from the fitted body's projections.
        misfit: how many times larger than the pixel noise allows the residuals are; the covariance holds it. 1 where
            they are within chance.
        points: the triangulated points that went in.
        dropped: what was thrown away, and why.
        exposures: what is not known of the times of its detections; None where all count as exposed at one time.
    """

    T_left_body: Array
    cov: Array
    cov_noise: Array
    residual_rms_m: float
    reprojection_rms_px: float
    misfit: float
    points: Points
    dropped: tuple[Dropped, ...] = ()
    exposures: ExposureErrors | None = None

    @property
    def cov_left(self) -> Array:
        """(6, 6) covariance [m; rad] along the left camera's axes, rotations about the body's origin."""
        from armsight.geometry.pose import left_axes

        return left_axes(self.T_left_body, self.cov)

    @property
    def quaternion_wxyz(self) -> Array:
        """(4,) orientation of the body."""
        from armsight.geometry.rotation import quaternion_wxyz

        return quaternion_wxyz(self.T_left_body[:3, :3])

    def to_dict(self) -> dict[str, Any]:
        """Return what people read, as lists and numbers: mm, degrees, and one sigma of each."""
        named = {"position_mm": self.position_mm, "sigma_mm": self.sigma_mm}
        named |= {"angles_deg": self.angles_deg, "sigma_deg": self.sigma_deg}
        return {name: value.tolist() for name, value in named.items()} | {
            "reprojection_rms_px": self.reprojection_rms_px,
            "misfit": self.misfit,
            "points": len(self.points.ids),
            "dropped": [f"{each.point}: {each.reason}" for each in self.dropped],
        }

    def _texts(self) -> list[tuple[str, str, str]]:
        """Return name, value with sigma, and unit of each number."""
        mm = zip("xyz", self.position_mm, self.sigma_mm, strict=True)
        deg = zip(("rz", "ry", "rx"), self.angles_deg, self.sigma_deg, strict=True)
        texts = [(name, f"{value:.3f} +- {sigma:.3f}", "mm") for name, value, sigma in mm]
        return [*texts, *((name, f"{value:.4f} +- {sigma:.4f}", "deg") for name, value, sigma in deg)]

    def __repr__(self) -> str:
        """Return position and angles with one sigma each, mm and degrees."""
        x, y, z, rz, ry, rx = (f"{name} {value}" for name, value, _ in self._texts())
        return f"PoseEstimate({x}, {y}, {z} mm; {rz}, {ry}, {rx} deg; {len(self.points.ids)} points)"

    def _repr_html_(self) -> str:
        """Return the same as a table, for notebooks."""
        rows = "".join(
            f"<tr><td>{name}</td><td>{value}</td><td>{unit}</td></tr>" for name, value, unit in self._texts()
        )
        foot = f"{len(self.points.ids)} points, {self.reprojection_rms_px:.3f} px RMS"
        return f"<table><tr><th></th><th>value +- sigma</th><th>{foot}</th></tr>{rows}</table>"


@dataclass(frozen=True, eq=False)
class JointCommand(Record):
    """Where the joints are to be, as a board takes it.

    Attributes:
        q_ref: (n,) joint angles to be at when ``duration_s`` has passed, rad.
        qd_ref: (n,) speeds to have there, rad/s.
        gravity_duty: (n,) duty that compensates the gravity load, -1 to 1.
        duration_s: usually the time until the next command; a whole number of the board's ticks.
    """

    q_ref: Array
    qd_ref: Array
    gravity_duty: Array
    duration_s: float


@dataclass(frozen=True, eq=False)
class JointStates(Record):
    """The potentiometers' readings since the last time, oldest first.

    Attributes:
        t_s: (N,) times on the board's clock, s.
        q: (N, n) measured joint angles, rad.
    """

    t_s: Array
    q: Array
