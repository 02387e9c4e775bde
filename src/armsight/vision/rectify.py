"""Rectify a pair: convert its images to those of two equal cameras side by side, and pixels between raw and rectified.

Both cameras are rotated about their own centres until the rows of both images are the same planes through the baseline
(Fusiello, Trucco and Verri, "A compact algorithm for rectification of stereo pairs", MVA 12(1), 2000). A scene point is
then in one row, and its column in the left image less that in the right one, the disparity d, gives its depth: z = f b
/ d. Both images have one principal point, so that a point at infinity has no disparity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import SIDES, Array, Image, Record, Side
from armsight.errors import InputError
from armsight.geometry.pose import inverse, pose
from armsight.vision.camera import Camera

if TYPE_CHECKING:
    from armsight.vision.rig import StereoRig


#: Largest difference of two unit rays that count as the same: a raw pixel is stored in single precision.
_SAME_RAY = 1e-5
#: Rows that are processed at a time, and step between the pixels that are checked for folds, px.
ROWS_AT_ONCE, _STEP = 32, 8
#: Least sine of the angle between the view and the baseline: below it one camera is behind the other.
_ASIDE = 0.2


@dataclass(frozen=True, eq=False)
class Rectification(Record):
    """The rectification of a rig's images."""

    rig: StereoRig  #: the rig
    image_size_px: tuple[int, int]  #: (width, height) of both rectified images
    focal_px: float  #: f, of both
    principal_px: tuple[float, float]  #: (column, row) of the principal point, of both
    T_left_rectleft: Array  #: (4, 4) a rotation, from the rectified to the raw left camera
    T_right_rectright: Array  #: (4, 4) a rotation, the same of the right camera
    #: (H, W, 2) the raw pixel that each rectified pixel shows; NaN where the camera sees nothing
    map_left: NDArray[np.float32]
    map_right: NDArray[np.float32]  #: the same of the right image

    def images(self, left: Image, right: Image) -> tuple[Image, Image]:
        """Rectify a pair of raw images; where a camera sees nothing they are black.

        Raises InputError: an image is not of the size its camera was calibrated at.
        """
        out = []
        for side, image in zip(SIDES, (left, right), strict=True):
            camera, _, raw_uv = self._of(side)
            if (image.shape[1], image.shape[0]) != tuple(camera.image_size_px):
                width, height = camera.image_size_px
                raise InputError(
                    f"{side} image: {image.shape[1]}x{image.shape[0]} px, the rig was calibrated at {width}x{height}"
                )
            # OpenCV's cubic and Lanczos kernels displace what they interpolate, by up to 0.05 and 0.015 px.
            u, v = np.moveaxis(np.nan_to_num(raw_uv, nan=-10.0), 2, 0)
            out.append(np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)))
        return out[0], out[1]

    def _of(self, side: Side) -> tuple[Camera, Array, NDArray[np.float32]]:
        """Return the camera of a side, the rotation (3, 3) to it, and its map."""
        if side == "left":
            return self.rig.left, self.T_left_rectleft[:3, :3], self.map_left
        return self.rig.right, self.T_right_rectright[:3, :3], self.map_right

    def seen(self, side: Side) -> NDArray[np.bool_]:
        """(H, W) whether a rectified pixel lies within the raw image; disparity is defined there in the left one."""
        camera, _, raw_uv = self._of(side)
        high = np.array(camera.image_size_px) - 1
        with np.errstate(invalid="ignore"):
            return np.asarray(((raw_uv >= 0) & (raw_uv <= high)).all(axis=2))

    def to_rect(self, uv: Array, side: Side) -> Array:
        """Convert raw pixels (N, 2) to rectified ones (N, 2); NaN where there is none."""
        camera, R, _ = self._of(side)
        ray = camera.unproject(uv) @ R
        z = np.where(ray[:, 2] > 0, ray[:, 2], np.nan)
        return np.asarray(self.focal_px * ray[:, :2] / z[:, None] + self.principal_px)

    def to_raw(self, uv_rect: Array, side: Side) -> Array:
        """Convert rectified pixels (N, 2) to raw ones (N, 2); NaN where the camera sees nothing."""
        camera, R, _ = self._of(side)
        return camera.project(_rays(uv_rect, self.focal_px, self.principal_px) @ R.T)

    def points(self, uv_rect: Array, disparity: Array) -> Array:
        """Convert pixels (N, 2) of the rectified left image and their disparities (N,) to points (N, 3), m, left frame.

        NaN where a disparity is not that of a point in front of the cameras.
        """
        z = np.asarray(self.depth(np.asarray(disparity, np.float64)))
        rays = _rays(uv_rect, self.focal_px, self.principal_px)
        return np.asarray((rays * z[:, None]) @ self.T_left_rectleft[:3, :3].T)

    def depth(self, disparity: NDArray[np.floating[Any]]) -> Array:
        """Return depths, m, along the axis of the rectified left camera, of disparities; NaN where there is none."""
        d = np.where(np.asarray(disparity) > 0, disparity, np.nan).astype(np.float64)
        return np.asarray(self.focal_px * self.rig.baseline_m / d)

    def disparity_of(self, depth_m: float) -> float:
        """Return the disparity of a depth, px."""
        return self.focal_px * self.rig.baseline_m / depth_m


def _rays(uv: Array, focal_px: float, principal: tuple[float, float]) -> Array:
    """Return rays (N, 3) of unit depth through rectified pixels (N, 2)."""
    return np.column_stack([(uv - np.asarray(principal)) / focal_px, np.ones(len(uv))])


def rectify(rig: StereoRig) -> Rectification:
    """Compute the rectification of a rig; InputError where its baseline lies along the optical axes.

    The new axes: x along the baseline, z as near to both optical axes as possible. The images keep the left one's size
    and the mean focal length; the mean of the two viewing directions is in the middle.
    """
    baseline = rig.T_left_right[:3, 3] / rig.baseline_m
    ahead = np.array([0.0, 0.0, 1.0]) + rig.T_left_right[:3, 2]
    if baseline[0] <= 0:
        raise InputError("the right camera is on the left camera's left: exchange the two in the rig file")
    z = ahead - (ahead @ baseline) * baseline
    if np.linalg.norm(z) < _ASIDE * np.linalg.norm(ahead):
        raise InputError("one camera is behind the other, along their view: such a rig cannot be rectified")
    z = z / np.linalg.norm(z)
    R_left_rect = np.column_stack([baseline, np.cross(z, baseline), z])
    T_left_rectleft = pose(R_left_rect, np.zeros(3))
    T_right_rectright = pose(inverse(rig.T_left_right)[:3, :3] @ R_left_rect, np.zeros(3))
    focal = float(np.mean([camera.intrinsics[:2].mean() for camera in rig.cameras]))
    size = np.array(rig.left.image_size_px)
    rotations = (T_left_rectleft[:3, :3], T_right_rectright[:3, :3])
    looks = [_middle_ray(camera) @ R for camera, R in zip(rig.cameras, rotations, strict=True)]
    column, row = (size - 1) / 2 - np.mean([focal * look[:2] / look[2] for look in looks], axis=0)
    principal = (float(column), float(row))
    maps = [_map(camera, R, size, focal, principal) for camera, R in zip(rig.cameras, rotations, strict=True)]
    return Rectification(rig, rig.left.image_size_px, focal, principal, T_left_rectleft, T_right_rectright, *maps)


def _middle_ray(camera: Camera) -> Array:
    """Return the ray (3,) through the middle of a camera's image."""
    return np.asarray(camera.unproject((np.array([camera.image_size_px]) - 1) / 2)[0])


def _map(
    camera: Camera, R_camera_rect: Array, size: NDArray[np.int64], focal: float, principal: tuple[float, float]
) -> NDArray[np.float32]:
    """Return the raw pixel (H, W, 2) of every rectified pixel, NaN where there is none."""
    width, height = int(size[0]), int(size[1])
    out = np.empty((height, width, 2), np.float32)
    for top in range(0, height, ROWS_AT_ONCE):
        v, u = np.mgrid[top : min(top + ROWS_AT_ONCE, height), :width].astype(np.float64)
        rays = _rays(np.column_stack([u.ravel(), v.ravel()]), focal, principal) @ R_camera_rect.T
        out[top : top + ROWS_AT_ONCE] = camera.project(rays).reshape(*u.shape, 2)
    # Far off its axis a distortion polynomial folds back: a pixel whose ray is not its own is invalid. Folds are far
    # larger than a few pixels, so only every eighth pixel is checked.
    v, u = np.mgrid[0:height:_STEP, 0:width:_STEP]
    rays = _rays(np.column_stack([u.ravel(), v.ravel()]), focal, principal) @ R_camera_rect.T
    ahead = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    gap = np.abs(camera.unproject(out[v.ravel(), u.ravel()].astype(np.float64)) - ahead).max(axis=1)
    folded = ~(gap < _SAME_RAY).reshape(u.shape)
    out[np.kron(folded, np.ones((_STEP, _STEP), bool))[:height, :width]] = np.nan
    return out
