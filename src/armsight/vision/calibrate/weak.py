"""The weaknesses of a calibration, as sentences, with advice."""

from __future__ import annotations

import numpy as np
from numpy.polynomial.chebyshev import chebvander2d

from armsight.data import Array
from armsight.errors import CalibrationError
from armsight.estimate.chance import chi_square_limit
from armsight.files import natural_key
from armsight.vision.calibrate.motion import SIZE, ExposureMotion, baseline_axes
from armsight.vision.calibrate.result import BOARD_DEGREE, Calibration, corner_variance_px2
from armsight.vision.pose.projection import smooth

_LEAST_TILT_DEG = 15.0
_GOOD_PAIRS = 12
#: Fewer pairs can follow a bad one by errors of the cameras: in six, one that is three times as bad as usual is not found.
_TESTED = 8
COVERAGE_GRID = 8
_LEAST_COVERED = 0.6
_FOCUS_RATIO = 2.0
_SCALE_SIGMAS = 4.0
_REJECTED_SHARE = 0.2
#: Held-out epipolar RMS, as a share of an image's longer side, beyond which the images do not belong to two cameras.
_CONTRADICTION = 0.005
#: By which share a print may be longer one way than the other. Half: ordinary printers' feeds are named; double: sigmas of
#: a good rig are too small by ten times.
_LONGER = 0.002
#: How many times as large as what boards moved between exposures it may be.
_OF_MOTION = 3.0
#: By which share of their distance points may move where pairs fit other cameras: beyond, sigmas cannot hold it. Half: a
#: camera that rotated by half a degree contradicts; double: images that are mirrored from a pair on may not.
_FAR_CHANGE = 0.1
_FAR_MOTION, _FARTHEST = 2.0, 4
#: Square of motions over variance across the line of the cameras, as a share of that along it, below which they are those
#: of boards of other sizes. Half: 1 % at noise of 0.1 px is not named; double: a board that slid by hand may be.
_ALONG = 0.05
_ROLLED_DEG = 60.0
_RECORD = (
    " By what time they differ is not found here, for images have none: give a recording, `armsight calibrate --source "
    "video:LEFT,RIGHT` or a folder of `armsight record`, of a board that moves"
)
#: Degree of the polynomials of the position in an image that residuals may follow, beyond which share of their square and
#: which chance they show a lens that the model cannot express.
_FIELD_DEGREE, _FIELD_SHARE, _FIELD_CHANCE = 4, 0.04, 1e-4


def weaknesses(calibration: Calibration) -> tuple[str, ...]:
    """Assess a calibration: one sentence per weakness, what it is and what to do; empty where nothing stands out."""
    checks = [_agreement, _changed, _spread, _print, _pairs, _focus, _synchrony, _sides]
    if calibration.rig.cov[0, 0] > 0:  # intrinsics were estimated, not given
        checks += [_tilts, _coverage, _focal, _scale]
    return tuple(message for check in checks if (message := check(calibration)) is not None)


def contradicted(calibration: Calibration) -> bool:
    """Whether held-out pairs contradict the rig so that nothing must be measured with it.

    What boards moved between the exposures of a pair is in the rig's covariance, and no contradiction.
    """
    longest = max(max(camera.image_size_px) for camera in calibration.rig.cameras)
    motion_px = 0.0 if calibration.motion is None else _way_px(calibration, calibration.motion)
    changed = calibration.change is not None and calibration.change.shift_m > _FAR_CHANGE * _distance_m(calibration)
    return changed or calibration.held_out.epipolar_rms_px > max(_CONTRADICTION * longest, _OF_MOTION * motion_px)


def _distance_m(calibration: Calibration) -> float:
    return float(np.linalg.norm(calibration.solution.state.Ts_left_body[:, :3, 3], axis=1).mean())


def _way_px(calibration: Calibration, motion: ExposureMotion) -> float:
    """Return what a motion between exposures moves a board by in the right image, RMS along an axis, px."""
    return float(calibration.rig.right.intrinsics[0] * motion.rms_m / _distance_m(calibration))


def _agreement(calibration: Calibration) -> str | None:
    if not contradicted(calibration):
        return None
    return (
        f"the images of both cameras contradict each other by {calibration.held_out.epipolar_rms_px:.0f} px: do not "
        "measure with this rig. Does a driver mirror the images of one camera, or of both midway, do left and right "
        "images belong to different moments, or do they show different boards?"
    )


def _changed(calibration: Calibration) -> str | None:
    change = calibration.change
    if change is None:
        return None
    before, after = calibration.pairs[change.row - 1 : change.row + 1]
    if not change.what:
        given = calibration.rig.cov[0, 0] == 0
        lens = "Check the intrinsics that were given" if given else "Try another --lens-model"
        return (
            f"the pairs up to {before} and those from {after} on fit other cameras, and their boards stand elsewhere: the "
            f"cameras changed, or the lens model does not fit. {lens}, and mix near, far, left and right"
        )
    if change.what.startswith(SIZE):
        return (
            f"{change.what.replace(' by ', ' changed by ')} about between {before} and {after}, which displaces points by "
            f"{1e3 * change.shift_m:.2g} mm: another board or print, or cameras that were moved; the rig is of neither "
            "state, and its sigmas allow for that. Calibrate from the pairs of one state"
        )
    return (
        f"the cameras changed about between {before} and {after}: {change.what}, which displaces points by "
        f"{1e3 * change.shift_m:.2g} mm; the rig is of neither state, and its sigmas allow for that. Did a lens "
        "refocus, was a camera knocked, are images cropped or resized? It may also be another board or print, or one that "
        "moved between two exposures. Lock the lenses, and calibrate from the pairs of one state"
    )


def printed_longer(calibration: Calibration) -> tuple[float, float, float] | None:
    """Return by which share a print is longer one way than across it, its sigma, and the angle to the rows, degrees.

    None where that is not surely more than an ordinary print's. It is the strain of the plane by the board's shape.
    """
    drawing, shape = calibration.drawing, calibration.solution.state.shape
    if drawing is None or not len(shape):
        return None
    modes = smooth(drawing, BOARD_DEGREE)
    p = (drawing - drawing.mean(axis=0))[:, :2]
    D = np.linalg.lstsq(p, np.concatenate([mode[:, :2] for mode in modes], axis=1))[0].reshape(2, -1, 2)
    J = np.stack([D[0, :, 0] - D[1, :, 1], D[0, :, 1] + D[1, :, 0]])
    strain, of = J @ shape[: len(modes)], slice(-len(shape), len(modes) - len(shape) or None)
    share = float(np.linalg.norm(strain))
    g = strain @ J / max(share, 1e-300) * max(calibration.held_out.normalised_rms, 1.0)
    sigma = float(np.sqrt(g @ calibration.solution.cov_shared[of, of] @ g))
    return (share, sigma, float(np.degrees(np.arctan2(*strain[::-1])) / 2)) if share > _LONGER + 4 * sigma else None


def _spread(calibration: Calibration) -> str | None:
    said = (
        f"the corners of a pair are off together, not by noise; sigmas are up to {calibration.spread:.2g} times as large "
        "for it. Did the board move or bend, did a lens refocus, or does its model not fit? Hold still, lock the focus"
    )
    return said if calibration.spread > 1 else None


def _print(calibration: Calibration) -> str | None:
    if (found := printed_longer(calibration)) is None:
        return None
    share, sigma, angle = found
    return (
        f"the board is printed {100 * share:.2g} ± {100 * sigma:.1g} % longer one way, at {abs(angle):.0f} degrees to its "
        "rows, than across: lengths are right to no more than that, whatever the rig's sigmas. Print it again, or measure "
        "many squares both ways with a caliper and give its points in a body file"
    )


def _pairs(calibration: Calibration) -> str | None:
    used = len(calibration.pairs)
    found = calibration.pairs_found - sum("frame that repeats" in each.reason for each in calibration.rejected)
    if used < _GOOD_PAIRS:
        hidden = ", and one whose board moved between the images may go unnoticed" if used < _TESTED else ""
        return f"only {used} pairs were used{hidden}: take {_GOOD_PAIRS} or more, near and far and tilted every way"
    if used < (1 - _REJECTED_SHARE) * found:
        said = f"{found - used} of {found} pairs were rejected: "
        parts = calibration.pairs, {each.pair for each in calibration.rejected} - set(calibration.pairs)
        first, last = sorted(sorted(map(natural_key, part)) for part in parts)
        if first and first[-1] < last[0]:
            said += "all on one side of the others in their order: did board or cameras change there? Else "
        return f"{said}see the reasons; hold the board still for every shot"
    return None


def _tilts(calibration: Calibration) -> str | None:
    """Tilt of the board's normal against the mean line of sight, by pair."""
    Ts = calibration.solution.state.Ts_left_body
    sight = Ts[:, :3, 3] / np.linalg.norm(Ts[:, :3, 3], axis=1, keepdims=True)
    tilt = np.degrees(np.arccos(np.clip(np.abs(np.einsum("ni,ni->n", Ts[:, :3, 2], sight)), 0, 1)))
    if np.quantile(tilt, 0.75) < _LEAST_TILT_DEG:
        return (
            f"too few tilts: three quarters of the boards are within {np.quantile(tilt, 0.75):.0f} degrees of facing the "
            "cameras, so focal length and distance trade: tilt the board by 30 to 45 degrees, every way"
        )
    return None


def _coverage(calibration: Calibration) -> str | None:
    for side, name in enumerate(("left", "right")):
        share = coverage(calibration, side, COVERAGE_GRID)
        if (share > 0).mean() < _LEAST_COVERED:
            empty = 100 * (share == 0).mean()
            return (
                f"{empty:.0f}% of the {name} image never saw the board (counted in {COVERAGE_GRID} x {COVERAGE_GRID} "
                "cells), so its distortion is unknown there: move the board into the corners of both images"
            )
    return None


def coverage(calibration: Calibration, side: int, cells: int) -> Array:
    """Count detections in a grid over one image, (cells, cells), rows down."""
    observations = calibration.observations
    width, height = calibration.rig.cameras[side].image_size_px
    uv = observations.uv[observations.camera == side]
    counts, _, _ = np.histogram2d(uv[:, 1], uv[:, 0], bins=cells, range=((-0.5, height - 0.5), (-0.5, width - 0.5)))
    return np.asarray(counts)


def _focus(calibration: Calibration) -> str | None:
    observations = calibration.observations
    image = np.trace(observations.cov_uv, axis1=1, axis2=2)
    each, residual_px2 = [observations.camera == side for side in (0, 1)], calibration.solution.residuals_px**2
    noise = [float(np.sqrt(np.median(image[rows]))) for rows in each]
    for values in (noise, [float(np.sqrt(np.median(residual_px2[rows].sum(axis=1)))) for rows in each]):
        worse = int(np.argmax(values))
        if min(values) > 0 and values[worse] > _FOCUS_RATIO * values[1 - worse]:
            name = ("left", "right")[worse]
            return (
                f"the {name} camera's corners are {values[worse] / values[1 - worse]:.1f} times as uncertain as the "
                "other's: out of focus, moving, or badly lit? Focus it on the working distance and lock the focus"
            )
    return None


def _synchrony(calibration: Calibration) -> str | None:
    """Boards that moved between the exposures of a pair, or pairs whose epipolar error stands out."""
    if calibration.change is not None and calibration.change.what.startswith(SIZE):
        return None  # that looks like a motion of each board
    if calibration.motion is not None:
        return _moved(calibration, calibration.motion)
    errors = calibration.errors
    usual = float(np.median(errors.epipolar_px))
    late = [calibration.pairs[int(j)] for j, e in zip(errors.pair, errors.epipolar_px, strict=True) if e > 2.5 * usual]
    if late and usual > 0:
        return (
            f"{f'{len(late)} pairs have' if len(late) > 1 else 'a pair has'} an epipolar error over 2.5 times the usual "
            f"{usual:.2f} px ({', '.join(late[:4])}): unsynchronised cameras see a moving board at two positions; hold it "
            "still, or trigger both cameras together; calibrate again without such pairs"
        )
    return None


def _by_position(calibration: Calibration) -> float | None:
    """Return the RMS residual, px, that follows the position in the images; None where it is small, or chance.

    A motion of the board is another one in each pair: its residuals do not depend on the position.
    """
    observations, residuals = calibration.observations, calibration.solution.residuals_px
    powers = [(i, k) for i in range(_FIELD_DEGREE + 1) for k in range(_FIELD_DEGREE + 1 - i)]
    explained = 0.0
    for side, camera in enumerate(calibration.rig.cameras):
        rows = observations.camera == side
        x, y = ((observations.uv[rows] + 0.5) * 2.0 / np.array(camera.image_size_px) - 1.0).T
        fields = chebvander2d(x, y, (_FIELD_DEGREE, _FIELD_DEGREE)).reshape(len(x), _FIELD_DEGREE + 1, -1)
        basis = np.stack([fields[:, i, k] for i, k in powers], axis=1)
        explained += float(((basis @ np.linalg.lstsq(basis, residuals[rows])[0]) ** 2).sum())
    whole = float((residuals**2).sum())
    by_chance = chi_square_limit(4 * len(powers), _FIELD_CHANCE) / residuals.size
    return float(np.sqrt(explained / len(residuals))) if explained > max(_FIELD_SHARE, by_chance) * whole else None


def _moved(calibration: Calibration, motion: ExposureMotion) -> str | None:
    ways = np.linalg.norm(calibration.solution.state.motions[:, :3], axis=1)
    far = [int(j) for j in np.argsort(-ways) if ways[j] > _FAR_MOTION * np.sqrt(3) * motion.rms_m][:_FARTHEST]
    rig, solution, n = calibration.rig, calibration.solution, len(ways)
    axes = rig.T_left_right[:3, :3] @ baseline_axes(rig.T_left_right)
    R = axes.T @ solution.state.Ts_left_body[:n, :3, :3]
    v = (R @ solution.state.motions[:, :3, None])[..., 0]
    squares = (v**2 / np.diagonal(R @ solution.cov_motions[:, :3, :3] @ R.swapaxes(1, 2), axis1=1, axis2=2)).mean(
        axis=0
    )
    if squares[1:].mean() < _ALONG * squares[0]:
        return (
            "between the two images boards are displaced along the line of the cameras alone, as boards of different sizes "
            f"are, by {100 * np.std(v[:, 0]) / rig.baseline_m:.2g} % RMS: do the pairs show two boards? The rig is "
            "of neither: calibrate from the pairs of one alone. If the board slid along that line, trigger both cameras "
            "together"
        )
    most = "".join(f", {calibration.pairs[j]} by {1e3 * ways[j]:.1f} mm" for j in far)
    if (field_px := _by_position(calibration)) is not None:
        return (
            f"residuals of {field_px:.2f} px RMS depend on the position in the images, as of lenses that the model cannot "
            "express; what looks like boards that moved between the two exposures, by "
            f"{1e3 * motion.rms_m:.2f} mm RMS along each axis{most}, may be the lenses too: try a richer --lens-model, "
            "look for a lens that is loose or behind a window, and hold the board still to distinguish the two"
        )
    way_px, corner_px = _way_px(calibration, motion), float(np.sqrt(corner_variance_px2(calibration).min()))
    if way_px**2 * len(calibration.body.points) < corner_px**2:  # it moves a pose by less than the corners' noise
        return None
    return (
        f"the board moved between the two exposures of a pair, by {1e3 * motion.rms_m:.2g} mm and "
        f"{1e3 * motion.rms[1]:.2g} mrad RMS along and about each axis ({way_px:.2g} px{most}): the cameras are not "
        f"synchronised. The rig's noise of {calibration.rig.sigma_px:.2g} px allows for a body that moves like that, the "
        f"corners alone have {calibration.solution.sigma_px:.2g} px: hold still what is measured, or trigger both cameras "
        f"together.{'' if calibration.recorded else _RECORD}"
    )


def _sides(calibration: Calibration) -> str | None:
    R = calibration.rig.T_left_right[:3, :3]
    roll_deg = float(np.degrees(np.arctan2(R[1, 0], R[0, 0])))
    if abs(roll_deg) > _ROLLED_DEG:
        return (
            f"the left and the right images are rotated against each other by {abs(roll_deg):.0f} degrees: is a camera "
            "mounted so, or does a driver rotate its images? (the result is valid for images as they were given)"
        )
    return None


def require_order(calibration: Calibration) -> None:
    """Reject a rig whose right camera stands to the left of the other (CalibrationError)."""
    x, y, _ = calibration.rig.T_left_right[:3, 3]
    if x < 0 and abs(x) > abs(y):
        raise CalibrationError(
            "left and right are exchanged: the camera given as right stands to the left of the other; exchange the two "
            "globs (of a recording or a video: its two sides). If they are right, all images are upside down (mount or "
            "rotate both cameras alike), or mirrored by the driver, which gives a mirrored world: switch it off"
        )


def _focal(calibration: Calibration) -> str | None:
    share = float(np.sqrt(np.diag(calibration.rig.cov))[0] / calibration.rig.left.intrinsics[0])
    if share > 0.005:
        return (
            f"the focal length is known to {100 * share:.1f}% only, and distances with it: add tilted boards at several "
            "distances"
        )
    return None


def _scale(calibration: Calibration) -> str | None:
    scale = calibration.errors.scale
    spread = float(np.std(scale, ddof=1) / np.sqrt(len(scale))) if len(scale) > 2 else np.inf
    error = calibration.held_out.scale_error
    if abs(error) > max(0.005, _SCALE_SIGMAS * spread):
        return (
            f"held-out boards come out {100 * error:+.2f}% too {'large' if error > 0 else 'small'}: lens and board do "
            "not fit each other; is the board flat, and as wide as specified? (a wrong square size does not show here: it "
            "makes baseline and board wrong alike, so measure a square)"
        )
    return None
