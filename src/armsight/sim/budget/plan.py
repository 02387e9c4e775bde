"""The plan of a rig: what is wished and what there is; it is checked, and its budget is computed.

In: options or a TOML file, and the catalogue of camera classes. Out: a :class:`RigPlan`, and by :func:`planned` the
:class:`~armsight.vision.calibrate.budget.Budget` of it.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields, replace
from functools import cache, cached_property, lru_cache
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np

from armsight.data import Array, Ids
from armsight.errors import InputError
from armsight.files import read_toml
from armsight.geometry.pose import inverse, pose
from armsight.geometry.rotation import exp_so3
from armsight.sim.budget.chart import marker_noise
from armsight.sim.camera.stages import CameraPipeline, Defocus, Lens
from armsight.sim.example_rig import board_poses
from armsight.sim.render.scene import chessboard
from armsight.sim.workcell.body import body_target
from armsight.vision.calibrate.budget import (
    Budget,
    Conditions,
    Gates,
    calibration_covariance,
    gates,
    of_three,
    pose_budget,
    volume_views,
)  # fmt: skip
from armsight.vision.camera import Camera
from armsight.vision.follow.follower import APART_S
from armsight.vision.markers.aprilgrid import AprilGrid
from armsight.vision.markers.board import BOARDS, open_board
from armsight.vision.markers.board_marker import BoardTarget, MountedBoard
from armsight.vision.markers.charuco import Charuco
from armsight.vision.markers.chessboard import Chessboard
from armsight.vision.markers.marker import CalibrationBoard
from armsight.vision.markers.targets import Composite, read_layout
from armsight.vision.pose.predict import PredictedView
from armsight.vision.pose.shutter import LOOSE_PX
from armsight.vision.rig import StereoRig

#: A disc's diameter, a tag's and a square's side in the image below which detection is left to luck, px; half: half of them
#: are lost, double: bodies twice as large are asked for.
_LEAST_PX = {"disc": 8.0, "tag": 24.0, "square": 8.0}
#: Sets of poses of the board, whose mean is taken; half: sigma differs by 10 % by chance, double: half a second more.
_SETS = 3
#: Lengths that a table-top cell has, m: what lies outside is mm given as m.
_LEAST_M, _MOST_M = 0.001, 20.0
_LEAST_APART_M = 0.01  # m; half: endoscopes pass, double: the smallest camera modules are rejected
_MOST_OFF_M = 0.01  # m; what a print may be off; half: sagging boards are rejected, double: mm meant as um pass
#: Shortest focal length that is chosen where none is given, image widths: 80 degrees; half: lenses that bend the image more
#: than the model of five coefficients, double: ordinary volumes are rejected.
_WIDEST = 0.6
_UNITS = {"um": 1e-6, "\u00b5m": 1e-6, "\u03bcm": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0}
_ANGLES = {"deg": math.pi / 180, "\N{DEGREE SIGN}": math.pi / 180, "arcmin": math.pi / 10800, "rad": 1.0}
_NUMBER = r"((?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e-?[0-9]+)?)"
#: What a rig that there is says itself; and, where it says when its rows are exposed.
_OF_RIG = ("image", "baseline", "verging_deg", "focal_widths", "board", "pairs", "board_bent")
_OF_SHUTTERS = ("skew_ms", "start_ms", "readout_ms")
_OF_DEFAULT = ("body_scale", "body_depth")  # of the default body alone
#: Key -> least and most that a plan may say.
_RANGES = {
    "verging_deg": (0.0, 120.0), "focal_widths": (0.2, 20.0), "body_scale": (0.05, 20.0), "body_depth": (0.0, 2.0),
    "pairs": (3, 1000), "refocus_ppm": (0.0, 50000.0),
    "board_print": (0.0, 0.1), "body_size": (0.0, 0.1), "warming_k": (0.0, 100.0), "mount_um_per_k": (0.0, 1000.0),
    "lens_ppm_per_k": (0.0, 10000.0), "skew_ms": (0.0, 1000.0), "start_ms": (0.0, 1000.0), "exposure_ms": (0.001, 1000.0),
    "readout_ms": (0.0, 1000.0), "f_number": (0.5, 64.0), "rate_hz": (0.1, 1000.0), "backlash_deg": (0.0, 10.0),
}  # fmt: skip
#: Standard deviation of the Gaussian nearest to the Airy disc of green light, over the f-number, mm: 0.42 wavelengths.
_AIRY_MM = 0.42 * 550e-6
_OBJECTIVES: dict[str, Callable[[Array], Any]] = {"worst": np.max, "mean": np.mean}
#: What a class of price means, euros for a pair of cameras with lenses.
PRICES = "0 nothing, 1 below 100, 2 to 300, 3 to 800, 4 to 2,000, 5 above, in euros the pair"


@dataclass(frozen=True)
class CameraClass:
    """A class of the catalogue; ``catalogue.toml`` says what its keys mean."""

    name: str
    text: str
    price: int
    preset: str
    image_size_px: tuple[int, int]
    focal_widths: float
    focal_mm: float
    f_number: float
    focus_m: float
    least_focus_m: float
    bytes_px: float
    usb: float
    refocus_ppm: float = 0.0

    @property
    def own_lens(self) -> float:
        """Focal length, image widths, of a webcam, whose lens cannot be exchanged; 0 of the others."""
        return self.focal_widths * (self.focus_m > 0 or self.refocus_ppm > 0)


@cache
def catalogue() -> dict[str, CameraClass]:
    """Return the classes by name."""
    tables = read_toml(Path(__file__).with_name("catalogue.toml"))
    whole = {name: tables.get(values.pop("like", ""), {}) | values for name, values in tables.items()}
    return {
        name: CameraClass(name, **each | {"image_size_px": tuple(each["image_size_px"])})
        for name, each in whole.items()
    }


def length_m(text: str, what: str) -> float:
    """Read a length with its unit: 0.8m, 300mm."""
    return _amounts(what, text, "a length with its unit, such as 0.8m or 300mm", most=1)[0]


def _amounts(what: str, text: str, form: str, per: str = "", most: int = 2) -> tuple[float, float]:
    """Read a length, m, and an angle, rad, in either order, each ``per`` that unit; an angle that is left out is 0."""
    parts, units = [part.strip() for part in text.split(",")], _UNITS | _ANGLES
    found = [re.fullmatch(rf"{_NUMBER}\s*({'|'.join(units)}){per}", part) for part in parts]
    values = {each[2] in _ANGLES: float(each[1]) * units[each[2]] for each in found if each}
    if not len(values) == len(found) <= most or False not in values:
        comma = "; decimals have a point, not a comma" if any(map(str.isdecimal, parts)) and len(parts) > 1 else ""
        alone = "; an angle alone has no length: give one, too" if set(values) == {True} == {*map(bool, found)} else ""
        raise InputError(f"{what} {text!r}: expected {form}{comma}{alone}")
    if what == "want" and not all(values.values()):
        raise InputError(f"{what} {text!r}: no rig measures without error: expected {form}")
    return values[False], values.get(True, 0.0)


def meant(name: str, known: Iterable[str]) -> str:
    """Return the known name that is spelt alike as a question, "" without one."""
    near = difflib.get_close_matches(name, list(known), 1)
    return f": did you mean {near[0]}?" if near else ""


def is_board(body: str) -> bool:
    """Whether a body is a board's spec."""
    return body.partition(":")[0] in BOARDS


def up(value: float) -> str:
    """Return a number with two digits that is not below it."""
    unit = 10 ** (math.floor(math.log10(value)) - 1)
    return f"{math.ceil(value / unit - 1e-9) * unit:.2g}"


def _plain(value: Any, kind: type) -> Any:  # noqa: ANN401
    """Return a path as text, a number of NumPy as Python's, and a whole one as int where that is the kind."""
    value = fspath(value) if isinstance(value, PathLike) else value
    value = value.item() if isinstance(value, np.generic) else value
    return int(value) if kind is int and isinstance(value, float) and value.is_integer() else value


@dataclass(frozen=True)
class RigPlan:
    """A rig that is not built yet, and what it is to measure. Lengths m, angles and shares as the names say."""

    volume: str = "0.4x0.4x0.3m"  #: width x height x depth, as the cameras see it.
    distance: str = "0.8m"  #: from the cameras to its middle.
    distances: str = "0.15m,4m"  #: the least and the largest that `--best` may choose.
    speed: str = "0.3m/s"  #: of the body, and its rate of rotation: 0.3m/s or 0.3m/s,20deg/s.
    want: str = ""  #: what 95 % of the errors are to be within: 0.1mm or 0.1mm,0.05deg; empty: nothing is asked.
    objective: str = "worst"  #: whether the answer is of the worst or of the mean position of the volume.
    camera: str = "webcam-720p"  #: a class of the catalogue.
    preset: str = ""  #: its noise and shutter: a preset of the camera model or a file of one; by default the class's.
    image: str = ""  #: width x height, px; by default the class's.
    f_number: float = 0.0  #: aperture; by default the class's.
    rig: str = ""  #: a rig file, for a rig that there is: its lenses, baseline, calibration and, where known, shutters.
    baseline: str = "200mm"  #: between the cameras.
    verging_deg: float = -1.0  #: angle between their axes; by default both look at the middle of the volume.
    focal_widths: float = 0.0  #: focal length over the image's width; by default the class's.
    #: a body file, or a board such as chessboard:9x6:25mm; by default the body of `armsight demo` with nine discs.
    body: str = ""
    body_scale: float = 1.0  #: by how much the default body is larger; discs grow with it.
    body_depth: float = 1.0  #: by how much further its wings stand behind its plate; beyond 2 the plate hides them.
    board: str = "chessboard:9x6:25mm"  #: the calibration board.
    pairs: int = 20  #: of the board.
    board_print: float = 3e-4  #: standard deviation of its size, as a share.
    board_bent: str = "0.1mm"  #: of its corners from the drawing.
    body_print: str = "0.03mm"  #: of the body's markers from its file along their faces.
    body_bent: str = "0.05mm"  #: out of their faces.
    body_size: float = 3e-4  #: standard deviation of its size, as a share.
    warming_k: float = 3.0  #: change of temperature since the calibration.
    mount_um_per_k: float = 5.0  #: of the cameras' distance.
    lens_ppm_per_k: float = 20.0  #: of the focal length.
    refocus_ppm: float = -1.0  #: of the focal length by an autofocus since the calibration; by default the class's.
    skew_ms: float = -1.0  #: by how much the right exposures are later, uncorrected; by default the preset's.
    start_ms: float = -1.0  #: how far the two exposures begin apart by chance; by default the preset's.
    readout_ms: float = -1.0  #: from the first row to the last, uncorrected; by default the preset's.
    exposure_ms: float = -1.0  #: by default the preset's.
    rate_hz: float = -1.0  #: by default the preset's.
    arm: str = ""  #: for the closed loop; empty: none.
    backlash_deg: float = 0.03  #: standard deviation of each of its joints.
    handeye: str = "0.1mm,0.02deg"  #: of the hand-eye calibration: 0.1mm,0.02deg.
    named: tuple[str, ...] = field(default=(), repr=False)  #: keys that were given
    sets: int = field(default=_SETS, repr=False)  #: of poses of the board

    @staticmethod
    def read(path: str, **given: Any) -> RigPlan:  # noqa: ANN401
        """Read a TOML file whose keys are the attributes, if there is one; ``given`` replaces what it says.

        Raises InputError: an unknown key, or a value of another type; the message names it.
        """
        values = read_toml(path) if path else {}
        for key in {"rig", "body", "preset"} & values.keys():
            value, end = values[key], ".toml" if key == "preset" else ""
            if isinstance(value, str) and value.endswith(end) and not is_board(value):
                values[key] = str(Path(path).parent / value)
        given = values | {key: value for key, value in given.items() if value is not None}
        for key, value in given.items():
            of, kind = f"{path}: " if key in values else "", KEYS.get(key)
            if kind is None:
                raise InputError(f"{of}unknown key {key!r}{meant(key, KEYS)}")
            given[key] = value = _plain(value, kind)
            if not isinstance(value, (int, float) if kind is float else kind) or isinstance(value, bool):
                raise InputError(f"{of}{key} must be {_KINDS[kind]}, got {value!r}")
        plan = RigPlan(**given, named=tuple(given))
        near = float(np.clip(plan.distance_m, *plan.between_m))
        return replace(plan, distance=plan.distance if "distance" in given else f"{near:g}m")

    @cached_property
    def size_m(self) -> Array:
        """(3,) width, height, depth."""
        sides = [side.strip() for side in re.split("[xX]", self.volume)]
        unit = sides[-1].lstrip("0123456789.e- ")  # of the sides that have none
        if len(sides) != 3:
            raise InputError(
                f"volume {self.volume!r}: expected width x height x depth with a unit, such as 0.4x0.4x0.3m"
            )
        each = (side if side[-1:].isalpha() else side + unit for side in sides)
        size = np.array([length_m(side, f"volume {self.volume!r}: side") for side in each])
        for wrong, text in (
            (size.max() > _MOST_M, f": {size.max():g} m is no table-top cell: is it in mm?"),
            (not size.min() > 0, ": each side must be above zero"),
            (self.distance_m <= size[2] / 2,
             f" at {self.distance}: it reaches behind the cameras; a distance above {size[2] / 2:g} m is needed"),
        ):  # fmt: skip
            if wrong:
                raise InputError(f"volume {self.volume}{text}")
        return size

    def _reach_m(self, key: str) -> float:
        """Return a length that a cell may have."""
        found = length_m(getattr(self, key), key)
        if not _LEAST_M <= found <= _MOST_M:
            raise InputError(f"{key} {getattr(self, key)}: expected {_LEAST_M:g} to {_MOST_M:g} m: is the unit right?")
        return found

    @cached_property
    def distance_m(self) -> float:
        """Distance of the middle."""
        return self._reach_m("distance")

    @cached_property
    def between_m(self) -> tuple[float, float]:
        """The least and the largest distance that may be chosen."""
        found = [length_m(each, "distances") for each in self.distances.split(",")]
        if len(found) != 2 or not _LEAST_M <= found[0] <= found[1] <= _MOST_M:
            raise InputError(f"distances {self.distances!r}: expected the least and the largest, such as 0.5m,1.2m")
        if {"distance", "distances"} <= {*self.named} and not found[0] <= self.distance_m <= found[1]:
            raise InputError(f"distance {self.distance}: the distances that may be are {found[0]:g} to {found[1]:g} m")
        return found[0], found[1]

    def left_out(self, key: str) -> bool:
        """Whether a value says that something else, such as the class, decides: it is outside its range, and not named."""
        return key in _RANGES and key not in self.named and getattr(self, key) == getattr(RigPlan, key) <= 0.0

    def overall(self, values: Array) -> float:
        """Return the worst or the mean of values over the volume."""
        return float(_OBJECTIVES[self.objective](values))

    @cached_property
    def existing(self) -> StereoRig | None:
        """The rig that there is."""
        return StereoRig.load(self.rig) if self.rig else None

    @cached_property
    def of_rig(self) -> tuple[str, ...]:
        """Keys whose values the rig that there is has itself."""
        return _OF_RIG * bool(self.existing) + _OF_SHUTTERS * bool(self.existing and self.existing.shutters)

    @cached_property
    def image_size_px(self) -> tuple[int, int]:
        """Width and height."""
        if self.existing:
            return self.existing.left.image_size_px
        given = self.image.strip() or "{}x{}".format(*self.cameras.image_size_px)
        if not (found := re.fullmatch(r"([1-9]\d{2,4})\s*x\s*([1-9]\d{2,4})", given)):
            raise InputError(f"image {self.image!r}: expected width x height in pixels, such as 1280x720")
        return int(found[1]), int(found[2])

    @cached_property
    def baseline_m(self) -> float:
        """Distance of the cameras."""
        if self.existing:
            return self.existing.baseline_m
        if (found := self._reach_m("baseline")) < _LEAST_APART_M:
            least = f"at least {1e3 * _LEAST_APART_M:g} mm"
            raise InputError(f"baseline {self.baseline}: two cameras cannot stand {1e3 * found:g} mm apart: {least}")
        return found

    @cached_property
    def speeds(self) -> tuple[float, float]:
        """m/s and rad/s."""
        found = _amounts("speed", self.speed, "0.3m/s or 0.3m/s,20deg/s", "/s")
        if found[0] > _MOST_M:
            raise InputError(f"speed {self.speed}: faster than {_MOST_M:g} m/s: is it in mm/s?")
        return found

    @cached_property
    def requested(self) -> tuple[float, float] | None:
        """Metres and rad, 0 where it is not asked; None where nothing is."""
        return _amounts("want", self.want, "0.1mm or 0.1mm,0.05deg") if self.want else None

    @cached_property
    def cameras(self) -> CameraClass:
        """The class."""
        if self.camera not in catalogue():
            known = f"{', '.join(catalogue())}{meant(self.camera, catalogue())}"
            raise InputError(f"camera {self.camera!r} is not in the catalogue; known are {known}")
        return catalogue()[self.camera]

    @cached_property
    def focal_px(self) -> float:
        """Focal length; where none is given the class's, or the longest that sees the volume, down to a wide lens."""
        if self.existing:
            return float(np.mean([camera.intrinsics[:2] for camera in self.existing.cameras]))
        width, height = self.image_size_px
        near, body = self.distance_m - self.size_m[2] / 2, np.ptp(self.layout.body.points, axis=0).max()
        sees = 0.97 * near * min(width / (self.size_m[0] + body), height / (self.size_m[1] + body))
        return self.focal_widths * width or min(self.cameras.focal_widths * width, max(sees, _WIDEST * width))

    @property
    def focal_mm(self) -> float:
        """The same in mm, on the sensor of the class."""
        return self.cameras.focal_mm * self.focal_px / (self.image_size_px[0] * self.cameras.focal_widths)

    @cached_property
    def pipeline(self) -> CameraPipeline:
        """The camera's stages, its exposure as planned; light and diffraction by another aperture than the class's."""
        found = CameraPipeline.load(self.preset or self.cameras.preset)
        found = found if self.exposure_ms < 0 else found.exposed_for(1e-3 * self.exposure_ms)
        usual, f = self.cameras.f_number, self.f_number or self.cameras.f_number
        found = replace(
            found, sensor=found.sensor and replace(found.sensor, white_e=(usual / f) ** 2 * found.sensor.white_e)
        )
        if f <= usual:
            return found
        psf_px = math.hypot(found.psf_sigma_px, _AIRY_MM * math.sqrt(f**2 - usual**2) * self.focal_px / self.focal_mm)
        return replace(found, lens=Lens(psf_px))

    @cached_property
    def timing(self) -> dict[str, float]:
        """exposure, readout, skew, start, stamp, s; rate, Hz."""
        t, known = self.pipeline.timing, self.existing and self.existing.shutters
        assert t is not None
        ms = {"exposure": t.exposure_ms, "readout": t.readout_ms, "skew": t.skew_ms,
              "start": t.sync_ms / math.sqrt(3.0), "stamp": t.jitter_ms}  # fmt: skip
        asked = {"skew": self.skew_ms, "start": self.start_ms, "readout": self.readout_ms}
        ms |= {name: given for name, given in asked.items() if given >= 0}
        if known:  # what was measured is corrected: its uncertainty remains
            ms |= dict(zip(("skew", "readout", "start"), 1e3 * np.append(known.sigmas, known.jitter_s), strict=True))
        rate = min(t.rate_hz, self._most_hz) if self.rate_hz < 0 else self.rate_hz
        return {name: 1e-3 * float(value) for name, value in ms.items()} | {"rate": rate}

    @property
    def _most_hz(self) -> float:
        """Rate that one USB controller carries."""
        return self.cameras.usb * 1e6 / (2 * math.prod(self.image_size_px) * self.cameras.bytes_px)

    @cached_property
    def layout(self) -> Composite:
        """The body."""
        if is_board(self.body):
            board = MountedBoard("board", open_board(self.body), np.eye(4), np.array([0.0, 0.0, -1.0]))
            return Composite(self.body, (BoardTarget(self.body, (board,)),))
        of_demo = body_target(self.body_scale, self.body_depth).discs
        return read_layout(self.body) if self.body else Composite("tool_body", (), of_demo)

    @cached_property
    def stereo_rig(self) -> StereoRig:
        """The cameras: those that there are, or verging symmetrically."""
        if self.existing:
            return self.existing
        width, height = size = self.image_size_px
        f, half = self.focal_px, math.atan(self.baseline_m / 2 / self.distance_m)
        half = half if self.verging_deg < 0 else math.radians(self.verging_deg) / 2
        camera = Camera(size, "brown5", np.array([f, f, (width - 1) / 2, (height - 1) / 2]), np.zeros(5))
        right = pose(exp_so3(np.array([0.0, -half, 0.0])), np.array([self.baseline_m / 2, 0.0, 0.0]))
        left = np.diag([-1.0, 1.0, 1.0, 1.0]) @ right @ np.diag([-1.0, 1.0, 1.0, 1.0])  # its mirror image
        count = 2 * camera.parameters.size + 6
        return StereoRig(camera, camera, inverse(left) @ right, np.zeros((count, count)), 0.0)

    @cached_property
    def views(self) -> list[PredictedView]:
        """The body over the volume."""
        return volume_views(self.stereo_rig, self.layout.body.points, self.layout.normals, self.distance_m, self.size_m)

    def marker(self, distance_m: float) -> tuple[str, float]:
        """Return the kind of the body's markers and their least size in the image at a distance, px."""
        layout = self.layout
        if layout.discs is not None:
            kind, size_m = "disc", 2 * float(layout.discs.radii_m.mean())
        elif layout.tags is not None:
            kind, size_m = "tag", min(tag.size_m for tag in layout.tags.tags)
        else:
            assert layout.boards is not None
            kind, size_m = min((_smallest(each.board) for each in layout.boards.boards), key=lambda each: each[1])
        return kind, size_m * self.focal_px / distance_m

    @cached_property
    def marker_of(self) -> Ids:
        """(M,) the number of the marker that each point of the body is of."""
        layout = self.layout
        parts = [4] * len(layout.tags.tags) if layout.tags else []
        parts += [len(each.board.body.points) for each in layout.boards.boards] if layout.boards else []
        parts += [1] * layout.disc_count
        return np.repeat(np.arange(len(parts)), parts)

    @property
    def apart(self) -> bool:
        """Whether the exposures are so far apart that `run` and `live` search with a wider epipolar gate."""
        return max(self.timing["skew"], self.timing["start"]) > APART_S

    def defocus_px(self, distance_m: float) -> float:
        """Return the radius of the blur away from the lens's focus, px: aperture times the difference of dioptres."""
        c, focus = self.cameras, self.cameras.focus_m or self.distance_m
        return 5e-4 * c.focal_mm / (self.f_number or c.f_number) * self.focal_px * abs(1 / focus - 1 / distance_m)

    def check(self) -> None:
        """Refuse what cannot be built.

        Raises InputError: one line: what was found, what was expected, and the nearest that can be had.
        """
        for key, (least, most) in _RANGES.items():
            value = getattr(self, key)
            if not (least <= value <= most or self.left_out(key)):
                raise InputError(f"{key} is {value}: expected {least:g} to {most:g}")
            if key in _OF_DEFAULT and self.body and value != 1.0:
                raise InputError(f"{key} is {value:g}: it is of the default body, not of {self.body}")
        if own := [key for key in self.named if key in self.of_rig]:
            raise InputError(f"{self.rig} has its own {', '.join(own)}: leave out what it says itself")
        c, size, t, _, _ = self.cameras, self.size_m, self.timing, self.speeds, self.requested
        near, far = self.distance_m - size[2] / 2, self.distance_m + size[2] / 2
        _, _ = _amounts("handeye", self.handeye, "0.1mm,0.02deg"), self.between_m
        (width, height), body = self.image_size_px, np.ptp(self.layout.body.points, axis=0).max()
        (kind, px), lost = self.marker(far), sum(len(one.paired) < 3 for one in self.views)
        larger = up(_LEAST_PX[kind] / px)
        scaled = "" if self.body else f" (body_scale = {up(self.body_scale * _LEAST_PX[kind] / px)})"
        needed, seen = size[:2] + body, near * np.array([width, height]) / self.focal_px
        k = int(np.argmax(needed / seen))  # across or up
        for wrong, text in (
            (self.objective not in _OBJECTIVES, f"objective {self.objective!r}: expected {' or '.join(_OBJECTIVES)}"),
            *((length_m(getattr(self, name), name) > _MOST_OFF_M,
               f"{name} is {getattr(self, name)}: no print is off by more than {1e3 * _MOST_OFF_M:g} mm")
              for name in ("board_bent", "body_print", "body_bent")),
            (near < c.least_focus_m,
             f"the lens of {c.name} does not focus nearer than {c.least_focus_m:g} m, the volume begins at {near:.2g} m: "
             f"a distance of {up(c.least_focus_m + size[2] / 2)} m can be had"),
            (t["exposure"] > 1 / t["rate"],
             f"an exposure of {1e3 * t['exposure']:g} ms is longer than a frame at {t['rate']:g} Hz: at most "
             f"{1e3 / t['rate']:.3g} ms, or {1 / t['exposure']:.3g} Hz"),
            (t["rate"] > 1.001 * self._most_hz,
             f"one USB controller carries two {c.name} at {self._most_hz:.3g} Hz at most, {t['rate']:g} Hz were asked: "
             "a lower rate_hz, or a controller each"),
            (self.baseline_m > 2 * self.distance_m,
             f"a baseline of {self.baseline_m:g} m: the arm would cross it; at most {2 * self.distance_m:g} m"),
            (self.existing is None and needed[k] > seen[k],
             f"the field of view is {seen[k]:.2g} m {('wide', 'high')[k]} at {near:.2g} m, volume and body are "
             f"{needed[k]:.2g} m: a distance of {up(needed[k] / seen[k] * near + size[2] / 2)} m, or focal_widths = "
             f"{seen[k] / needed[k] * self.focal_px / width:.2g}"
             + int(seen[k] > body + 0.01)
             * f", or a volume {1e-2 * int(1e2 * (seen[k] - body)):.2g} m {('wide', 'high')[k]}"),
            (px < _LEAST_PX[kind],
             f"a {kind} is {px:.1f} px at {far:.2g} m, at least {_LEAST_PX[kind]:g} are needed: markers {larger} times as "
             f"large{scaled}"),
            (lost > 0,
             f"at {lost} of {len(self.views)} positions the cameras do not both see the body, they look past each other: "
             f"verging_deg = {math.degrees(2 * math.atan(self.baseline_m / 2 / self.distance_m)):.3g} or less baseline"),
        ):  # fmt: skip
            if wrong:
                raise InputError(text)

    def _noise_px(self) -> dict[str, float]:
        """Return what pixel noise and blur add to a marker's position in the middle, and defocus at both ends, RMS."""
        kind, px = self.marker(self.distance_m)
        # The way in the image is the lateral part of a motion in any direction.
        way = self.speeds[0] * math.sqrt(2 / 3) * self.timing["exposure"] * self.focal_px / self.distance_m
        sharp, soft = marker_noise(self.pipeline, kind, px) ** 2, 0.0
        for distance in self.distance_m + self.size_m[2] / 2 * np.array([-1.0, 1.0]):
            if radius := round(self.defocus_px(float(distance))):
                blurred = replace(self.pipeline, defocus=Defocus(radius))
                soft += max(marker_noise(blurred, kind, px) ** 2 - sharp, 0.0) / 2
        changing = replace(self.pipeline, temporal_denoise=None) if way else self.pipeline  # it has nothing to mix
        moved = max(marker_noise(changing, kind, px, way) ** 2 - sharp, 0.0)
        return {"pixel noise": math.sqrt(sharp), "defocus": math.sqrt(soft), "exposure blur": math.sqrt(moved)}

    @cached_property
    def known(self) -> Conditions:
        """Return what is not known but for markers' noise, calibration and gates, which take longest to compute."""
        t, (speed, rotation) = self.timing, self.speeds
        arm, handeye = (0.0, 0.0), (0.0, 0.0)
        if self.arm:
            from armsight.robot.arm_file import open_arm  # not above: only the loop needs it

            model, handeye = open_arm(self.arm), _amounts("handeye", self.handeye, "0.1mm,0.02deg")
            square = math.radians(self.backlash_deg) ** 2 / 3 * (model.jacobian(model.home) ** 2).sum(axis=1)
            arm = math.sqrt(square[:3].sum()), math.sqrt(square[3:].sum())
        bent = length_m(self.body_print, "body_print"), length_m(self.body_bent, "body_bent")
        mount, lens = (1e-6 * each * self.warming_k for each in (self.mount_um_per_k, self.lens_ppm_per_k))
        refocus = 1e-6 * (self.cameras.refocus_ppm if self.refocus_ppm < 0 else self.refocus_ppm)
        return Conditions(
            board_scale=self.board_print, marker=self.marker_of, body_sigma_m=bent, body_scale=self.body_size,
            mount_m=mount, lens_share=lens, refocus_share=refocus, skew_s=t["skew"], start_s=t["start"],
            readout_s=t["readout"], stamp_s=t["stamp"], speed_m_s=speed, rotation_rad_s=rotation, handeye=handeye, arm=arm,
        )  # fmt: skip

    @cached_property
    def conditions(self) -> Conditions:
        """Return what is not known."""
        t, noise, gate, cov = self.timing, self._noise_px(), Gates(), np.zeros((0, 0))
        if self.existing:
            cov = self.existing.cov
        else:
            keys = "camera", "preset", "image", "f_number", "baseline", "board", "pairs", "board_bent", "sets"
            kept = {key: getattr(self, key) for key in keys}
            widths, angle = self.focal_px / self.image_size_px[0], self.stereo_rig.convergence_deg
            cov = _calibrated(RigPlan(focal_widths=widths, verging_deg=angle, **kept))
        if self.apart:  # as `run` and `live` search
            loose, moved_m = replace(self.stereo_rig, cov=cov, sigma_px=LOOSE_PX), math.hypot(t["skew"], t["start"])
            moved_m *= self.speeds[0] / math.sqrt(3)
            gate = gates(loose, self.layout, self.views[len(self.views) // 2], math.hypot(*noise.values()), moved_m)
        return replace(self.known, noise_px=noise, cov_calibration=cov, gate=gate)


#: Key -> its type: what a plan may say; and types in words.
KEYS: dict[str, Any] = {each.name: type(each.default) for each in fields(RigPlan) if each.name not in ("named", "sets")}
_KINDS = {str: "a text", int: "a whole number", float: "a number"}


def _smallest(board: CalibrationBoard) -> tuple[str, float]:
    """Return the kind of a board's markers, and the side of one, m."""
    if isinstance(board, AprilGrid):
        return "tag", board.tag_m
    if not isinstance(board, (Chessboard, Charuco)):
        have = "chessboards, ChArUco boards and aprilgrids have a budget, boards of discs none"
        raise InputError(f"{board.body.name}: {have}")
    return "square", board.square_m


@lru_cache(maxsize=64)
def _calibrated(plan: RigPlan) -> Array:
    """Return the covariance (P, P) of what boards that are held still determine, at the camera's own exposure."""
    board = open_board(plan.board)
    kind, size_m = _smallest(board)
    columns, rows = (int(n) for n in np.rint(np.ptp(board.body.points, axis=0)[:2] / size_m) + 1)
    rig, pattern = plan.stereo_rig, chessboard(columns, rows, size_m)
    sets = [board_poses(np.random.default_rng(seed), rig, pattern, plan.pairs) for seed in range(plan.sets)]
    away_m, least_px = float(np.median(np.concatenate(sets)[:, 2, 3])), _LEAST_PX[kind]
    if away_m > _MOST_M:
        raise InputError(
            f"{plan.board} fills the images at {away_m:.0f} m: expected at most {_MOST_M:g} m: is the unit right?"
        )
    if (px := size_m * plan.focal_px / away_m) < least_px:
        raise InputError(f"a {kind} of {plan.board} is {px:.1f} px, at least {least_px:g} are needed")
    sigma, bent_m = marker_noise(plan.pipeline, kind, px), length_m(plan.board_bent, "board_bent")
    covs = [calibration_covariance(rig, board.body.points, Ts, sigma, bent_m) for Ts in sets]
    return np.asarray(np.mean(covs, axis=0))


def planned(plan: RigPlan, cameras: int = 2, *, known: bool = False) -> Budget:
    """Return the budget of a plan: of its two cameras, of the left one alone, or of three in an equilateral triangle.

    ``known``: of what :attr:`RigPlan.known` says alone.
    """
    plan.check()
    layout, given, rig = plan.layout, plan.known if known else plan.conditions, plan.stereo_rig
    points, normals = layout.body.points, layout.normals

    def of(pair: int | None) -> Budget:
        views = plan.views if pair is None else volume_views(rig, points, normals, plan.distance_m, plan.size_m, pair)
        return pose_budget(rig, points, normals, [replace(one, seen=one.seen[:, :cameras]) for one in views], given)

    return of_three([of(pair) for pair in range(3)], rig, given.board_scale) if cameras == 3 else of(None)
