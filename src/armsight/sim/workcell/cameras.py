"""When the cell's cameras look, and when their images arrive; where they stand.

Shot k is exposed about ``phase + k / rate``; the right camera by ``skew`` later, give or take ``sync``. An image arrives
``delay`` after its exposure has ended, and is stamped then, give or take ``jitter``. Everything about shot k follows
from the seed and k alone.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, pose
from armsight.robot.arm import Arm
from armsight.sim.example_rig import bench_rig
from armsight.sim.render.render import Shutter
from armsight.vision.rig import StereoRig

_FORM = "WIDTHxHEIGHT@HZ, webcams, or webcams:WIDTHxHEIGHT@HZ; such as 1280x720@60 or 1920x1080@120"
#: Focal length over the image's width: 900 px at 1280.
_FOCAL = 900 / 1280
_WIDTHS, _RATES = (320, 3840), (1.0, 500.0)
#: Where the cameras' middle is, seen from where the body is at home: distance, m; to the side and up, degrees.
DISTANCE_M, ASIDE_DEG, ABOVE_DEG = 0.85, 14.0, 12.0
_AIM_M = 0.10  # they aim at a place so far behind the body, at home: the arm works there
BASELINE_M = 0.2


@dataclass(frozen=True)
class Timing:
    """How two cameras keep time.

    Attributes:
        image_size_px: (width, height).
        rate_hz: shots a second.
        exposure_s: how long a row gathers light.
        delay_s: from the end of the exposure until the image has arrived.
        jitter_s: standard deviation of the stamp, beside the arrival.
        sync_s: the two exposures begin so far apart at most, by chance.
        skew_s: by how much the right one is later, always.
        row_s: how much later each row begins than the one above; 0 is a global shutter.
    """

    image_size_px: tuple[int, int] = (1280, 720)
    rate_hz: float = 60.0
    exposure_s: float = 0.002
    delay_s: float = 0.012
    jitter_s: float = 5e-5
    sync_s: float = 1e-4
    skew_s: float = 0.0
    row_s: float = 0.0

    @property
    def shutter(self) -> Shutter:
        """How each camera exposes."""
        return Shutter(self.exposure_s, self.row_s)


WEBCAMS = Timing((1280, 720), 30.0, 0.008, 0.040, 1e-3, 5e-4, 4e-3, 2e-5)


@dataclass(frozen=True)
class ShotTimes:
    """When a shot was taken and came.

    Attributes:
        left_s: middle of the left exposure (of the middle row), s.
        right_s: of the right one.
        stamp_s: when the driver says that it came; it is handed out from then on.
    """

    left_s: float
    right_s: float
    stamp_s: float


@lru_cache(maxsize=256)
def shot_times(timing: Timing, seed: int, shot: int) -> ShotTimes:
    """Return the times of a shot.

    Args:
        timing: of the cameras.
        seed: of the cell.
        shot: its number, from 0.
    """
    phase = np.random.default_rng([seed, 6]).uniform(0.0, 1.0)
    rng = np.random.default_rng([seed, 7, shot])
    left = (phase + shot) / timing.rate_hz + timing.exposure_s / 2
    apart = timing.skew_s + rng.uniform(-timing.sync_s, timing.sync_s)
    late = timing.exposure_s / 2 + timing.delay_s + timing.jitter_s * float(np.clip(rng.standard_normal(), -3, 3))
    return ShotTimes(left, left + apart, left + max(late, timing.exposure_s / 2))


def open_timing(spec: str) -> Timing:
    """Return the timing that a user asks for.

    Args:
        spec: ``WIDTHxHEIGHT@HZ``, ``webcams`` or ``webcams:WIDTHxHEIGHT@HZ``.

    Raises:
        InputError: of another form, or out of range.
    """
    text = spec.strip()
    base = WEBCAMS if text.startswith("webcams") else Timing()
    if text == "webcams":
        return base
    match = re.fullmatch(r"(?:webcams:)?(\d+)x(\d+)@(\d+(?:\.\d+)?)", text)
    if not match:
        raise InputError(f"cameras {spec!r}: expected {_FORM}")
    width, height, rate = int(match[1]), int(match[2]), float(match[3])
    if not _WIDTHS[0] <= width <= _WIDTHS[1] or not 240 <= height <= width:
        raise InputError(
            f"cameras {spec!r}: images must be {_WIDTHS[0]} to {_WIDTHS[1]} px wide, 240 px to the width high"
        )
    if not _RATES[0] <= rate <= _RATES[1]:
        raise InputError(f"cameras {spec!r}: the rate must be {_RATES[0]:g} to {_RATES[1]:g} Hz")
    exposure = min(base.exposure_s, 0.5 / rate)
    return replace(
        base, image_size_px=(width, height), rate_hz=rate, exposure_s=exposure, row_s=base.row_s * 720 / height
    )


#: Name -> by how much the right camera turns to the left one's axis, as a share of what would make them look at one
#: place DISTANCE_M away; parallel cameras are parallel to a fraction of a degree, as mounts are.
RIGS = {"parallel": 0.02, "verging": 1.0}


def open_rig(name: str, size: tuple[int, int], baseline_m: float = BASELINE_M) -> StereoRig:
    """Return the true cameras of a preset.

    Args:
        name: a key of RIGS.
        size: (width, height) of their images, px.
        baseline_m: distance between them.

    Raises:
        InputError: unknown, or a distance that is none.
    """
    if name not in RIGS:
        raise InputError(f"rig {name!r} is unknown; known are {', '.join(RIGS)}")
    if not 0.02 <= baseline_m <= 1.0:
        raise InputError(f"baseline_m is {baseline_m}; the cameras must be 0.02 to 1 m apart")
    turn_deg = RIGS[name] * float(np.degrees(np.arctan2(baseline_m, DISTANCE_M)))
    return bench_rig(size, _FOCAL * size[0], baseline_m, turn_deg)


def placed_rig(model: Arm, rig: StereoRig, T_tool_body: Array, seed: int, distance_m: float = DISTANCE_M) -> Array:
    """Return where the rig's left camera stands, T_base_rig (4, 4), m: it looks at the body of an arm at home.

    Args:
        model: the nominal arm.
        rig: the cameras.
        T_tool_body: (4, 4) where the body is on the tool, m.
        seed: nobody mounts cameras to the millimetre.
        distance_m: from the cameras to the body of an arm at home.

    Raises:
        InputError: the distance is no use.
    """
    if not 0.3 <= distance_m <= 3.0:
        raise InputError(f"distance_m is {distance_m}; the cameras must be 0.3 to 3 m from the body")
    T_base_tool = model.forward(model.home)
    p_body = (T_base_tool @ T_tool_body)[:3, 3]
    ahead = T_base_tool[:3, 2]
    up = np.array([0.0, 0.0, 1.0]) if abs(ahead[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    across = np.cross(ahead, up)
    across /= np.linalg.norm(across)
    aside, above = np.radians((ASIDE_DEG, ABOVE_DEG))
    level = np.cross(up, across) if ahead @ np.cross(up, across) > 0 else -np.cross(up, across)
    towards = np.cos(above) * (np.cos(aside) * level + np.sin(aside) * across) + np.sin(above) * up
    z = p_body - _AIM_M * level - (p_body + distance_m * towards)
    z /= np.linalg.norm(z)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    T_base_middle = pose(np.column_stack([x, np.cross(z, x), z]), p_body + distance_m * towards)
    T_middle_left = pose(np.eye(3), -0.5 * rig.T_left_right[:3, 3])
    off = np.random.default_rng([seed, 8]).normal(0, 1, 6) * np.repeat((0.004, np.radians(0.4)), 3)
    return np.asarray(T_base_middle @ T_middle_left @ exp_se3(off))
