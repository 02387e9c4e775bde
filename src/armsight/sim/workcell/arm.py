"""The imperfections of an arm: how far it differs from its table, by a preset or a TOML file, sampled from a seed.

In: the nominal arm, :class:`Imperfections` and a seed. Out: a :class:`TrueArm`. Base and tool are the frames of the true
arm that the nominal table means: an error of joint 1's height or zero, or of the last row, would only be another choice
of these two frames, which no motion can distinguish, so these have no errors. The documentation's page on the workcell
has the amounts.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.files import read_toml
from armsight.robot.kinematics.arm import Arm

#: Rows of the table whose amounts say more than where base and tool are.
_LENGTHS, _OFFSETS, _TWISTS, _ZEROS = slice(0, -1), slice(1, -1), slice(0, -1), slice(1, -1)
_SINES = 3  # of which a potentiometer's linearity error is made
_CYCLES = (2.0, 9.0)  # how often they swing over its travel


@dataclass(frozen=True)
class Imperfections:
    """How far an arm is from its table. Amounts are typical ones: an arm's own are sampled from 0.5 to 1.5 of them."""

    length_m: float = 0.0  #: error of link lengths and offsets, m
    angle_rad: float = 0.0  #: error of link twists, rad
    zero_rad: float = 0.0  #: error of the joints' zeros, rad
    #: least and greatest backlash between a gear's shaft and its link, rad, from stop to stop
    backlash_rad: tuple[float, float] = (0.0, 0.0)
    compliance_rad: float = 1e-4  #: twist of a joint under the greatest gravity load it carries, rad
    pot_linearity: float = 0.0  #: greatest deviation of a potentiometer from its straight line, share of its travel
    pot_offset_rad: float = 0.0  #: error of a potentiometer's zero, rad
    pot_noise_lsb: float = 1.0  #: noise of one conversion, steps of the converter
    adc_bits: int = 12  #: of the converter
    oversampling: int = 64  #: conversions averaged in a tick
    friction: float = 1.0  #: friction of the motors and gears, of what is usual


_USED = Imperfections(
    length_m=0.5e-3,
    angle_rad=np.deg2rad(0.15),
    zero_rad=np.deg2rad(0.25),
    backlash_rad=(np.deg2rad(0.05), np.deg2rad(0.15)),
    compliance_rad=np.deg2rad(0.05),
    pot_linearity=1e-4,
    pot_offset_rad=np.deg2rad(0.05),
)
#: Name -> how far the arm is from its table.
PRESETS = {
    "nominal": Imperfections(),
    "used": _USED,
    "worn": Imperfections(
        length_m=1e-3,
        angle_rad=np.deg2rad(0.3),
        zero_rad=np.deg2rad(0.5),
        backlash_rad=(np.deg2rad(0.1), np.deg2rad(0.3)),
        compliance_rad=np.deg2rad(0.1),
        pot_linearity=2e-4,
        pot_offset_rad=np.deg2rad(0.1),
        pot_noise_lsb=1.5,
        friction=1.3,
    ),
}
#: Key of a file -> attribute, factor to SI, least and greatest, as the file gives it.
_KEYS: dict[str, tuple[str, float, float, float]] = {
    "length_mm": ("length_m", 1e-3, 0.0, 20.0),
    "angle_deg": ("angle_rad", np.pi / 180, 0.0, 5.0),
    "zero_deg": ("zero_rad", np.pi / 180, 0.0, 10.0),
    "backlash_deg": ("backlash_rad", np.pi / 180, 0.0, 5.0),
    "compliance_deg": ("compliance_rad", np.pi / 180, 0.005, 2.0),
    "pot_linearity_percent": ("pot_linearity", 1e-2, 0.0, 5.0),
    "pot_offset_deg": ("pot_offset_rad", np.pi / 180, 0.0, 10.0),
    "pot_noise_lsb": ("pot_noise_lsb", 1.0, 0.0, 50.0),
    "adc_bits": ("adc_bits", 1, 8, 16),
    "oversampling": ("oversampling", 1, 1, 256),
    "friction": ("friction", 1.0, 0.0, 3.0),
}

#: Keys of files of earlier versions -> today's.
_OLD_KEYS = {"sag_deg": "compliance_deg"}


def imperfections(arm: str) -> Imperfections:
    """Return a preset, a key of PRESETS, or what a TOML file says; InputError names what is not allowed."""
    if arm in PRESETS:
        return PRESETS[arm]
    if not arm.endswith(".toml"):
        known = f"{', '.join(PRESETS)}, or a TOML file (docs/howto/workcell.md)"
        hint = f"; a file's name must end in .toml: {arm}" if os.path.isfile(arm) else ""
        raise InputError(f"arm {arm!r} is unknown; known are {known}{hint}")
    given = read_toml(arm)
    preset = given.pop("preset", "nominal")
    if preset not in PRESETS:
        raise InputError(f"{arm}: preset is {preset!r}; known are {', '.join(PRESETS)}")
    changes: dict[str, Any] = {_key(arm, key)[0]: _value(arm, key, value) for key, value in given.items()}
    return replace(PRESETS[preset], **changes)


def _key(path: str, key: str) -> tuple[str, float, float, float]:
    key = _OLD_KEYS.get(key, key)
    if key not in _KEYS:
        raise InputError(f"{path}: unknown key {key!r}; known are preset, {', '.join(_KEYS)}")
    return _KEYS[key]


def _value(path: str, key: str, value: object) -> float | int | tuple[float, float]:
    """Return the value of a key, in SI units."""
    _, factor, low, high = _key(path, key)
    numbers = value if isinstance(value, list) else [value]
    pair = key == "backlash_deg"
    whole = isinstance(factor, int)
    good = len(numbers) == 1 + pair and isinstance(value, list) == pair
    for n in numbers:
        good = good and isinstance(n, int if whole else int | float) and not isinstance(n, bool) and low <= n <= high
    if not good or numbers != sorted(numbers):
        what = f"[least, greatest], both {low:g} to {high:g}" if pair else f"{low:g} to {high:g}"
        raise InputError(f"{path}: {key} must be {'a whole number, ' if whole else ''}{what}, got {value!r}")
    si = [n * factor for n in numbers]
    return (si[0], si[1]) if pair else si[0]


@dataclass(frozen=True, eq=False)
class TrueArm(Record):
    """The true arm: its table, its backlash (n,) from stop to stop, and its potentiometers' errors, rad.

    ``pot_sines`` (n, 3, 3): amplitude, rad; cycles over the travel; phase, rad: each potentiometer's linearity error.
    """

    arm: Arm
    backlash_rad: Array
    pot_offset_rad: Array
    pot_sines: Array
    imperfections: Imperfections


def sample_arm(model: Arm, given: Imperfections, seed: int) -> TrueArm:
    """Sample a true arm, as far from the nominal table as given; a seed gives the same arm."""
    rng, n = np.random.default_rng([seed, 1]), model.joints

    def about(amount: float, rows: slice) -> Array:
        out = np.zeros(n)
        size = rng.uniform(0.5, 1.5, n) * rng.choice([-1.0, 1.0], n)
        out[rows] = amount * size[rows]
        return out

    a, d = model.a + about(given.length_m, _LENGTHS), model.d + about(given.length_m, _OFFSETS)
    alpha, offset = model.alpha + about(given.angle_rad, _TWISTS), model.offset + about(given.zero_rad, _ZEROS)
    backlash = rng.uniform(*given.backlash_rad, n)
    pot_offset = about(given.pot_offset_rad, _ZEROS)
    share = rng.dirichlet(np.full(_SINES, 2.0), n)
    travel = pot_travel(model)
    sines = np.stack(
        [
            given.pot_linearity * np.ptp(travel, axis=1)[:, None] * share,
            rng.uniform(*_CYCLES, (n, _SINES)),
            rng.uniform(0, 2 * np.pi, (n, _SINES)),
        ],
        axis=2,
    )
    true = replace(model, name=f"{model.name} as it is", a=a, d=d, alpha=alpha, offset=offset)
    return TrueArm(true, backlash, pot_offset, sines, given)


def pot_travel(model: Arm) -> Array:
    """Return the joint angles (n, 2), rad, at the two ends of each potentiometer's used travel."""
    margin = np.deg2rad(10.0)
    return np.stack([model.q_min - margin, model.q_max + margin], axis=1)
