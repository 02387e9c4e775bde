"""A ROS camera_info pair, left and right: files of camera_calibration, or messages as ``rostopic echo`` prints them.

The files hold no relative pose. It follows from both rectification matrices and the last columns of the projection
matrices, which position the cameras in the rectified frame: P = K' [I | t], t = (-B, 0, 0) for the right one, so
p_left = R_left^T (R_right p_right - K_right'^-1 P_right[:, 3] + K_left'^-1 P_left[:, 3]). Translations are in metres
(REP 103). Models: plumb_bob, rational_polynomial, equidistant.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from armsight.data import Array
from armsight.errors import InputError, naming
from armsight.geometry.check import checked
from armsight.geometry.pose import inverse
from armsight.tables.document import Foreign, dump_yaml
from armsight.vision.camera import Camera
from armsight.vision.camera_file import camera_of, described, focal_and_centre, found, is_camera
from armsight.vision.rig import StereoRig
from armsight.vision.rigfiles import rigfile

#: Names of the matrices in the files of camera_calibration, and in printed messages (D K R P, in ROS 2 d k r p).
_NAMES = {
    "camera_matrix": ("cameramatrix", "k"),
    "distortion_coefficients": ("distortioncoefficients", "d"),
    "rectification_matrix": ("rectificationmatrix", "r"),
    "projection_matrix": ("projectionmatrix", "p"),
}
#: ROS model -> the numbers of coefficients it may come with.
MODELS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}


def recognises(documents: Sequence[rigfile.Document]) -> bool:
    """Say whether every file has a camera's matrix and its projection, in files' or messages' names."""
    return all(
        is_camera(document) and found(document, _NAMES["projection_matrix"]) is not None for document in documents
    ) or all(document.get("P") is not None for document in documents)


def read(documents: Sequence[rigfile.Document], paths: Sequence[Path], options: rigfile.ImportOptions) -> StereoRig:
    """Read the left and the right camera_info file, in this order."""
    if len(paths) == 1 and len(documents) == 1:
        with naming(paths[0]):
            raise InputError(
                "camera_info of one camera, got 1 file(s); a stereo pair has two: give left.yaml and right.yaml"
            )
    rigfile.count_paths(paths, (2,), "two files, left.yaml and right.yaml")
    return rig_of(documents, paths, options)


def rig_of(documents: Sequence[rigfile.Document], paths: Sequence[Path], options: rigfile.ImportOptions) -> StereoRig:
    """Return the rig of a left and a right camera_info, with the keys of the files; ``paths`` are for messages.

    InputError: one is damaged, or they are no stereo pair.
    """
    cameras, Ts, notes = [], [], []
    for path, document in zip(paths, documents, strict=True):
        with naming(path):
            camera, T_rect_camera, said = _read_one(document, options)
        cameras.append(camera)
        Ts.append(T_rect_camera)
        notes += [f"{path.name}: {note}" for note in said]
    if (Ts[0][:3, 3] == Ts[1][:3, 3]).all():
        raise InputError(
            f"{paths[1]}: projection_matrix holds no baseline (P[0, 3] as in the left file): these are two single "
            "cameras, or one file twice, not a stereo pair; calibrate them together"
        )
    T_left_right = inverse(Ts[0]) @ Ts[1]
    notes.append("relative pose recovered from the rectification and projection matrices, which hold it indirectly")
    return rigfile.imported(cameras, T_left_right, options, paths, notes)


def write(rig: StereoRig, paths: Sequence[Path]) -> tuple[str, ...]:
    """Write the left and the right camera_info file."""
    rigfile.count_paths(paths, (2,), "two files, left.yaml and right.yaml")
    lost = list(rigfile.not_held(rig))
    R1, R2, P1, P2, _ = rigfile.rectification(rig)
    documents = []
    for name, camera, R, P in (("left", rig.left, R1, P1), ("right", rig.right, R2, P2)):
        model = {"fisheye": "equidistant", "brown8": "rational_polynomial"}.get(camera.model, "plumb_bob")
        d = camera.distortion
        if camera.model in ("none", "brown4"):
            d = np.concatenate([d, np.zeros(5 - d.size)])
            lost.append(f"that the {name} camera's distortion is {camera.model}: plumb_bob has five coefficients")
        documents.append(
            {
                "image_width": camera.image_size_px[0],
                "image_height": camera.image_size_px[1],
                "camera_name": name,
                "camera_matrix": _matrix(camera.matrix),
                "distortion_model": model,
                "distortion_coefficients": _matrix(d.reshape(1, -1)),
                "rectification_matrix": _matrix(R),
                "projection_matrix": _matrix(P),
            }
        )
    rigfile.write_together(paths, [dump_yaml(document) for document in documents])
    return tuple(lost)


def _read_one(document: rigfile.Document, options: rigfile.ImportOptions) -> tuple[Camera, Array, list[str]]:
    """Return a camera, (4, 4) its T_rect_camera in the unit of the file, and notes."""
    for key in ("camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix"):
        if found(document, _NAMES[key]) is None:
            raise InputError(f"has no {key!r} (in messages {_NAMES[key][-1].upper()}); there are {described(document)}")
    if (word := found(document, ("distortionmodel",))) not in (None, "", *MODELS):
        raise InputError(f"distortion_model {word!r} is not supported; supported are {', '.join(MODELS)}")
    model = str(word or "plumb_bob")
    count = np.asarray(found(document, _NAMES["distortion_coefficients"]), object).size
    if count not in MODELS[model]:
        raise InputError(f"{model} has {' or '.join(map(str, MODELS[model]))} coefficients, got {count}")
    camera, notes = camera_of({**document, "distortion_model": model}, options.image_size_px)
    if not np.any(np.asarray(found(document, _NAMES["camera_matrix"]), float)):
        raise InputError("camera_matrix is zero: the camera that published it was not calibrated")
    P, R = _matrix_of(document, "projection_matrix", (3, 4)), _matrix_of(document, "rectification_matrix", (3, 3))
    if (np.eye(3) != R).any() and np.allclose(P[:, :3], camera.matrix @ R, atol=1e-3):
        raise InputError(
            "projection_matrix is camera_matrix times rectification_matrix, as ROS's cameracalibrator writes for fisheye "
            "pairs: the baseline is lost; run armsight calibrate on the images in its calibrationdata.tar.gz"
        )
    if P[2, 3] != 0 or focal_and_centre(P[:, :3], "projection_matrix")[:2].min() <= 0:
        raise InputError("projection_matrix must be [[fx, 0, cx, Tx], [0, fy, cy, Ty], [0, 0, 1, 0]]: uncalibrated?")
    T_rect_camera, said = rigfile.rigid(R, -np.linalg.solve(P[:, :3], P[:, 3]), "rectification_matrix")
    if not word:
        said.append("no distortion_model; plumb_bob assumed, as ROS does")
    camera, windowed = _windowed(camera, document)
    return camera, T_rect_camera, notes + said + windowed


def _windowed(camera: Camera, document: rigfile.Document) -> tuple[Camera, list[str]]:
    """Return the camera of the images that a driver publishes, a window of the sensor (roi) and binned, and a note.

    A camera_info's size and matrices are those of the sensor's whole image (sensor_msgs/CameraInfo); the window comes off
    first, then the principal point is divided by the binning, as image_geometry does. R and the pose stay.
    """
    roi = found(document, ("roi",)) or {}
    if not isinstance(roi, dict):
        raise InputError(f"roi must be a mapping of x_offset, y_offset, width, height, got {roi!r}")
    keys, (width, height) = ("x_offset", "y_offset", "width", "height"), camera.image_size_px
    numbers = [found(document, ("binningx",)), found(document, ("binningy",)), *(roi.get(key) for key in keys)]
    given = checked([0 if number is None else number for number in numbers], (6,), "binning and roi")
    whole = given.astype(int)
    if (whole != given).any() or whole.min() < 0:
        raise InputError(f"binning and roi must be whole numbers from 0 on, got {given.tolist()}")
    binning, offset, size = np.maximum(whole[:2], 1), whole[2:4], whole[4:]
    size = np.where(size > 0, size, camera.image_size_px)
    if (binning == 1).all() and not offset.any() and (size == (width, height)).all():
        return camera, []
    if (offset + size > (width, height)).any():
        raise InputError(f"roi {roi} is no window of its {width} x {height} px")
    fxy, centre = camera.intrinsics[:2] / binning, (camera.intrinsics[2:] - offset) / binning
    width_px, height_px = (int(number) for number in size // binning)
    note = (
        f"its images are {width_px} x {height_px} px: the window of {size[0]} x {size[1]} at ({offset[0]}, {offset[1]}), "
        f"binned {binning[0]} x {binning[1]}, of a sensor of {width} x {height}"
    )
    return Camera((width_px, height_px), camera.model, np.hstack([fxy, centre]), camera.distortion), [note]


def _matrix_of(document: rigfile.Document, key: str, shape: tuple[int, int]) -> Array:
    """Return the numbers of a matrix entry; messages hold them row by row."""
    numbers = np.asarray(found(document, _NAMES[key]), object)
    if numbers.size != shape[0] * shape[1]:
        raise InputError(f"{key} must hold {shape[0]} x {shape[1]} numbers, got {numbers.size}")
    return checked(numbers.reshape(shape), shape, key)


def _matrix(m: Array) -> dict[str, Foreign]:
    return {"rows": m.shape[0], "cols": m.shape[1], "data": m.ravel().tolist()}


FORMATS = {"ros": rigfile.RigFormat("a pair of ROS camera_info files", recognises, read, write, rectifies=True)}
