"""``armsight rig``: show a rig file, convert rigs from and to other programs' formats, update one from a run."""

from __future__ import annotations

import math
import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armsight.app.options import IS_RIG, JSON, argument, declared, kept, option, out
from armsight.app.show.messages import note, print_answer
from armsight.errors import InputError
from armsight.files import check_outputs, check_writable
from armsight.vision.rigfiles import ASSUMED_SIGMA_PX, EXPORTED, FORMATS, export_rig, import_rig, open_format

if TYPE_CHECKING:
    from armsight.vision.rig import StereoRig

#: How the files of another program begin.
_FOREIGN = "^(%YAML|image_width:|cam0:)"


@click.group("rig")
def command() -> None:
    """Show a rig file, import a rig of another program, export one, or update one from what a run saw.

    Read are OpenCV's stereo calibrations (YAML, XML, JSON, .npz, any names), ROS's camera_info (left.yaml
    right.yaml), Kalibr's and OpenVINS's camchain.yaml, EuRoC's sensor.yaml, Basalt, ORB-SLAM, caliscope, aniposelib,
    multical, mrcal (left.cameramodel right.cameramodel), Stereolabs (SN*.conf), Luxonis (eepromToJsonFile)
    and MATLAB's stereoParameters (jsonencode).
    """


@command.command()
@declared
def show(path: str = argument("RIG.json"), as_json: bool = JSON) -> None:
    """Print the contents of a rig file, with standard deviations where they are known."""
    from armsight.vision.rig import StereoRig

    rig = StereoRig.load(path)
    print_answer(as_json, _json(path, rig), *_lines(rig))


@command.command("import")
@declared
def import_(
    files: tuple[str, ...] = argument(required=True),
    output: str = out("RIG.json", "The rig file to write.", kind=IS_RIG),
    name: str | None = option("The other program; by default found by content.", "--format", choices=FORMATS),
    unit_m: float | None = option("Length of the file's unit of translation, m; OpenCV files need it."),
    pair: str | None = option(
        "Names of the two cameras in a file of more; by default the first two.", metavar="LEFT,RIGHT"
    ),
    image_size: str | None = option("Image size, px; OpenCV files without one need it.", metavar="WxH"),
    sigma_px: float = option("Standard deviation of a detection, px.", default=ASSUMED_SIGMA_PX),
    as_json: bool = JSON,
) -> None:
    """Convert another program's calibration to a rig file. Its uncertainty is unknown, which the rig file records."""
    size = None if image_size is None else _image_size(image_size)
    check_writable(output, apart_from=files)
    names = None if pair is None else tuple(one.strip() for one in pair.split(","))
    if names is not None and (len(names) != 2 or names[0] == names[1]):
        raise InputError(f"--pair {pair}: expected the names of two cameras, left first, such as cam0,cam1")
    chosen = None if names is None else (names[0], names[1])
    rig = import_rig(name, files, unit_m=unit_m, image_size_px=size, sigma_px=sigma_px, pair=chosen)
    rig.save(output)
    note(*(f"{key}: {rig.provenance[key]}" for key in ("uncertainty", "sigma_px")))
    note(*rig.provenance["notes"])
    print_answer(as_json, _json(output, rig), f"{output}: baseline {rig.baseline_m * 1e3:.3f} mm")


@command.command()
@declared
def export(
    path: str = argument("RIG.json"),
    more: tuple[str, ...] = argument("[OUT]...", callback=partial(kept, kind=_FOREIGN)),
    output: tuple[str, ...] = out("OUT", "File to write; may be repeated.", kind=_FOREIGN, required=True),
    name: str = option("The other program.", "--format", choices=EXPORTED),
    as_json: bool = JSON,
) -> None:
    """Write a rig for another program, and print what its format cannot hold.

    OUT are the format's files in the order of armsight rig -h, such as -o left.yaml -o right.yaml; after the first -o the
    others may also follow by themselves: -o left.yaml right.yaml. The rectification in files of opencv and ros (R1 R2 P1 P2
    Q) has alpha 0: all pixels of the rectified images are valid.
    """
    from armsight.vision.rig import StereoRig
    from armsight.vision.rigfiles.rigfile import ALPHA

    paths = (*output, *more)
    check_outputs(paths, (path,))
    lost = export_rig(StereoRig.load(path), name, paths)
    alpha = ALPHA if open_format(name).rectifies else None
    if alpha is not None:
        note(f"the rectification in it has alpha {alpha:g}: all pixels of the rectified images are valid")
    note(*(f"not in the {name} format: {what}" for what in lost))
    answer = {"rig": path, "format": name, "files": paths, "lost": lost, "rectification_alpha": alpha}
    print_answer(as_json, answer, " ".join(paths))


@command.command("update")
@declared
def update_(
    run: Path = argument(),
    output: str = out("RIG.json", "The rig file to write.", kind=IS_RIG),
    since: float | None = option(
        "Use shots from this time on, board's clock, s; by default from when the run found that the cameras had moved.",
        metavar="S",
    ),
    report: Path | None = out("DIR", "Folder for a page: old rig beside new.", "--report", report=True),
    as_json: bool = JSON,
) -> None:
    """Estimate the relative pose of a run's cameras again, from the body that the run saw: without a board.

    RUN is the folder of armsight run or armsight demo. The body's file gives the scale; the calibration stays the prior of
    lenses and baseline. Rejected where the shots say too little.
    """
    from armsight.app.rig.update import update

    check_writable(output, apart_from=(run / "rig.json", run / "body.toml", run / "detections.csv"))
    answer, lines = update(run, Path(output), since, report)
    print_answer(as_json, answer, *lines)


def _image_size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text.strip())
    if match is None:
        raise InputError(f"--image-size {text!r}: expected WIDTHxHEIGHT in pixels, such as 1280x720")
    return int(match[1]), int(match[2])


def _sigmas(rig: StereoRig) -> dict[str, float]:
    """Return the standard deviation of each parameter by its name; 0 where it is unknown."""
    variances = rig.cov.diagonal().tolist()
    return {name: math.sqrt(max(value, 0.0)) for name, value in zip(rig.parameter_names, variances, strict=True)}


def _json(path: str, rig: StereoRig) -> dict[str, Any]:
    return {
        "rig": str(Path(path)),
        **{
            side: {
                "image_size_px": camera.image_size_px,
                "distortion_model": camera.model,
                "intrinsics_px": camera.intrinsics.tolist(),
                "distortion": camera.distortion.tolist(),
            }
            for side, camera in zip(("left", "right"), rig.cameras, strict=True)
        },
        "T_left_right_m": rig.T_left_right.tolist(),
        "baseline_m": rig.baseline_m,
        "baseline_sigma_m": rig.baseline_sigma_m or None,
        "convergence_deg": rig.convergence_deg,
        "sigma_px": rig.sigma_px,
        "sigmas": {name: sigma or None for name, sigma in _sigmas(rig).items()},
        "shutters": None if rig.shutters is None else rig.shutters.to_json(),
        "disc_noise": None
        if rig.disc_noise is None
        else dict(zip(("left", "right"), (noise.to_json() for noise in rig.disc_noise), strict=True)),
        "provenance": dict(rig.provenance),
    }


def _lines(rig: StereoRig) -> list[str]:
    sigmas, lines = _sigmas(rig), list[str]()
    for side, camera in zip(("left", "right"), rig.cameras, strict=True):
        names = [name for name in rig.parameter_names if name.startswith(f"{side}.")]
        lines.append(f"{side}: {camera.image_size_px[0]}x{camera.image_size_px[1]} px, distortion {camera.model}")
        for name, value in zip(names, camera.parameters, strict=True):
            sigma = f" +- {sigmas[name]:.2g}" if sigmas[name] > 0 else ""
            lines.append(f"  {name.removeprefix(f'{side}.'):6} {value:.6g}{sigma}")
    spread = f" +- {rig.baseline_sigma_m * 1e3:.2g}" if rig.baseline_sigma_m else ""
    x, y, z = rig.T_left_right[:3, 3] * 1e3
    lines += [
        f"baseline: {rig.baseline_m * 1e3:.3f}{spread} mm, right camera at ({x:.3f}, {y:.3f}, {z:.3f}) mm",
        f"convergence: {rig.convergence_deg:.3f} deg",
        f"detection sigma: {rig.sigma_px:.3g} px",
    ]
    if rig.shutters is not None:
        lines.append(f"shutters: {rig.shutters}")
    if rig.disc_noise is not None:
        left, right = rig.disc_noise
        lines.append(f"variance of discs' centres over what an image says: left {left}, right {right}")
    if not rig.cov.any():
        lines.append("uncertainty: unknown (no covariance in this rig file)")
    made = rig.provenance.items()
    return [*lines, *(f"{key}: {value:.4g}" if isinstance(value, float) else f"{key}: {value}" for key, value in made)]
