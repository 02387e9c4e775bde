"""The closed-form method: triangulation by two verging cameras, and orientation from three points.

Coordinates on two image planes go in, points in the world frame of the method come out, each line under its equation
number. The source, its equations and its misprints are in docs/concepts/method.md. It puts the origin of a camera's
frame *in its image plane*, so that a point in front projects inverted: x/u = y/v = -(z - F)/F (18.6). Every length is
in metres, the focal length and the image coordinates too; ``pitch``, metres a pixel, leads to pixels. The world's axes
are armsight's: +X right, +Y down, +Z forward. Where the printed equation is wrong the right one stands here: These
cameras are one special rig: :func:`stereo_rig` builds it for the general functions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from armsight.data import Array, Record, Side
from armsight.geometry.pose import inverse, pose
from armsight.geometry.rotation import euler_zyx, from_euler_zyx
from armsight.vision.camera import Camera
from armsight.vision.rig import StereoRig

#: Beyond this angle, rad, x_b and z_b count as not square: P3 is not equally far from P1 and P2.
SQUARE_RAD = 1e-9


@dataclass(frozen=True)
class VergingRig:
    """Two distortion-free cameras rotated about Y, as in 18.1 to 18.8."""

    F1: float  #: focal length of camera 1 (left), m
    F2: float  #: focal length of camera 2 (right), m
    beta1: float  #: inward rotation of camera 1's axis, about Y, rad
    beta2: float  #: inward rotation of camera 2's axis, about Y, rad
    X01: float  #: camera 1 stands at X = -X01, m
    X02: float  #: camera 2 stands at X = +X02, m
    Y01: float = 0.0  #: camera 1 stands at Y = -Y01, m
    Y02: float = 0.0  #: camera 2 stands at Y = -Y02, m; a closed form that uses no v2 does not need it
    Z01: float = 0.0  #: camera 1 stands at Z = +Z01, m
    Z02: float = 0.0  #: camera 2 stands at Z = +Z02, m

    @staticmethod
    def symmetric(F: float, B: float, beta: float = 0.0) -> VergingRig:
        """Return two equal cameras a baseline ``B`` apart (18.9), rotated inward by ``beta`` each; 0 is parallel."""
        return VergingRig(F, F, beta, beta, B / 2, B / 2)


def rotation(beta: float) -> Array:
    """Return (3, 3) the rotation of a camera about Y by ``beta``, rad: from its own axes to the world's."""
    c, s = np.cos(beta), np.sin(beta)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])  # 18.4, lower left corrected: -sin


def triangulate_verging(rig: VergingRig, u1: ArrayLike, v1: ArrayLike, u2: ArrayLike) -> Array:
    """Return points (N, 3), m, seen by two verging cameras (18.7, 18.8).

    The two rays meet in the X-Z plane, and Y comes from camera 1 alone: v2 would be redundant.
    """
    F1, F2, X01, X02, Y01, Z01, Z02 = rig.F1, rig.F2, rig.X01, rig.X02, rig.Y01, rig.Z01, rig.Z02
    u1, v1, u2 = (np.atleast_1d(np.asarray(a, dtype=np.float64)) for a in (u1, v1, u2))
    c1, s1, c2, s2 = np.cos(rig.beta1), np.sin(rig.beta1), np.cos(rig.beta2), np.sin(rig.beta2)
    m1 = F1 * c1 + u1 * s1  # 18.8
    m2 = F2 * c2 - u2 * s2  # 18.8
    n1 = u1 * c1 - F1 * s1  # 18.8
    n2 = u2 * c2 + F2 * s2  # 18.8
    across = m1 * n2 - m2 * n1
    Z = (
        m1 * m2 * (X01 + X02) + m1 * F2 * u2 - m2 * F1 * u1 + m1 * n2 * Z02 - m2 * n1 * Z01
    ) / across  # 18.7, corrected
    X = (u1 * F1 - m1 * X01 - n1 * (Z - Z01)) / m1  # 18.7
    Y = v1 - Y01 - v1 / F1 * ((X + X01) * s1 + (Z - Z01) * c1)  # 18.7, corrected: (X + X01)
    return np.stack([X, Y, Z], axis=-1)


def triangulate_parallel(F: float, B: float, u1: ArrayLike, v1: ArrayLike, u2: ArrayLike) -> Array:
    """Return points (N, 3), m, of two equal parallel cameras (18.10), origin half-way."""
    u1, v1, u2 = (np.atleast_1d(np.asarray(a, dtype=np.float64)) for a in (u1, v1, u2))
    Z = F - B * F / (u1 - u2)  # 18.10, corrected: u1 - u2
    X = (F - Z) * u1 / F - B / 2  # 18.10
    Y = (F - Z) * v1 / F  # 18.10
    return np.stack([X, Y, Z], axis=-1)


def T_world_camera(rig: VergingRig, side: Side) -> Array:
    """Return (4, 4) the pose of armsight's left or right camera, whose origin is the projection centre, in the world.

    The method's own origin lies a focal length behind it, in the image plane.
    """
    if side == "left":
        R, origin, F = rotation(rig.beta1), np.array([-rig.X01, -rig.Y01, rig.Z01]), rig.F1
    else:
        R, origin, F = rotation(-rig.beta2), np.array([rig.X02, -rig.Y02, rig.Z02]), rig.F2
    return pose(R, origin + F * R[:, 2])


def stereo_rig(rig: VergingRig, *, pitch: float, image_size_px: tuple[int, int]) -> StereoRig:
    """Build the same two cameras as a StereoRig, for the general functions."""
    cx, cy = _middle(image_size_px)
    left, right = (
        Camera(image_size_px, "none", np.array([F / pitch, F / pitch, cx, cy]), np.zeros(0)) for F in (rig.F1, rig.F2)
    )
    T_left_right = inverse(T_world_camera(rig, "left")) @ T_world_camera(rig, "right")
    return StereoRig(left, right, T_left_right, np.zeros((14, 14)), 0.0, {"origin": "closed-form rig, given"})


def image_coordinates(uv: Array, *, pitch: float, image_size_px: tuple[int, int]) -> tuple[Array, Array]:
    """Convert raw pixels of :func:`stereo_rig` to the image coordinates of the method."""
    cx, cy = _middle(image_size_px)
    return (cx - uv[:, 0]) * pitch, (cy - uv[:, 1]) * pitch  # 18.6


def _middle(image_size_px: tuple[int, int]) -> tuple[float, float]:
    """Return the middle of an image, px."""
    return (image_size_px[0] - 1) / 2, (image_size_px[1] - 1) / 2


@dataclass(frozen=True, eq=False)
class Orientation(Record):
    """The orientation of a body, from three of its points."""

    R: Array  #: (3, 3) rotation with columns x_b y_b z_b, from the body's axes to those the points were given in
    euler_zyx: Array  #: (3,) phi, theta, psi, rad
    #: whether the pitch is +-90 degrees: yaw is then set to zero, and roll holds roll - yaw at +90 degrees, roll + yaw
    #: at -90
    singular_pitch: bool
    off_square_rad: float  #: by how much the angle between the printed x_b and z_b differs from 90 degrees

    @property
    def orthonormalised(self) -> bool:
        """Whether z_b had to be made square to x_b: P3 is not equally far from P1 and P2."""
        return self.off_square_rad > SQUARE_RAD


def orientation(P1: ArrayLike, P2: ArrayLike, P3: ArrayLike) -> Orientation:
    """Find the orientation of a body from three of its points (18.11 to 18.16).

    x_b runs along P1 P2, and z_b from P3 to their middle. Where P3 is not equally far from both, these two are not
    perpendicular; x_b, the measured line, is then kept and z_b rotated within the plane of the three points: it runs
    from P3 to the nearest point of the line P1 P2 instead of its middle.
    """
    p1, p2, p3 = (np.asarray(P, dtype=np.float64) for P in (P1, P2, P3))
    x_b = (p2 - p1) / np.linalg.norm(p2 - p1)  # 18.11 to 18.14
    z_b = (p1 + p2) / 2 - p3  # 18.11 to 18.14
    z_b /= np.linalg.norm(z_b)
    cosine = float(x_b @ z_b)
    square = z_b - cosine * x_b
    sine = float(np.linalg.norm(square))
    z_b = square / sine
    y_b = np.cross(z_b, x_b)  # 18.11 to 18.14
    R = np.stack([x_b, y_b, z_b], axis=1)  # 18.11 to 18.14
    angles, singular = euler_zyx(R)  # 18.16, with atan2
    return Orientation(R, angles, singular, float(np.arctan2(abs(cosine), sine)))


def rotation_from_angles(phi: float, theta: float, psi: float) -> Array:
    """Return R_z(phi) R_y(theta) R_x(psi) (18.15), rad.

    The source names phi roll, theta pitch and psi yaw; ROS's roll is the angle about x.
    """
    return from_euler_zyx(phi, theta, psi)  # 18.15; row 1, column 3 is C_phi S_theta C_psi + S_phi S_psi
