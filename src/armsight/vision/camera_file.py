"""Cameras from the files of any program: an entry of names and numbers goes in, a :class:`~.camera.Camera` comes out.

Programs write the same four things under names of their own: the camera matrix (or fx, fy, cx, cy), the distortion (a
vector, or k1, k2, ..), its model and the image size. They are found by all names that are known, in any spelling of them
(``imageSize``, ``image_size``), and by their shape. Ours, as ``calibrate --cameras`` takes them:

    {"image_size_px": [4000, 6000],
     "left":  {"K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "distortion": [k1, k2, p1, p2, k3]},
     "right": {"K": ..., "distortion": ..., "distortion_model": "fisheye"}}
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from armsight.data import SIDES, Array
from armsight.errors import InputError, naming
from armsight.geometry.check import checked
from armsight.vision.camera import Camera

#: Names of a camera's parts in the files of the field's programs, without capitals and marks.
MATRIX = (
    *("k", "cameramatrix", "matrix", "intrinsicmatrix", "intrinsics", "intrinsic", "mtx", "m", "cammatrix", "cammtx"),
    *("camera", "kmatrix", "mat", "intr", "a", "cm", "camintrinsics", "intrinsicparameters"),
)
DISTORTION = (
    *("distortion", "distortioncoefficients", "distortioncoeffs", "distortions", "d", "dist", "distcoeffs"),
    *("distcoefs", "distcoeff", "distcoef", "kc", "coeffs", "distcoefficients", "distortionparameters"),
    *("distortionvector", "dc"),
)
SIZE = (
    *("imagesizepx", "imagesize", "resolution", "size", "imagersize", "imgsize", "imshape", "imageshape", "imgshape"),
    *("framesize", "camerasize", "imsize", "shape"),
)
_SIZE_PAIRS = (
    *(("imagewidth", "imageheight"), ("width", "height"), ("w", "h"), ("nx", "ny"), ("camerawidth", "cameraheight")),
)
_MODEL = ("distortionmodel", "cameratype", "distortiontype", "model", "type", "fisheye")
#: Distortion models by the names that programs give them; fisheye is Kannala and Brandt's of four coefficients.
FISHEYES = ("fisheye", "equidistant", "equi", "kannalabrandt", "kannalabrandt4", "kannalabrandt8", "kb4", "true")
BROWNS = (
    *("", "none", "false", "brown", "brownconrady", "radtan", "plumbbob", "rationalpolynomial", "radialtangential"),
    *("rectified", "standard", "rational", "pinhole", "opencv", "pinholeradtan8", "radtan8", "perspective"),
    *("brown4", "brown5", "brown8"),
)
#: Lenses that are none of these, by the names that stand beside a camera's own ("model: Logitech C920").
_OTHER_LENSES = ("omni", "mei", "ds", "doublesphere", "ucm", "eucm", "fov", "cahvor", "scaramuzza", "ocam", "ftheta")
#: Projections that are the pinhole's, or a fisheye's named by its distortion.
_PINHOLES = ("pinhole", "perspective", "opencv", "brown", "brownconrady", *FISHEYES)
#: The principal point is within the image, and nearer to its middle than this share of its sides.
_FAR_OFF = 0.1  # half: good webcams are remarked; double: width and height exchanged at 4:3 are not
#: A model named by its coefficients, in OpenCV's order.
_IN_ORDER = re.compile("^(opencv)?k1k2p1p2(k3(k4k5k6)?)?(opencv(order)?)?$")
_PARAMETERS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def plain(name: str) -> str:
    """Return a name without capitals and marks: ``imageSize`` and ``image_size`` are one."""
    return re.sub("[^a-z0-9]", "", str(name).lower())


def found(entry: Mapping[str, Any], names: tuple[str, ...]) -> Any:  # noqa: ANN401 - whatever the file holds
    """Return the value of the first of some plain names that an entry has; None where it has none."""
    by_name = {plain(key): value for key, value in entry.items()}
    return next((by_name[name] for name in names if by_name.get(name) is not None), None)


def described(document: Mapping[str, Any], most: int = 12) -> str:
    """Return what names a document has, matrices with their shape, for messages."""
    words = []
    for key, value in document.items():
        shape = np.shape(value) if isinstance(value, np.ndarray | list) and _regular(value) else ()
        words.append(f"{key} {'x'.join(map(str, shape))}" if shape else str(key))
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return (", ".join(words[:most]) or "no names") + more


def _regular(value: object) -> bool:
    try:
        return np.asarray(value).dtype != object
    except ValueError:
        return False


def is_camera(entry: object) -> bool:
    """Say whether an entry has a camera's matrix or focal lengths."""
    if not isinstance(entry, Mapping):
        return False
    names = {plain(key) for key in entry}
    matrix = found(entry, MATRIX)
    return (
        {"fx", "fy"} <= names
        or {"fc", "cc"} <= names
        or (matrix is not None and np.size(np.asarray(matrix, object)) != 1)
    )


def camera_of(entry: Mapping[str, Any], given_px: tuple[int, int] | None = None) -> tuple[Camera, list[str]]:
    """Build a camera from its entry in a file, by the names that are known, and notes on what was assumed or looks odd.

    ``given_px`` (width, height) of a person must agree with that of the entry. InputError: what is missing or cannot
    be, with the names that are there.
    """
    if (lens := found(entry, ("cameramodel",))) is not None and isinstance(lens, str) and plain(lens) not in _PINHOLES:
        raise InputError(
            f"camera_model {lens!r} is not supported, nor are omni, ds, ucm, eucm: calibrate again as pinhole, with "
            "radtan or equidistant"
        )
    inner = found(entry, ("intrinsics",))
    if isinstance(inner, Mapping):
        entry = {**entry, **inner}
    size, notes = image_size(entry, given_px)
    intrinsics = _intrinsics(entry)
    model, d, said = _distortion(entry)
    camera = Camera(size, model, intrinsics, d)
    return camera, [*notes, *said, *_principal_point(camera)]


def image_size(entry: Mapping[str, Any], given_px: tuple[int, int] | None) -> tuple[tuple[int, int], list[str]]:
    """Return (width, height), px, of an entry or of a person, and notes.

    They must agree, but for a broken size that is twice the principal point (Pose2Sim 0.10.49 computes it of EasyMocap's).
    """
    pair = found(entry, SIZE)
    for names in _SIZE_PAIRS:
        if pair is None and found(entry, names[:1]) is not None:
            pair = [found(entry, names[:1]), found(entry, names[1:])]
    if pair is None:
        if given_px is None:
            raise InputError(
                "holds no image size: give --image-size WIDTHxHEIGHT, that of the images it was calibrated with (there are "
                f"{described(entry)})"
            )
        return given_px, []
    size = checked(np.ravel(np.asarray(pair, object)), (2,), "image size")
    said = f"{size[0]:g} x {size[1]:g}"
    if (size != size.round()).any() and given_px and np.allclose(size, 2 * _intrinsics(entry)[2:], rtol=1e-6):
        return given_px, [f"the file's image size, {said}, is twice its principal point: the one given was taken"]
    if (size < 1).any() or (size != size.round()).any():
        raise InputError(f"image size must be whole pixels, got {said}: give --image-size WIDTHxHEIGHT")
    if given_px in (None, tuple(size)):
        return (int(size[0]), int(size[1])), []
    if given_px == tuple(size[::-1]):
        return given_px, [f"the file's image size is {said}, rows first; read as the {size[1]:g} x {size[0]:g} given"]
    raise InputError(f"the images are {said}, which is not the {given_px[0]} x {given_px[1]} given")


def _intrinsics(entry: Mapping[str, Any]) -> Array:
    """Return (4,) fx fy cx cy."""
    by_name = {plain(key): value for key, value in entry.items()}
    if "fx" in by_name:
        try:
            return checked([by_name[name] for name in ("fx", "fy", "cx", "cy")], (4,), "fx fy cx cy")
        except KeyError as error:
            raise InputError(f"has fx, but no {error.args[0]}; there are {described(entry)}") from None
    if "fc" in by_name and "cc" in by_name:
        return checked([*np.ravel(by_name["fc"]), *np.ravel(by_name["cc"])], (4,), "fc and cc")
    value = found(entry, MATRIX)
    if value is None:
        raise InputError(
            f"has no camera matrix (camera_matrix, K, matrix, or fx fy cx cy); there are {described(entry)}"
        )
    key = next(str(key) for key in entry if plain(key) in MATRIX and entry[key] is not None)
    numbers = np.asarray(value, object)
    if numbers.size == 4 and numbers.ndim == 1:
        return checked(value, (4,), key)
    return focal_and_centre(numbers.reshape(3, 3) if numbers.size == 9 else value, key)


def focal_and_centre(K: Any, name: str) -> Array:  # noqa: ANN401 - whatever the file holds
    """Return (4,) fx fy cx cy of a camera matrix (3, 3) without skew."""
    K = checked(K, (3, 3), name)
    if K[0, 2] == K[1, 2] == 0 and min(K[2, :2]) > 1:
        raise InputError(
            f"{name} is transposed, as MATLAB's IntrinsicMatrix is, whose pixels count from 1: save what MATLAB's "
            "stereoParametersToOpenCV or cameraIntrinsicsToOpenCV returns, [[fx, 0, cx], ..]"
        )
    if K[0, 1] != 0 or K[1, 0] != 0 or (K[2] != [0, 0, 1]).any():
        raise InputError(f"{name} must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; skew is not supported")
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])


def _distortion(entry: Mapping[str, Any]) -> tuple[str, Array, list[str]]:
    """Return the model, its coefficients, and notes."""
    kind = _kind(entry)
    value, by_name = found(entry, DISTORTION), {plain(key): number for key, number in entry.items()}
    if value is not None:
        key = next(str(key) for key in entry if plain(key) in DISTORTION and entry[key] is not None)
        d = checked(np.ravel(np.asarray(value, object)), (None,), key)
    elif "k1" in by_name:
        order = ("k1", "k2", "k3", "k4") if kind in FISHEYES else _PARAMETERS
        d = checked([by_name.get(n, 0.0) for n in order], (None,), "k1 k2 ..")
        d = d if kind in FISHEYES else next(d[:n] for n in (4, 5, 8) if not d[n:].any())
    elif kind in ("none", "rectified"):
        d = np.zeros(0)
    else:
        raise InputError(
            "has no distortion (distortion_coefficients, D, dist, or k1 k2 ..); an empty list or the model none is no "
            f"distortion; there are {described(entry)}"
        )
    if kind in FISHEYES:
        if d.size != 4:
            raise InputError(f"a fisheye camera has four coefficients, k1 k2 k3 k4; got {d.size}")
        return "fisheye", d, []
    assumed = "no distortion model is named; OpenCV's default, Brown-Conrady, was assumed"
    return (*brown(d), [] if kind or d.size != 4 else [assumed])


def _kind(entry: Mapping[str, Any]) -> str:
    """Return the distortion model that an entry names, one of FISHEYES and BROWNS."""
    name = next((n for n in _MODEL if isinstance(found(entry, (n,)), str | bool | np.bool_)), "")
    word = found(entry, (name,)) if name else ""
    if (other := found(entry, ("distortionmodel",))) is not None and not isinstance(other, str | bool):
        name, word = "distortionmodel", str(other)
    if not isinstance(word, str):
        word = "fisheye" if word else ""
    kind = _IN_ORDER.sub("opencv", plain(word))
    if kind not in FISHEYES + BROWNS + _OTHER_LENSES and name in (
        "model",
        "type",
    ):  # the camera's, not its distortion's
        kind = ""
    if kind in ("", "pinhole", "perspective") and plain(found(entry, ("fisheye", "isfisheye"))) in ("true", "1"):
        kind = "fisheye"
    if kind not in FISHEYES + BROWNS:
        raise InputError(
            f"{name.replace('distortionmodel', 'distortion_model').replace('cameratype', 'camera_type')} {word!r} is not "
            "supported; supported are plumb_bob, rational_polynomial, radtan (Brown-Conrady), equidistant or fisheye "
            "(Kannala-Brandt) and none: calibrate again with one of them"
        )
    return kind


def brown(coefficients: Array) -> tuple[str, Array]:
    """Name the Brown-Conrady model of OpenCV's distortion vector (n,); thin prism and tilt must be zero."""
    d = coefficients[:8] if coefficients.size in (12, 14) and not coefficients[8:].any() else coefficients
    models = {0: "none", 4: "brown4", 5: "brown5", 8: "brown8"}
    if d.size in (12, 14):
        raise InputError(
            "thin-prism or tilted-sensor distortion is not supported; calibrate with 8 coefficients or fewer"
        )
    if d.size not in models:
        raise InputError(f"{d.size} distortion coefficients; OpenCV's models have 0, 4, 5, 8, 12 or 14")
    return models[d.size], d


def _principal_point(camera: Camera) -> list[str]:
    """Reject a principal point outside of the image, remark one far from its middle: the size is another one's."""
    width, height = camera.image_size_px
    _, _, cx, cy = camera.intrinsics
    if not (0 <= cx <= width - 1 and 0 <= cy <= height - 1):
        exchanged = 0 <= cx <= height - 1 and 0 <= cy <= width - 1
        do = (
            f"give --image-size {height}x{width} where they are exchanged"
            if exchanged
            else "give the size of the images"
        )
        raise InputError(
            f"the principal point ({cx:g}, {cy:g}) lies outside of images of {width}x{height} px; {do}, that of the "
            "calibration"
        )
    off = max(abs(cx / (width - 1) - 0.5), abs(cy / (height - 1) - 0.5)) if min(width, height) > 1 else 0.0
    if off <= _FAR_OFF:
        return []
    return [
        f"the principal point ({cx:g}, {cy:g}) is {100 * off:.0f} % of a side from the middle of {width}x{height} px: was "
        "it calibrated with images of this size?"
    ]


def read_cameras(path: str | Path) -> tuple[Camera, Camera]:
    """Read two cameras, left and right: ours, or the rig of another program, whose relative pose is not read.

    InputError names the file and the entry.
    """
    from armsight.tables.document import read_document  # not above: YAML takes as long to import as a pair of images

    document = read_document(path)
    if not all(isinstance(document.get(side), dict) for side in SIDES):
        raise InputError(
            f'{path}: expected an object with "left" and "right", each with "K" and "distortion"; there are '
            f"{described(document)}"
        )
    own = {"image_size_px": document.get("image_size_px")}
    cameras = []
    for side in SIDES:
        with naming(f"{path}: camera {side}"):
            cameras.append(camera_of({**own, **document[side]})[0])
    return cameras[0], cameras[1]


def read_camera(path: str | Path) -> Camera:
    """Read one camera: the file of any program whose names are known; InputError of two cameras, or none."""
    from armsight.tables.document import read_document  # not above: YAML takes as long to import as a pair of images

    document = read_document(path)
    inner = [value for value in document.values() if is_camera(value)]
    if not is_camera(document) and len(inner) == 1:
        document = dict(inner[0])
    if "lensmodel" in document:
        from armsight.vision.rigfiles.programs import mrcal_entry

        with naming(path):
            document = dict(mrcal_entry(document))
    if not is_camera(document):
        kind = f"{len(inner)} cameras" if inner else stranger(document) or "no camera"
        raise InputError(
            f"{path}: holds {kind}, expected one: camera_matrix (or K), distortion and image size; there are "
            f"{described(document)}"
        )
    with naming(path):
        return camera_of(document)[0]


#: What is seen in the plain names of a document -> what to say.
_STRANGERS: tuple[tuple[Callable[[set[str]], bool], str], ...] = (
    (lambda names: "format" in names and "tleftrightm" in names, "a rig file of armsight already: use it as it is"),
    (lambda names: "targettype" in names, "Kalibr's target file, the drawing of a board: give it as --target"),
    (lambda names: "markers" in names, "a body file of armsight, not a calibration: give it as --target"),
    (lambda names: "board" in names, "a board file of armsight, not a calibration: give it as --target"),
    (
        lambda names: bool(names & {"accelerometernoisedensity", "gyroscopenoisedensity", "imu0"}),
        "the noise of an IMU, not of cameras: give the camchain-imucam or camchain file beside it",
    ),
    (lambda names: "kinematics" in names, "an arm's own calibration (kinematics): armsight arm calibrated reads it"),
    (
        lambda names: {"samples", "robot"} & names != set(),
        "samples of a hand-eye calibration: armsight handeye reads them",
    ),
    (lambda names: "sensortype" in names and "tbs" in names, "one sensor of a EuRoC recording that is no camera"),
    (
        lambda names: {"fundamentalmatrix", "essentialmatrix"} <= names or names <= {"f", "e"},
        "a fundamental or essential matrix: camera matrices, distortion, R and T are needed",
    ),
    (
        lambda names: bool({"r1", "r2", "p1", "p2", "q"} & names) and not names & {"m1", "k1", "cameramatrix1"},
        "a rectification (R1 R2 P1 P2 Q): give the files with both camera matrices, their distortion, R and T, too",
    ),
)


def stranger(document: Mapping[str, Any], camera: bool = True) -> str | None:
    """Return what a document is that holds no rig; None where it is not known.

    ``camera``: whether the calibration of a single camera is a stranger, too.
    """
    names = {plain(key) for key in document}
    if camera and is_camera(document):
        return (
            "the calibration of one camera, without its pose beside another: calibrate both together (armsight "
            f"calibrate), or give the files of both; there are {described(document)}"
        )
    return next((what for matches, what in _STRANGERS if matches(names)), None)
