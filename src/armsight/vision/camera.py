"""One camera: project, unproject, distortion, and their Jacobians.

Points in the camera's frame (+X right, +Y down, +Z forward) go to raw pixels and back. Brown-Conrady in OpenCV's order
and rational form (Brown 1966; Claus and Fitzgibbon 2005) and Kannala-Brandt's equidistant fisheye (PAMI 28(8), 2006,
as in OpenCV's ``fisheye``). All derivatives are analytic.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.kernels import kernel

#: Distortion models and how many coefficients each has. Brown's are k1 k2 p1 p2 [k3 [k4 k5 k6]], fisheye's k1..k4.
DISTORTION_MODELS = {"none": 0, "brown4": 4, "brown5": 5, "brown8": 8, "fisheye": 4}

_NEWTON_STEPS = 30
_CONVERGED = 1e-12  # Newton's last step, in focal lengths; the error is its square by then
#: A fisheye sees all around but straight backwards: within this angle of that direction a point has no image, rad.
_STRAIGHT_BACK = 1e-9


@kernel
def distort(fisheye: bool, d: Array, p: Array, xy: Array, J_p: Array, J_d: Array) -> None:
    """Distort one point p (3,) of the camera's frame into xy (2,), with Jacobians J_p (2, 3) and J_d (2, 8)."""
    J_d[:, :] = 0.0
    if fisheye:
        rho2 = p[0] * p[0] + p[1] * p[1]
        rho = np.sqrt(rho2)
        n2 = rho2 + p[2] * p[2]
        th = np.arctan2(rho, p[2])
        t2 = th * th
        poly = 1.0 + t2 * (d[0] + t2 * (d[1] + t2 * (d[2] + t2 * d[3])))
        dpoly = 1.0 + t2 * (3 * d[0] + t2 * (5 * d[1] + t2 * (7 * d[2] + t2 * 9 * d[3])))
        if rho < 1e-9 * p[2]:
            s = 1.0 / p[2]
            ds_rho, ds_z = 0.0, -s * s
        else:
            s = th * poly / rho
            ds_rho = (dpoly * p[2] / n2 - s) / rho
            ds_z = -dpoly / n2
        for i in range(2):
            xy[i] = s * p[i]
            for j in range(2):
                J_p[i, j] = p[i] * ds_rho * p[j] / rho if rho > 0.0 else 0.0
            J_p[i, i] += s
            J_p[i, 2] = p[i] * ds_z
            power = th * t2
            for j in range(4):
                J_d[i, j] = power * (p[i] / rho if rho > 0.0 else 0.0)
                power *= t2
        return
    iz = 1.0 / p[2]
    x, y = p[0] * iz, p[1] * iz
    r2 = x * x + y * y
    num = 1.0 + r2 * (d[0] + r2 * (d[1] + r2 * d[4]))
    iden = 1.0 / (1.0 + r2 * (d[5] + r2 * (d[6] + r2 * d[7])))
    g = num * iden
    dg = (d[0] + r2 * (2 * d[1] + r2 * 3 * d[4]) - g * (d[5] + r2 * (2 * d[6] + r2 * 3 * d[7]))) * iden
    xy[0] = x * g + 2 * d[2] * x * y + d[3] * (r2 + 2 * x * x)
    xy[1] = y * g + d[2] * (r2 + 2 * y * y) + 2 * d[3] * x * y
    xx = g + 2 * x * x * dg + 2 * d[2] * y + 6 * d[3] * x
    xy_ = 2 * x * y * dg + 2 * d[2] * x + 2 * d[3] * y
    yy = g + 2 * y * y * dg + 6 * d[2] * y + 2 * d[3] * x
    J_p[0, 0], J_p[0, 1], J_p[0, 2] = xx * iz, xy_ * iz, -(xx * x + xy_ * y) * iz
    J_p[1, 0], J_p[1, 1], J_p[1, 2] = xy_ * iz, yy * iz, -(xy_ * x + yy * y) * iz
    for i in range(2):
        v = (x if i == 0 else y) * iden
        J_d[i, 0], J_d[i, 1], J_d[i, 4] = v * r2, v * r2 * r2, v * r2 * r2 * r2
        J_d[i, 5], J_d[i, 6], J_d[i, 7] = -g * v * r2, -g * v * r2 * r2, -g * v * r2 * r2 * r2
    J_d[0, 2], J_d[0, 3] = 2 * x * y, r2 + 2 * x * x
    J_d[1, 2], J_d[1, 3] = r2 + 2 * y * y, 2 * x * y


@kernel("b1, const f8[::1], const f8[::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1]")
def _project(fisheye: bool, k: Array, d: Array, p: Array, uv: Array, J_p: Array, J_k: Array) -> None:
    """Project points p (N, 3) into uv (N, 2) with J_p (N, 2, 3) and J_k (N, 2, 12): fx fy cx cy and eight coefficients.

    Points that are not in front of a Brown camera, or straight behind a fisheye, become NaN.
    """
    xy = np.empty(2)
    for n in range(p.shape[0]):
        if p[n, 2] <= 0.0 and not (fisheye and np.hypot(p[n, 0], p[n, 1]) > -_STRAIGHT_BACK * p[n, 2]):
            uv[n] = np.nan
            J_p[n] = np.nan
            J_k[n] = np.nan
            continue
        distort(fisheye, d, p[n], xy, J_p[n], J_k[n, :, 4:])
        for i in range(2):
            uv[n, i] = k[i] * xy[i] + k[2 + i]
            for j in range(3):
                J_p[n, i, j] *= k[i]
            for j in range(4, 12):
                J_k[n, i, j] *= k[i]
            for j in range(4):
                J_k[n, i, j] = 0.0
            J_k[n, i, i] = xy[i]
            J_k[n, i, 2 + i] = 1.0


@kernel("b1, const f8[::1], const f8[::1], const f8[:, ::1], f8[:, ::1]")
def _unproject(fisheye: bool, k: Array, d: Array, uv: Array, rays: Array) -> None:
    """Convert raw pixels uv (N, 2) to unit rays (N, 3) by Newton's method; NaN where the distortion has no inverse."""
    xy, J_p, J_d = np.empty(2), np.empty((2, 3)), np.empty((2, 8))
    for n in range(uv.shape[0]):
        u, v = (uv[n, 0] - k[2]) / k[0], (uv[n, 1] - k[3]) / k[1]
        ray = rays[n]
        if fisheye:
            radius = np.sqrt(u * u + v * v)
            th = min(radius, 3.1)
            done = False
            for _ in range(_NEWTON_STEPS):
                t2 = th * th
                f = th * (1.0 + t2 * (d[0] + t2 * (d[1] + t2 * (d[2] + t2 * d[3])))) - radius
                df = 1.0 + t2 * (3 * d[0] + t2 * (5 * d[1] + t2 * (7 * d[2] + t2 * 9 * d[3])))
                step = f / df
                th -= step
                if step * step < _CONVERGED * _CONVERGED:
                    done = df > 0.0 and 0.0 <= th < np.pi
                    break
            s = np.sin(th) / radius if radius > 0.0 else 1.0
            ray[0], ray[1], ray[2] = (s * u, s * v, np.cos(th)) if done else (np.nan, np.nan, np.nan)
            continue
        ray[0], ray[1], ray[2] = u, v, 1.0
        done = False
        for _ in range(_NEWTON_STEPS):
            distort(False, d, ray, xy, J_p, J_d)
            ex, ey = u - xy[0], v - xy[1]
            det = J_p[0, 0] * J_p[1, 1] - J_p[0, 1] * J_p[1, 0]
            dx = (J_p[1, 1] * ex - J_p[0, 1] * ey) / det
            dy = (J_p[0, 0] * ey - J_p[1, 0] * ex) / det
            ray[0] += dx
            ray[1] += dy
            if dx * dx + dy * dy < _CONVERGED * _CONVERGED:
                done = det > 0.0 and J_p[0, 0] > 0.0
                break
        norm = np.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + 1.0)
        for i in range(3):
            ray[i] = ray[i] / norm if done else np.nan


@dataclass(frozen=True, eq=False)
class Camera(Record):
    """A calibrated camera.

    Attributes:
        image_size_px: (width, height).
        model: "none", "brown4", "brown5", "brown8" or "fisheye".
        intrinsics: (4,) fx fy cx cy, px.
        distortion: (n,) coefficients in OpenCV's order; n as the model's name, 4 of "fisheye".
    """

    image_size_px: tuple[int, int]
    model: str
    intrinsics: Array
    distortion: Array

    def __post_init__(self) -> None:
        """Check the model's name and the number of its coefficients."""
        super().__post_init__()
        if self.model not in DISTORTION_MODELS:
            raise InputError(f"unknown distortion model {self.model!r}; known are {', '.join(DISTORTION_MODELS)}")
        if self.intrinsics.shape != (4,) or self.distortion.shape != (DISTORTION_MODELS[self.model],):
            raise InputError(
                f"a {self.model} camera has 4 intrinsics (fx fy cx cy) and {DISTORTION_MODELS[self.model]} distortion "
                f"coefficients, got {self.intrinsics.size} and {self.distortion.size}"
            )
        if not (np.isfinite(self.intrinsics).all() and np.isfinite(self.distortion).all()):
            raise InputError("camera intrinsics and distortion must be finite numbers")
        if not all(n > 0 for n in self.image_size_px):
            width, height = self.image_size_px
            raise InputError(f"the image size must be positive, got {width} x {height} px")
        if not (self.intrinsics[:2] > 0).all():
            raise InputError(f"focal lengths must be positive, got fx {self.intrinsics[0]}, fy {self.intrinsics[1]}")

    def __repr__(self) -> str:
        """Return the camera in one line."""
        (width, height), numbers = self.image_size_px, ", ".join(f"{x:.6g}" for x in self.intrinsics)
        return f"Camera({width}x{height} px, {self.model}, fx fy cx cy {numbers} px)"

    @property
    def matrix(self) -> Array:
        """(3, 3) camera matrix K."""
        fx, fy, cx, cy = self.intrinsics
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def parameters(self) -> Array:
        """(4 + n,) intrinsics and distortion in one vector."""
        return np.concatenate([self.intrinsics, self.distortion])

    def with_parameters(self, parameters: Array) -> Camera:
        """Return the same camera with other intrinsics and distortion (4 + n,)."""
        return Camera(self.image_size_px, self.model, parameters[:4].copy(), parameters[4:].copy())

    @cached_property
    def _kernel(self) -> tuple[bool, Array, Array]:
        """What :meth:`kernel_arguments` returns; a live loop asks for it many times a shot."""
        k, d = np.array(self.intrinsics), np.zeros(8)
        d[: self.distortion.size] = self.distortion
        for shared in (k, d):
            shared.setflags(write=False)
        return self.model == "fisheye", k, d

    def kernel_arguments(self) -> tuple[bool, Array, Array]:
        """Return what the compiled kernels take: fisheye or not, (4,) intrinsics, (8,) coefficients padded with zeros."""
        return self._kernel

    def project_jacobians(self, p: Array) -> tuple[Array, Array, Array]:
        """Project points and differentiate.

        ``p``: (N, 3) points, m, this camera's frame. Returns (N, 2) raw pixels, NaN behind the camera; (N, 2, 3) derivative
        by the point, px/m; (N, 2, 4 + n) derivative by the camera's parameters.
        """
        p = np.ascontiguousarray(p, dtype=np.float64)
        uv, J_p, J_k = np.empty((len(p), 2)), np.empty((len(p), 2, 3)), np.empty((len(p), 2, 12))
        _project(*self.kernel_arguments(), p, uv, J_p, J_k)
        return uv, J_p, J_k[:, :, : 4 + self.distortion.size]

    def project(self, p: Array) -> Array:
        """Project points (N, 3), m, this camera's frame, to raw pixels (N, 2); NaN behind the camera."""
        return self.project_jacobians(p)[0]

    def unproject(self, uv: Array) -> Array:
        """Convert raw pixels (N, 2) to unit rays (N, 3) of this camera's frame; NaN where distortion has no inverse."""
        rays = np.empty((len(uv), 3))
        _unproject(*self.kernel_arguments(), np.ascontiguousarray(uv, dtype=np.float64), rays)
        return rays


@lru_cache(maxsize=4)
def pair_arguments(cameras: tuple[Camera, Camera]) -> tuple[NDArray[np.bool_], Array, Array]:
    """Return what compiled kernels of two cameras take: (2,) fisheye or not, (2, 4) intrinsics, (2, 8) coefficients.

    No kernel writes to them: each shot of a pair takes the same ones.
    """
    (fish_l, k_l, d_l), (fish_r, k_r, d_r) = (camera.kernel_arguments() for camera in cameras)
    return np.array([fish_l, fish_r]), np.array([k_l, k_r]), np.array([d_l, d_r])
