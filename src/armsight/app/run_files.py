"""Single files of a run's folder: the joints, the hand-eye calibration, the shots that are kept."""

from __future__ import annotations

import csv
import io
import json
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.measure.poses import UPPER, left_axes
from armsight.app.record.recording import record
from armsight.app.run.calibrate import HandEyeRun
from armsight.data import Array, Shot
from armsight.errors import InputError
from armsight.files import write_text
from armsight.geometry.rotation import quaternion_wxyz


def joint_columns(t_s: Array, q: Array, q_wanted: Array) -> dict[str, Any]:
    """Return the joints' columns: measured and wanted angles."""
    named: dict[str, Any] = {"t_s": np.round(t_s, 6)}
    for joint in range(6):
        named[f"q{joint + 1}_rad"] = np.round(q[:, joint], 9)
        named[f"q{joint + 1}_wanted_rad"] = np.round(q_wanted[:, joint], 9)
    return named


def write_handeye(folder: Path, run: HandEyeRun) -> None:
    """Write the hand-eye calibration, and the poses it was made from as ``armsight identify`` reads them."""
    found, (position, angle) = run.found, run.found.held_out.rms()
    told = {
        "T_base_rig": run.mounting.T_base_rig.tolist(),
        "T_tool_body": run.mounting.T_tool_body.tolist(),
        "cov": found.cov.tolist(),
        "held_out_position_rms_m": position,
        "held_out_angle_rms_rad": angle,
        "sigma_flange_m": found.sigma_flange_m,
        "sigma_flange_rad": found.sigma_flange_rad,
        "poses": len(run.q),
        "missed": list(run.missed),
    }
    write_text(folder / "handeye.json", json.dumps(told, indent=1) + "\n")
    T = run.Ts_left_body
    covs = [left_axes(one, cov) for one, cov in zip(T, run.covs, strict=True)]
    named = {f"q{i + 1}_rad": run.q[:, i] for i in range(6)}
    named |= {f"{axis}_m": T[:, i, 3] for i, axis in enumerate("xyz")}
    turns = np.array([quaternion_wxyz(one[:3, :3]) for one in T])
    named |= {f"q{axis}": turns[:, i] for i, axis in enumerate("wxyz")}
    named |= {f"cov_{i}{j}": np.array([cov[i, j] for cov in covs]) for i, j in UPPER}
    named |= {f"approach{i + 1}": run.approach[:, i].astype(int) for i in range(6)}
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(named)
    writer.writerows(zip(*named.values(), strict=True))
    write_text(folder / "handeye_poses.csv", out.getvalue())


def write_shots(folder: Path, shots: Sequence[Shot]) -> None:
    """Write the kept shots as a recording; it is there whole or not at all.

    Args:
        folder: to be made.
        shots: none makes no folder.

    Raises:
        InputError: it cannot be written, the disk is full.
        KeyboardInterrupt: it came meanwhile.
    """
    left = iter(shots)

    class Kept:
        def read(self) -> Shot | None:
            return next(left, None)

        def close(self) -> None:
            pass

    if not shots:
        return
    try:
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as place:
            stored = record(Kept(), Path(place) / folder.name)
            if stored.interrupted:
                raise KeyboardInterrupt
            if stored.stopped is not None:
                raise InputError(stored.stopped.replace(str(stored.directory), str(folder)))
            os.replace(stored.directory, folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None
