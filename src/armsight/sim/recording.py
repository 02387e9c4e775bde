"""Recordings with truth: what two cameras of a known rig see of a known target at known poses, in a folder.

A folder holds left000.png, right000.png and so on, ``shots.csv`` as ``armsight record`` writes it, ``truth_rig.json`` (a
rig file) and ``truth.json``: where the target was in every shot. So ``armsight calibrate`` and ``measure`` run on it as
on a recording of real cameras, and their results can be compared with the truth. Everything comes from one seed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from armsight.data import SIDES, Array, Image, Record
from armsight.errors import InputError
from armsight.files import as_input_error, made_folder, read_json, replacing, write_text
from armsight.geometry.check import checked
from armsight.sim.render.background import BACKGROUNDS
from armsight.sim.render.optics import Optics, Sensor
from armsight.sim.render.render import Shutter, render_pair
from armsight.sim.render.scene import Pattern, PosedBody
from armsight.vision.rig import StereoRig
from armsight.vision.sources.folder import COLUMNS, INDEX

FORMAT, VERSION = "armsight-truth", 1
TRUTH, TRUTH_RIG = "truth.json", "truth_rig.json"


@dataclass(frozen=True, eq=False)
class Truth(Record):
    """The true values of a recording: the rig, covariance zero, and poses Ts_left_body (N, 4, 4), m, at times (N,), s.

    ``target`` is what they saw, as ``--target`` takes it; ``shots`` are names, in order.
    """

    rig: StereoRig
    target: str
    shots: tuple[str, ...]
    times_s: Array
    Ts_left_body: Array

    def save(self, folder: str | Path) -> None:
        """Write ``truth_rig.json`` and ``truth.json`` into a folder."""
        self.rig.save(Path(folder) / TRUTH_RIG)
        shots = [
            {"shot": shot, "t_s": t, "T_left_body_m": T}
            for shot, t, T in zip(self.shots, self.times_s.tolist(), self.Ts_left_body.tolist(), strict=True)
        ]
        document = {"format": FORMAT, "version": VERSION, "target": self.target, "rig": TRUTH_RIG, "shots": shots}
        write_text(Path(folder) / TRUTH, json.dumps(document, indent=1) + "\n")

    @staticmethod
    def load(folder: str | Path) -> Truth:
        """Read the truth of a recording; InputError names a file that is missing or is none."""
        path = Path(folder) / TRUTH
        with as_input_error(f"{path}: not the truth of a recording", KeyError, TypeError, why=True):
            document = read_json(path)
            if document["format"] != FORMAT or document["version"] > VERSION:
                raise InputError(f"{path}: expected format {FORMAT}, version up to {VERSION}")
            entries = document["shots"]
            return Truth(
                StereoRig.load(path.parent / document["rig"]),
                str(document["target"]),
                tuple(str(entry["shot"]) for entry in entries),
                checked([entry["t_s"] for entry in entries], (None,), "t_s"),
                checked([entry["T_left_body_m"] for entry in entries], (None, 4, 4), "T_left_body_m"),
            )


@dataclass(frozen=True)
class Look:
    """The appearance of a recording: lenses and light, sensors, shutters, and a key of BACKGROUNDS."""

    optics: Optics = field(default_factory=lambda: Optics(0.7, vignetting=0.25, light_gradient=(0.2, -0.1)))
    sensor: Sensor = field(default_factory=Sensor)
    shutter: Shutter = field(default_factory=Shutter)
    background: str = "cluttered"


def record(
    folder: str | Path,
    truth: Truth,
    patterns: Sequence[Pattern],
    *,
    twists: Array | None = None,
    look: Look | None = None,
    seed: int = 0,
    threads: int = 2,
) -> None:
    """Render a recording of patterns into a folder, with the truth beside the images.

    ``twists`` (N, 6): velocity of the target in its own axes at each shot, for its blur; ``threads``: how many shots
    are rendered at once, which the images do not depend on.
    """
    folder, look = made_folder(Path(folder)), look or Look()
    twists = np.zeros((len(truth.shots), 6)) if twists is None else twists
    wall, *seeds = np.random.SeedSequence(seed).spawn(1 + len(truth.shots))
    rng = np.random.default_rng(wall)
    backgrounds = [BACKGROUNDS[look.background](camera.image_size_px, rng) for camera in truth.rig.cameras]

    def shoot(n: int) -> None:
        body = PosedBody(tuple(patterns), truth.Ts_left_body[n], twists[n])
        images = render_pair(
            truth.rig.cameras,
            truth.rig.T_left_right,
            [body],
            (backgrounds[0], backgrounds[1]),
            optics=look.optics,
            sensor=look.sensor,
            shutter=look.shutter,
            rng=np.random.default_rng(seeds[n]),
        )
        for side, image in zip(SIDES, images, strict=True):
            _write_png(folder / _file_name(side, truth.shots[n]), image)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(shoot, range(len(truth.shots))))
    lines = [",".join(COLUMNS)]
    for shot, t in zip(truth.shots, truth.times_s, strict=True):
        lines.append(f"{shot},{t:.6f},{_file_name('left', shot)},{_file_name('right', shot)},")
    write_text(folder / INDEX, "\n".join(lines) + "\n")
    truth.save(folder)


def shot_names(count: int) -> tuple[str, ...]:
    """Return names for so many shots: 000, 001, ..."""
    digits = max(3, math.ceil(math.log10(max(count, 1))))
    return tuple(f"{n:0{digits}d}" for n in range(count))


def _file_name(side: str, shot: str) -> str:
    return f"{side}{shot}.png"


def _write_png(path: Path, image: Image) -> None:
    """Write an image in one step; noise does not compress, so little time is spent on trying."""
    _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    with replacing(path, "wb") as file:
        file.write(data.tobytes())
