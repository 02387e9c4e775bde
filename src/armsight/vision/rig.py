"""StereoRig: two calibrated cameras, their relative pose, and how well all of it is known; load and save.

A rig file is one JSON, described in docs/reference/rig_file.md. Nothing is written before everything is checked, and a
file is replaced in one step, so an interrupted save leaves the old one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.files import parsed_json, read_text, require_version, write_text
from armsight.geometry.check import RIGID, checked, off_rotation
from armsight.geometry.pose import exp_se3, inverse, transform
from armsight.vision.camera import DISTORTION_MODELS, Camera

if TYPE_CHECKING:
    from armsight.vision.rectify import Rectification

FORMAT = "armsight-rig"
VERSION = 1
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
#: In the provenance of a rig that must not be used: by how much held-out pairs contradict it, px.
CONTRADICTED = "contradicted_by_px"
#: How far a covariance may be from symmetric, as a share of the two standard deviations.
_SYMMETRY_TOLERANCE = 1e-5
TANGENT = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")


@dataclass(frozen=True, eq=False)
class Shutters(Record):
    """When the rows of two cameras are exposed."""

    #: by how much the middle row of the right camera is later than that of the left, s, beyond the stamps
    skew_s: float
    #: of all rows, s, in both cameras: a row begins by its H-th part later than the one above; 0 is a global shutter
    readout_s: float
    cov: Array  #: (2, 2) covariance of both, s^2; zero where given and not estimated
    jitter_s: float = 0.0  #: standard deviation by which the skew of a shot differs from the mean, s, beyond the stamps

    def __post_init__(self) -> None:
        """Check that times are finite and the covariance is one."""
        super().__post_init__()
        times = self.skew_s, self.readout_s, self.jitter_s
        if not (np.isfinite(times).all() and min(times[1:]) >= 0):
            raise InputError(
                "skew, readout and jitter must be finite times, readout and jitter not below zero, got "
                + ", ".join(f"{t:g} s" for t in times)
            )
        checked(self.cov, (2, 2), "covariance of skew and readout")
        _check_covariance(self.cov, ("skew_s", "readout_s"))

    def __str__(self) -> str:
        """Return both in ms with their sigmas, for people."""
        skew, readout = (f" ± {1e3 * s:.2g}" if s > 0 else "" for s in self.sigmas)
        late = "right" if self.skew_s >= 0 else "left"
        rolling = f", readout {1e3 * self.readout_s:.2f}{readout} ms" if self.readout_s or readout else ""
        jitter = f", {1e3 * self.jitter_s:.2f} ms RMS from shot to shot" if self.jitter_s else ""
        return f"skew {1e3 * abs(self.skew_s):.2f}{skew} ms ({late} later){jitter}{rolling}"

    def to_json(self) -> dict[str, Any]:
        """Return the object that rig files and ``measure --json`` have."""
        return {
            "skew_s": self.skew_s,
            "readout_s": self.readout_s,
            "covariance_s2": self.cov.tolist(),
            "jitter_s": self.jitter_s,
        }

    @property
    def sigmas(self) -> Array:
        """(2,) standard deviations of skew and readout, s."""
        return np.sqrt(np.diag(self.cov))


@dataclass(frozen=True, eq=False)
class CameraNoise(Record):
    """What one image of a camera says too little of: how far the centres of discs are off, over what the image says."""

    variance_factor: float  #: squared errors of discs' centres over their variances by the image's own noise
    freedom: float  #: degrees of freedom it was measured with; its relative sigma is sqrt(2 / freedom)

    def __post_init__(self) -> None:
        """Check that both are positive and finite."""
        super().__post_init__()
        for name, value in (("variance_factor", self.variance_factor), ("freedom", self.freedom)):
            if not 0 < value < np.inf:
                raise InputError(f"{name} of a camera's disc noise must be a positive number, got {value}")

    def to_json(self) -> dict[str, float]:
        """Return the object that rig files and ``rig show --json`` have."""
        return {"variance_factor": self.variance_factor, "freedom": self.freedom}

    def __str__(self) -> str:
        """Return the factor with its sigma, for people."""
        return f"{self.variance_factor:.2f} ± {self.variance_factor * np.sqrt(2 / self.freedom):.2f}"


@dataclass(frozen=True, eq=False)
class StereoRig(Record):
    """Two cameras that see the same volume."""

    left: Camera  #: the left camera; its frame is the rig's
    right: Camera  #: the right camera
    T_left_right: Array  #: (4, 4) pose of the right camera in the left one's frame, m
    #: (P, P) covariance of the rig's parameters: left intrinsics and distortion, right intrinsics and distortion, and
    #: the tangent [translation m; rotation rad] of T_left_right (perturbation on the right). Zero where a parameter was
    #: given and not estimated
    cov: Array
    sigma_px: float  #: standard deviation of a detection beyond the image's own covariance, px: from the calibration
    provenance: Mapping[str, Any] = field(default_factory=dict)  #: where the rig comes from: command, data, versions
    shutters: Shutters | None = None  #: when the rows of both cameras are exposed; None where it is unknown
    #: of the left and of the right camera; None where it was not measured
    disc_noise: tuple[CameraNoise, CameraNoise] | None = None

    def __post_init__(self) -> None:
        """Check shapes and the rotation."""
        super().__post_init__()
        checked(self.T_left_right, (4, 4), "T_left_right")
        R = self.T_left_right[:3, :3]
        if off_rotation(R) > RIGID or np.linalg.det(R) < 0:
            raise InputError("T_left_right must hold a rotation: its upper left 3x3 block is not orthonormal")
        if np.abs(self.T_left_right[3] - [0, 0, 0, 1]).max() > RIGID:
            raise InputError(f"the last row of T_left_right must be 0 0 0 1, got {_row(self.T_left_right[3])}")
        checked(self.cov, (self.parameter_count, self.parameter_count), "rig covariance")
        _check_covariance(self.cov, self.parameter_names)
        if not np.linalg.norm(self.T_left_right[:3, 3]) > 0:
            raise InputError("T_left_right has no translation: two cameras at one position measure no distance")
        if not 0 <= self.sigma_px < np.inf:
            raise InputError(f"sigma_px must be a finite number not below zero, got {self.sigma_px}")

    def __repr__(self) -> str:
        """Return the rig in one line."""
        between = f"baseline {1e3 * self.baseline_m:.6g} mm, convergence {self.convergence_deg:.4g} deg"
        return f"StereoRig(left={self.left!r}, right={self.right!r}, {between}, sigma_px={self.sigma_px:.6g})"

    @property
    def cameras(self) -> tuple[Camera, Camera]:
        """Left and right."""
        return self.left, self.right

    def project(self, p_left: Array) -> tuple[Array, Array]:
        """Return points (..., 3), m, left camera's frame, as both cameras see them: (..., 2) raw pixels each."""
        return self.left.project(p_left), self.right.project(transform(inverse(self.T_left_right), p_left))

    def cov_with(self, common: Array) -> Array:
        """Return the covariance (P, P) of the rig's parameters as an image shows them.

        What moves all points of an image by c + k x is another principal point and focal length.

        ``common``: (2, 2, 3) of each camera, as :class:`~armsight.data.Correspondences` have it.
        """
        cov = np.array(self.cov)
        for first, camera, shifts in zip((0, 4 + len(self.left.distortion)), self.cameras, common, strict=True):
            by = shifts[:, 2:] * camera.intrinsics
            by[:, 2:] += shifts[:, :2]
            cov[first : first + 4, first : first + 4] += by.T @ by
        return cov

    @property
    def disc_variance_factors(self) -> tuple[float, float]:
        """By which the variances of discs' centres in left and right images are multiplied; 1 where it is unknown.

        At least one: residuals do not have what all discs of an image share, and cannot show that a variance is too large.
        """
        if self.disc_noise is None:
            return 1.0, 1.0
        left, right = self.disc_noise
        return max(left.variance_factor, 1.0), max(right.variance_factor, 1.0)

    @property
    def parameter_count(self) -> int:
        """P, the length of the parameter vector."""
        return self.left.parameters.size + self.right.parameters.size + 6

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """P names with units, in the order of ``cov``."""
        names: list[str] = []
        for side, camera in zip(("left", "right"), self.cameras, strict=True):
            coefficients = ("k1", "k2", "k3", "k4") if camera.model == "fisheye" else COEFFICIENTS
            names += [
                f"{side}.{n}" for n in ("fx_px", "fy_px", "cx_px", "cy_px", *coefficients[: camera.distortion.size])
            ]
        return (*names, *(f"T_left_right.{n}" for n in TANGENT))

    @property
    def baseline_m(self) -> float:
        """Distance between the two projection centres, m."""
        return float(np.linalg.norm(self.T_left_right[:3, 3]))

    @property
    def baseline_sigma_m(self) -> float:
        """Standard deviation of the baseline, m; 0 where the rig's uncertainty is unknown."""
        along = self.T_left_right[:3, :3].T @ self.T_left_right[:3, 3] / max(self.baseline_m, 1e-12)
        return float(np.sqrt(max(float(along @ self.cov[-6:-3, -6:-3] @ along), 0.0)))

    @property
    def convergence_deg(self) -> float:
        """Angle between the two optical axes, degrees."""
        return float(np.degrees(np.arccos(np.clip(self.T_left_right[2, 2], -1, 1))))

    def perturbed(self, delta: Array) -> StereoRig:
        """Return the rig moved by ``delta`` (P,) along its parameter vector; covariance and the rest unchanged."""
        n_left, n = self.left.parameters.size, self.parameter_count - 6
        return replace(
            self,
            left=self.left.with_parameters(self.left.parameters + delta[:n_left]),
            right=self.right.with_parameters(self.right.parameters + delta[n_left:n]),
            T_left_right=self.T_left_right @ exp_se3(delta[n:]),
        )

    def triangulate(self, uv_left: Array, uv_right: Array) -> Array:
        """Return the points (N, 3), m, left camera's frame, that both cameras see at raw pixels (N, 2) each.

        NaN where two rays do not meet before both cameras.

        Raises InputError: not as many pixels of both cameras, or not two numbers each.
        """
        from armsight.vision.triangulate import optimal_points

        shapes = [np.shape(each) for each in (uv_left, uv_right)]
        if shapes[0] != shapes[1] or shapes[0][1:] != (2,):
            raise InputError(
                f"uv_left and uv_right have shapes {shapes[0]} and {shapes[1]}: (N, 2) pixels each are needed"
            )
        uv = np.stack([uv_left, uv_right], axis=1).astype(float)
        return optimal_points(self, uv, np.tile(np.eye(2), (len(uv), 2, 1, 1)))[0]

    def rectify(self) -> Rectification:
        """Return the rectification of the rig's images; see :func:`~armsight.vision.rectify.rectify`."""
        from armsight.vision.rectify import rectify

        return rectify(self)

    def save(self, path: str | Path) -> None:
        """Write the rig as JSON, in one step. Raises InputError: the file cannot be written."""
        write_text(path, self.to_text())

    def to_text(self) -> str:
        """Return the rig as the JSON of a rig file."""
        cameras = {
            side: {
                "image_size_px": list(camera.image_size_px),
                "distortion_model": camera.model,
                "intrinsics_px": dict(zip(("fx", "fy", "cx", "cy"), camera.intrinsics.tolist(), strict=True)),
                "distortion": camera.distortion.tolist(),
            }
            for side, camera in zip(("left", "right"), self.cameras, strict=True)
        }
        document: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            **cameras,
            "T_left_right_m": self.T_left_right.tolist(),
            "sigma_px": self.sigma_px,
            "parameters": list(self.parameter_names),
            "covariance": self.cov.tolist(),
            "provenance": dict(self.provenance),
        }
        if self.shutters is not None:
            document["shutters"] = self.shutters.to_json()
        if self.disc_noise is not None:
            left, right = self.disc_noise
            document["disc_noise"] = {"left": left.to_json(), "right": right.to_json()}
        return json.dumps(document, indent=1) + "\n"

    @staticmethod
    def load(path: str | Path) -> StereoRig:
        """Read a rig file.

        Raises InputError: missing, not a rig, of a newer version, or inconsistent; the message names the file.
        """
        return StereoRig.from_text(read_text(path), path)

    @staticmethod
    def load_trusted(path: str | Path) -> StereoRig:
        """Return the rig of a file to measure with.

        Raises InputError: as :meth:`load`, or its calibration said that its images contradict each other.
        """
        rig = StereoRig.load(path)
        if (by_px := rig.provenance.get(CONTRADICTED)) is not None:
            raise InputError(
                f"{path}: the images that it was calibrated from contradict each other by {by_px} px:"
                " calibrate again as armsight calibrate advised"
            )
        return rig

    @staticmethod
    def from_text(text: str, path: str | Path) -> StereoRig:
        """Return the rig of a rig file's text; ``path`` is where it comes from, for messages.

        Raises InputError: not a rig, of a newer version, or inconsistent; the message names the file.
        """
        document = _document(text, path)
        try:
            left, right = (_camera(document[side]) for side in ("left", "right"))
            count = left.parameters.size + right.parameters.size + 6
            return StereoRig(
                left,
                right,
                checked(document["T_left_right_m"], (4, 4), "T_left_right_m"),
                checked(document["covariance"], (count, count), "covariance"),
                float(document["sigma_px"]),
                _provenance(document),
                _shutters(document.get("shutters")),
                _disc_noise(document.get("disc_noise")),
            )
        except KeyError as error:
            raise InputError(f"{path}: the rig file has no {error.args[0]!r}") from None
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"{path}: damaged rig file: {error}") from None
        except InputError as error:
            raise InputError(f"{path}: {error}") from None


def _row(numbers: Array) -> str:
    return " ".join(f"{n:g}" for n in numbers)


def _check_covariance(cov: Array, names: tuple[str, ...]) -> None:
    """Reject what cannot be a covariance (P, P) of the named parameters: negative variances, or no symmetry."""
    variance = np.diag(cov)
    if (variance < 0).any():
        raise InputError(f"rig covariance: the variance of {names[int(np.argmin(variance))]} is negative")
    sigma = np.sqrt(variance)
    off = np.abs(cov - cov.T) > _SYMMETRY_TOLERANCE * np.outer(sigma, sigma)
    if off.any():
        i, j = np.argwhere(off)[0]
        raise InputError(
            f"rig covariance is not symmetric: {names[i]} with {names[j]} is {cov[i, j]:g} and {cov[j, i]:g}"
        )


def _document(text: str, path: str | Path) -> dict[str, Any]:
    """Return the JSON object of a rig file of a version this program knows."""
    document = parsed_json(text, path, "a rig file")
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InputError(f'{path}: not a rig file: expected "format": "{FORMAT}"; `armsight calibrate` writes one')
    version = document.get("version")
    if isinstance(version, str):
        raise InputError(f"{path}: rig file version must be a number, got the text {json.dumps(version)}")
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise InputError(f"{path}: rig file version must be a positive whole number, got {json.dumps(version)[:40]}")
    require_version(path, "rig file", version, VERSION)
    return document


def _provenance(document: dict[str, Any]) -> dict[str, Any]:
    provenance = document.get("provenance", {})
    if not isinstance(provenance, dict):
        raise InputError(f"provenance must be an object of names and values, got {json.dumps(provenance)[:40]}")
    return provenance


def _shutters(entry: dict[str, Any] | None) -> Shutters | None:
    """Build what a rig file says of its shutters, if it does."""
    if entry is None:
        return None
    cov = checked(entry["covariance_s2"], (2, 2), "covariance_s2 of shutters")
    return Shutters(float(entry["skew_s"]), float(entry["readout_s"]), cov, float(entry.get("jitter_s", 0.0)))


def _of(entry: object, key: str) -> object:
    """Return what a JSON object has under a key; None where it is no object, or has none."""
    return entry.get(key) if isinstance(entry, dict) else None


def _disc_noise(entry: object) -> tuple[CameraNoise, CameraNoise] | None:
    """Build what a rig file says of the noise of its cameras' discs, if it does."""
    if entry is None:
        return None
    given = [_of(_of(entry, side), key) for side in ("left", "right") for key in ("variance_factor", "freedom")]
    numbers = [float(x) for x in given if isinstance(x, int | float) and not isinstance(x, bool)]
    if len(numbers) != len(given):
        raise InputError("disc_noise: expected left and right, each with the numbers variance_factor and freedom")
    left, right = CameraNoise(*numbers[:2]), CameraNoise(*numbers[2:])
    return left, right


def _camera(entry: dict[str, Any]) -> Camera:
    model = str(entry["distortion_model"])
    size = checked(entry["image_size_px"], (2,), "image_size_px")
    if not ((size >= 1) & (size == size.round())).all():
        raise InputError(f"image_size_px must be two positive whole numbers, width and height, got {_row(size)}")
    return Camera(
        (int(size[0]), int(size[1])),
        model,
        np.array([float(entry["intrinsics_px"][key]) for key in ("fx", "fy", "cx", "cy")]),
        checked(entry["distortion"], (DISTORTION_MODELS.get(model),), "distortion").reshape(-1),
    )
