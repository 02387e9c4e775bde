"""An identified arm in use: the pose of its tool at given joint readings, and the readings that reach a given pose.

Also the arm for other programs: an :class:`Arm` with the corrected table, a URDF with Hayati's angles in its origins,
corrected.toml, and what the board adds to its readings (:func:`zeros_text`). :func:`open_corrected` reads corrected.toml
with everything that corrects; :mod:`armsight.robot.arm_file` reads its table alone, as an :class:`Arm`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.files import read_toml, write_text
from armsight.geometry.pose import inverse, log_se3, pose
from armsight.geometry.rotation import nearest_rotation, quaternion_wxyz
from armsight.loop.identify import model as chain
from armsight.loop.identify.identify import Identified
from armsight.loop.identify.model import FAST, RIPPLES, SENSOR, Feature, Model, all_features
from armsight.robot.arm_file import (
    LIMITS,
    MOVED,
    VERSION,
    file_transform,
    identified_table,
    joint_numbers,
    tilted_urdf,
    tool_moved,
)
from armsight.robot.kinematics.arm import Arm

#: Newton steps to a reading, what counts as there, m and rad, and the step of differences, rad.
STEPS, THERE, STEP_RAD = 30, 1e-9, 1e-6
_OLD_NAMES = {"slack": "gravity_backlash", "sag": "compliance"}  # names of version 1 -> names now
#: Columns of the table -> their units; of the nominal one, which gives the levers of gravity.
_UNITS = {"offset": "rad", "d": "m", "a": "m", "alpha": "rad", "beta": "rad"}
_NOMINAL = {key: unit for key, unit in _UNITS.items() if key != "beta"}


@dataclass(frozen=True, eq=False)
class Corrected(Record):
    """An identified arm.

    Attributes:
        model: the nominal arm with every parameter.
        x: (P,) the vector.
        sigma: (P,) of every parameter, zero where it was not fitted.
        moved_m: as :meth:`Identified.moved_all_over`; NaN where it is not known.
        notes: what was missing in the file that it was read from, as text.
    """

    model: Model
    x: Array
    sigma: Array
    moved_m: tuple[float, float] = (np.nan, np.nan)
    notes: tuple[str, ...] = ()

    @staticmethod
    def of(found: Identified) -> Corrected:
        """Return what was identified, ready for use."""
        sigma = np.where(found.solution.free, np.sqrt(np.diag(found.cov)), 0.0)
        return Corrected(found.model, found.solution.x, sigma, found.moved_all_over())

    def zeros_rad(self) -> Array:
        """Return by how much each joint is further than it reads at zero (n,), rad, beside the nominal table."""
        model = self.model
        return np.asarray((model.table(self.x) - model.table(model.nominal()))[:, chain.OFFSET] * model.arm.direction)

    def joint_corrections(self, q: Array, approach: Array | None = None) -> Array:
        """Return what the error sources add to readings q (N, n), (N, n), rad: curves, backlash and compliance.

        Beyond the readings that were seen (``model.q_seen``) a sensor's curve fades to its mean over them.
        """
        theta = self.model.theta(self.x, q, self.model.feature_values(q, approach))
        return np.asarray(self.model.arm.direction * theta - q)

    def forward(self, q: Array, approach: Array | None = None) -> Array:
        """Return T_base_body (4, 4) at readings q (n,), rad; (N, 4, 4) at (N, n). ``approach`` as of :class:`Measured`."""
        sides = None if approach is None else np.atleast_2d(approach)
        Ts = self.model.tool_in_base(self.x, np.atleast_2d(q), sides)
        return np.asarray(Ts[0] if np.ndim(q) == 1 else Ts)

    def readings(self, T_base_body: Array, near: Array, approach: Array | None = None) -> Array | None:
        """Return the readings (n,), rad, at which the body is at a pose, nearest to ``near``; None out of reach.

        ``T_base_body``: (4, 4) where the body shall be. ``near``: (n,) readings to start from. ``approach``: (n,) from
        which sides the joints will come.
        """
        q, near_by = np.array(near, float), np.vstack([np.zeros(len(near)), STEP_RAD * np.eye(len(near))])
        sides = None if approach is None else np.tile(approach, (len(near_by), 1))
        for _ in range(STEPS):
            back = inverse(T := self.forward(q + near_by, sides))[0]
            e = log_se3(back @ T_base_body)
            if np.abs(e).max() < THERE:
                return q
            step = np.linalg.lstsq(log_se3(back @ T[1:]).T / STEP_RAD, e, rcond=1e-9)[0]
            q = q + step * min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-12))
        return None

    def save(self, path: str | Path) -> None:
        """Write corrected.toml, which :func:`open_corrected` reads as the same arm.

        Raises:
            InputError: it cannot be written.
        """
        write_text(Path(path), table_text(self))

    def arm(self) -> Arm:
        """Return the corrected table without Hayati's angles and error sources, for which :class:`Arm` has no room."""
        table, T_6_body = self.model.table(self.x), self.model.T_6_body(self.x)
        return replace(
            self.model.arm,
            name=f"{self.model.arm.name}_identified",
            offset=table[:, chain.OFFSET],
            d=table[:, chain.D],
            a=table[:, chain.A],
            alpha=table[:, chain.ALPHA],
            T_flange_tool=pose(nearest_rotation(T_6_body[:3, :3]), T_6_body[:3, 3]),
            source=f"identified from measurements; nominal: {self.model.arm.source}",
        )

    def urdf(self) -> str:
        """Return URDF text with everything that a URDF can hold: the table with Hayati's angles, base and tool."""
        return tilted_urdf(self.arm(), self.model.table(self.x)[:, chain.BETA])


def table_text(arm: Corrected) -> str:
    """Return the corrected arm as TOML, m and rad; every value with its sigma. :func:`open_corrected` reads it."""
    model, x = arm.model, arm.x
    table, sigma, seen = model.table(x), model.table(arm.sigma), model.q_seen is not None
    lines = [
        *_toml({"name": model.arm.name, "convention": model.arm.convention, "identified": True, "version": VERSION}),
        "# theta = direction (q + error sources) + offset; beta is Hayati's angle, a rotation about y after alpha",
        *_toml({"T_rig_base": _pose(model.T_rig_base(x)), "T_base_0": _pose(model.arm.T_base_0)}),
        *_toml({"T_flange_body": _pose(model.T_6_body(x)), "up_base": model.up_base.tolist()}),
    ]
    if np.isfinite(arm.moved_m).all():
        lines += _toml(dict(zip(MOVED, arm.moved_m, strict=True)))
    if (model.arm.coupling != np.eye(model.arm.joints)).any():
        lines += _toml({"coupling": model.arm.coupling.tolist()})
    if seen:
        lines += [
            "# A sensor's curve (gain, wave, ripple) holds from seen_min_rad to seen_max_rad of its joint.",
            "# Beyond, it fades to its mean over that range: with t = distance / curve_fade_rad, 1 - t^2 (3 - 2 t)",
            "# of its deviation from the mean is left, and none from t = 1 on.",
            *_toml({"curve_fade_rad": float(model.fade_rad)}),
        ]
    for i, name in enumerate(model.arm.joint_names):
        row: dict[str, Any] = {"name": name, "direction": int(model.arm.direction[i])}
        for c, (column, unit) in enumerate(_UNITS.items()):
            row |= {f"{column}_{unit}": float(table[i, c]), f"sigma_{column}_{unit}": float(sigma[i, c])}
        row |= {f"nominal_{key}_{unit}": float(getattr(model.arm, key)[i]) for key, unit in _NOMINAL.items()}
        row |= _seen(model, i)
        row |= {f"{key}_{unit}": float(getattr(model.arm, key)[i]) for key, unit in LIMITS.items()}
        lines += ["", "[[joint]]", *_toml(row)]
    for k, f in enumerate(model.features):
        if x[at := model.sources_at + k] != 0.0:
            numbers = {"value": float(x[at]), "sigma": float(arm.sigma[at])}
            source = {"name": f.name, "kind": f.kind, "joint": f.joint + 1, "unit": f.unit} | numbers
            lines += ["", "[[error_source]]", *_toml(source)]
    return "\n".join(lines) + "\n"


def _seen(model: Model, joint: int) -> dict[str, float]:
    """Return the readings of a joint that the poses have shown; {} where they are not known."""
    ends = () if model.q_seen is None else model.q_seen[joint]
    return {f"seen_{end}_rad": float(v) for end, v in zip(("min", "max"), ends, strict=False)}


def _toml(values: Mapping[str, Any]) -> list[str]:
    """Return lines of TOML: of texts, numbers, lists of numbers, and poses, in one line each."""

    def text(value: Any) -> str:  # noqa: ANN401
        if isinstance(value, Mapping):
            return f"{{ {', '.join(_toml(value))} }}"
        if isinstance(value, str):  # JSON's escapes, but every character above ASCII as itself
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        return str(value).lower() if isinstance(value, bool) else repr(value)

    return [f"{key} = {text(value)}" for key, value in values.items()]


def _pose(T: Array) -> dict[str, list[float]]:
    return {"position_m": T[:3, 3].tolist(), "quaternion_wxyz": quaternion_wxyz(T[:3, :3]).tolist()}


def is_corrected(path: str | Path) -> bool:
    """Return whether an arm's file is a corrected.toml; a name or another file is none.

    Raises:
        InputError: a .toml file that is unreadable, or not TOML.
    """
    return str(path).lower().endswith(".toml") and "identified" in read_toml(path)


def open_corrected(path: str | Path) -> Corrected:
    """Read a corrected.toml with everything that corrects: table, sensors' curves, backlash, compliance, base and body.

    A file of version 1 or 2 has no ranges of the readings, so that its curves do not fade; ``notes`` of the arm says so.

    Raises:
        InputError: unreadable, no corrected.toml, or something in it is missing or wrong; the message names it.
    """
    given = read_toml(path)
    if "identified" not in given:
        raise InputError(f"{path}: no identified arm; armsight identify -o DIR writes DIR/corrected.toml")
    arm, beta = identified_table(path, given)
    rows, notes = given["joint"], []
    table = np.stack([arm.offset, arm.d, arm.a, arm.alpha, beta], axis=1)
    if "nominal_d_m" in rows[0]:
        offset, d, a, alpha = (joint_numbers(path, rows, f"nominal_{k}_{unit}") for k, unit in _NOMINAL.items())
        arm = replace(arm, offset=offset, d=d, a=a, alpha=alpha)
    else:
        notes.append(
            f"{path}: an old file without the nominal table: levers of gravity are those of the identified one"
        )
    q_seen, fade_rad = None, chain.FADE_RAD
    if "seen_min_rad" in rows[0]:
        q_seen = np.stack([joint_numbers(path, rows, f"seen_{end}_rad") for end in ("min", "max")], axis=1)
        fade_rad = _finite(path, "curve_fade_rad", given.get("curve_fade_rad"))
        if fade_rad <= 0:
            raise InputError(f"{path}: curve_fade_rad is {fade_rad}, must be more than 0")
    else:
        notes.append(
            f"{path}: an old file without the ranges of the readings seen: sensors' curves do not fade beyond them"
        )
    features, coefficients = _error_sources(path, given)
    T_rig_base, T_6_body = file_transform(path, given, "T_rig_base"), file_transform(path, given, "T_flange_body")
    up = np.array(given.get("up_base", [0.0, 0.0, 1.0]), float)
    model = Model(arm, 1, True, features, T_rig_base[:3, :3], T_6_body[:3, :3], up, q_seen, fade_rad)
    x = np.zeros(len(model.parameters))
    x[:3], x[model.tool_at : model.tool_at + 3] = T_rig_base[:3, 3], T_6_body[:3, 3]
    x[model.table_at : model.sources_at] = table.ravel()
    sigma = np.zeros(len(x))
    numbers = [joint_numbers(path, rows, f"sigma_{key}_{unit}") for key, unit in _UNITS.items()]
    sigma[model.table_at : model.sources_at] = np.stack(numbers, axis=1).ravel()
    x[model.sources_at :], sigma[model.sources_at :] = coefficients
    return Corrected(model, x, sigma, tool_moved(path, given), tuple(notes))


def _error_sources(path: str | Path, given: dict[str, Any]) -> tuple[tuple[Feature, ...], Array]:
    """Return the F error sources of a parsed corrected.toml, and their coefficients and sigmas (2, F)."""
    known = {f.name: f for f in all_features(len(given["joint"]), True, (*RIPPLES, *FAST))}
    features, values = [], []
    for row in given.get("error_source", given.get("cause", [])):
        name = str(row.get("name"))
        for old, new in _OLD_NAMES.items():
            name = new + name.removeprefix(old) if name.startswith(old) else name
        if name not in known:
            raise InputError(
                f"{path}: error source {name!r} is unknown; known are such as gain1, wave1_sin1, backlash1"
            )
        features.append(known[name])
        values.append([_finite(path, f"{key} of {name}", row.get(key)) for key in ("value", "sigma")])
    return tuple(features), np.array(values).reshape(-1, 2).T


def _finite(path: str | Path, key: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"{path}: {key} is {value!r}, must be a number")
    return float(value)


def zeros_text(found: Identified) -> str:
    """Return what the board adds to the angle that it reads from each potentiometer, as TOML."""
    model = found.model
    lines = [
        "# angle = (1 + gain) reading + zero + sin1 sin(reading) + cos1 cos(reading) + sin2 sin(2 reading) + ..;",
        "# zero: to be added to every node of the joint's potentiometer table. Backlash and compliance stay uncorrected.",
        "# It holds for readings from seen_min_rad to seen_max_rad, and says nothing of others.",
    ]
    zeros = Corrected.of(found).zeros_rad().tolist()
    for i, (name, zero) in enumerate(zip(model.arm.joint_names, zeros, strict=True)):
        lines += ["", "[[joint]]", *_toml({"name": name, "zero_rad": zero}), f"zero_deg = {np.degrees(zero):.5f}"]
        row = {"sigma_zero_rad": float(np.nan_to_num(found.value(f"offset{i + 1}")[1]))} | _seen(model, i)
        for f in model.features:
            if f.joint == i and f.kind in SENSOR and (value := found.value(f.name)[0]) != 0.0:
                row["gain" if f.kind == "gain" else f"{f.name.split('_')[1]}_rad"] = value
        lines += _toml(row)
    return "\n".join(lines) + "\n"
