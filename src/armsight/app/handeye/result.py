"""What a hand-eye calibration says: the text, the JSON, and the table of the next poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from armsight.app.handeye.plan import PosePlan, worst_sigmas
from armsight.app.handeye.recording import PairedPoses
from armsight.app.report.table import TextTable, plain_text
from armsight.data import Array, Record
from armsight.geometry.pose import log_se3, mean_pose
from armsight.loop.handeye.handeye import TRUSTED_M, TRUSTED_RAD, HandEye
from armsight.loop.handeye.sources import OF_THE_ARM

#: As many blunders as this share of the poses are no calibration to trust.
_MANY = 0.25
#: Sources whose mean log density of a pose left out is within this of the best are not distinguished from them.
DISTINGUISHED = 0.2
#: A scale that differs from 1 by this many sigmas is said.
SCALE_SIGMAS = 5.0


@dataclass(frozen=True, eq=False)
class HandEyeAnswer(Record):
    """A calibration with what it was made from.

    Attributes:
        recording: both sides.
        found: the calibration.
        offset_s: to be added to the eye's times; None where there are no streams; sigma_offset_s its sigma.
        plan: the poses to take next; None where not asked for.
    """

    recording: PairedPoses
    found: HandEye
    offset_s: float | None
    sigma_offset_s: float
    plan: PosePlan | None


def names(run: HandEyeAnswer) -> tuple[str, str]:
    """Return what the flange carries and what stands still: names of the transforms."""
    if run.found.eye == "in_hand":
        return "T_flange_rig", "T_base_body"
    return "T_flange_body", "T_base_rig"


def blunders(run: HandEyeAnswer) -> list[str]:
    """Return the rows taken for blunders, by name, the worst first."""
    out = np.flatnonzero(~run.found.used)
    worst = out[np.argsort(-run.found.distance[out])]
    return [f"{run.recording.names[k]}: {np.sqrt(run.found.distance[k]):.0f} sigma from the others" for k in worst]


def whose(run: HandEyeAnswer) -> str:
    """Return how much of the error is the arm's and how much the camera's, as a sentence."""
    found = run.found
    arm, camera = 1e3 * found.arm_m, 1e3 * found.camera_m
    said = f"at the target the arm is off by {arm:.2f} mm RMS, the camera by {camera:.2f} mm"
    best = max(found.likelihoods.values())
    if all(best - found.likelihoods.get(name, -np.inf) < DISTINGUISHED for name in ("robot", "camera")):
        said += "; these poses hardly distinguish arm from camera"
    return f"{said} (structure of the noise: {found.structure})"


def headline(run: HandEyeAnswer) -> str:
    """Return the result in one line."""
    position, angle = run.found.held_out.rms()
    return (
        f"poses left out: {1e3 * position:.2f} mm, {np.degrees(angle):.3f} deg RMS; {int(run.found.used.sum())} of "
        f"{len(run.found.used)} poses used"
    )


def open_direction(run: HandEyeAnswer) -> str:
    """Return in which direction the mounting is known worst."""
    found = run.found
    values, vectors = np.linalg.eigh(found.cov[6:9, 6:9])
    axis = found.T_flange_held[:3, :3] @ vectors[:, -1]
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    named = " ".join(f"{value:.2f}" for value in axis)
    ratio = float(np.sqrt(values[-1] / max(values[0], 1e-300)))
    rotated = log_se3(np.linalg.inv(mean_pose(run.recording.poses.A)) @ run.recording.poses.A)[:, 3:]
    spread, axes = np.linalg.eigh(rotated.T @ rotated / len(rotated))
    least = axes[:, 0] * np.sign(axes[np.argmax(np.abs(axes[:, 0])), 0])
    about = " ".join(f"{value:.2f}" for value in least)
    return (
        f"worst known along [{named}] of the flange: sigma {1e3 * np.sqrt(values[-1]):.2f} mm, {ratio:.1f} times the best; "
        f"the poses rotate least about [{about}] ({np.degrees(np.sqrt(max(spread[0], 0.0))):.1f} deg RMS)"
    )


def _with_sigma(value: float, sigma: float, decimals: int) -> str:
    """Return a value and its sigma with so many decimals; with more, up to five, where these show nothing of the sigma."""
    while sigma < 0.5 * 10.0**-decimals and decimals < 5:
        decimals += 1
    return f"{value:.{decimals}f} ± {sigma:.{decimals}f}"


def transforms_table(run: HandEyeAnswer) -> TextTable:
    """Return both transforms with their sigmas as a table."""
    found = run.found
    sigma = np.sqrt(np.diag(found.cov))
    rows = []
    for name, T, s in zip(names(run), (found.T_flange_held, found.T_base_still), (sigma[6:], sigma[:6]), strict=True):
        along = _along(T, s)
        angles = Rotation.from_matrix(np.array(T[:3, :3])).as_euler("xyz", degrees=True)
        cells = [_with_sigma(1e3 * v, 1e3 * e, 2) for v, e in zip(T[:3, 3], along, strict=True)]
        cells += [_with_sigma(v, np.degrees(e), 3) for v, e in zip(angles, s[3:], strict=True)]
        rows.append((name, *cells))
    head = ("", "x, mm", "y, mm", "z, mm", "rx, deg", "ry, deg", "rz, deg")
    return TextTable("angles: xyz about fixed axes; ± sigma", head, tuple(rows))


def statements(run: HandEyeAnswer) -> list[str]:
    """Return what is said beside the transforms, a line each."""
    found, lines = run.found, [whose(run), open_direction(run)]
    if run.offset_s is not None:
        lines.append(
            f"clock offset {1e3 * run.offset_s:.2f} ± {1e3 * run.sigma_offset_s:.2f} ms, to be added to the camera's times"
        )
    if found.held_out_geometry is not None:
        errors = (found.held_out, found.held_out_nominal, found.held_out_geometry)
        plain, nominal, geometry = (1e3 * of.rms()[0] for of in errors)
        what, found_by = "geometry of the arm", "armsight identify finds it"
        if "drift_m" in found.sigmas:
            joints = "" if run.recording.robot.q is not None else "with joints and --model "
            what, found_by = "smooth error of the arm", f"{joints}armsight identify finds its geometry"
        lines.append(
            f"with the {what} that the other poses show, poses left out come to {geometry:.2f} mm in place of "
            f"{nominal:.2f}; {found_by}"
        )
        if "link_m" in found.sigmas:
            lines.append(
                f"the transforms go with the true arm: with the arm's nominal model they leave {plain:.2f} mm; with the "
                f"mounting that suits the arm's nominal model: {nominal:.2f} mm"
            )
    lines.append(
        f"the arm is not as its model with a probability of {100 * found.arm_off:.0f} %; the sigmas allow with that weight "
        "for what it is then off by in all poses alike"
    )
    if found.common.size:
        lines.append(
            f"the rig's calibration was fitted too: {1e3 * found.common_m:.2f} mm RMS at the target, at most "
            f"{np.abs(found.common).max():.1f} of its own sigmas; poses used and left out are corrected by it"
        )
    if "scale_walk" in found.sigmas:
        low, high = scale_at_end(found)
        lines.append(
            f"the camera's scale walks by {100 * found.sigmas['scale_walk']:.2g} % over all poses (sigma): the "
            f"target's lengths are {found.scale:.5f} ± {found.sigma_scale:.5f} of those given at the first pose alone, and "
            f"{low:.4f} to {high:.4f} at the last (95 %)"
        )
    elif found.sigma_scale:
        wrong = abs(found.scale - 1.0) > 3.0 * found.sigma_scale
        lines.append(
            f"the target's lengths are {found.scale:.5f} ± {found.sigma_scale:.5f} of those given: "
            + (
                "correct --target's size"
                if wrong
                else "no contradiction; without --scale the transforms are known better"
            )
        )
    return lines


def scale_at_end(found: HandEye) -> tuple[float, float]:
    """Return within which the scale of the target is at the last pose, 95 %, where it walks."""
    way = 1.96 * float(np.hypot(found.sigmas["scale_walk"], found.sigma_scale / found.scale))
    return found.scale * float(np.exp(-way)), found.scale * float(np.exp(way))


def untrusted(run: HandEyeAnswer) -> list[str]:
    """Return why the result must not be trusted; empty where it may be."""
    found, why = run.found, []
    out, n = int((~found.used).sum()), len(found.used)
    if out >= _MANY * n:
        why.append(
            f"{out} of {n} poses are blunders, more than slips: do the rows belong together, and did nothing move? A row "
            "that is missing on one side shifts all after it"
        )
    median = float(np.nanmedian(found.held_out.position_m))
    if median > TRUSTED_M:
        why.append(f"half of the poses left out are off by more than {1e3 * median:.0f} mm: check one row by hand")
    for name, cov in zip(names(run), (found.cov[6:, 6:], found.cov[:6, :6]), strict=True):
        far_m, far_rad = (float(np.sqrt(np.linalg.eigvalsh(part)[-1])) for part in (cov[:3, :3], cov[3:, 3:]))
        if far_m > TRUSTED_M or far_rad > TRUSTED_RAD:
            why.append(
                f"{name} is known to {1e3 * far_m:.0f} mm and {np.degrees(far_rad):.1f} deg only along its worst axes "
                "(sigma): rotate the flange further, about axes that are not parallel, and take more poses"
            )
    return why


def text(run: HandEyeAnswer) -> str:
    """Return what people read."""
    lines = [
        *(f"do not trust this result: {why}" for why in untrusted(run)),
        headline(run),
        "",
        plain_text(transforms_table(run)),
        "",
        *statements(run),
    ]
    out = blunders(run)
    lines += [f"blunders, left out: {len(out)}", *(f"  {line}" for line in out[:10])] if out else ["no blunders"]
    if run.plan is not None:
        lines += ["", plain_text(plan_table(run.plan, run.recording.names))]
        if run.found.structure != "robot and camera":
            lines.append(
                f"these sigmas are lower bounds: with {run.found.structure} new poses share errors with the others"
            )
    return "\n".join(lines)


def _along(T: Array, sigma: Array) -> Array:
    """Return sigmas along the parent's axes of a translation whose sigmas are along its own."""
    return np.asarray(np.sqrt(np.square(T[:3, :3]) @ np.square(sigma[:3])))


def _near(plan: PosePlan, names: tuple[str, ...], k: int) -> str:
    """Return the pose that a planned one is near, by name, and how far from it."""
    far = f"{np.degrees(plan.rotated_rad[k]):.0f} deg, {1e3 * plan.moved_m[k]:.0f} mm"
    return f"{far} from {names[plan.nearest[k]]}"


def plan_table(plan: PosePlan, names: tuple[str, ...]) -> TextTable:
    """Return the next poses as a table for people; names are those of the poses that were taken."""
    rows = []
    for k, (T, m, rad) in enumerate(zip(plan.Ts_base_flange, plan.sigma_m, plan.sigma_rad, strict=True), 1):
        p, angles = 1e3 * T[:3, 3], Rotation.from_matrix(np.array(T[:3, :3])).as_euler("xyz", degrees=True)
        values = [*(f"{v:.1f}" for v in p), *(f"{v:.1f}" for v in angles), f"{1e3 * m:.2f}", f"{np.degrees(rad):.3f}"]
        rows.append((str(k), *values, _near(plan, names, k - 1), plan.reasons[k - 1]))
    head = (
        "next",
        "x, mm",
        "y, mm",
        "z, mm",
        "rx, deg",
        "ry, deg",
        "rz, deg",
        "sigma, mm",
        "deg",
        "near",
        "lowers most",
    )
    title = (
        f"poses of the flange to take next (sigma along the worst axis now {1e3 * plan.before[0]:.2f} mm, "
        f"{np.degrees(plan.before[1]):.3f} deg); each is near one that was taken, with the target in view; check that your "
        "arm reaches them freely"
    )
    return TextTable(title, head, tuple(rows))


def plan_csv(plan: PosePlan) -> str:
    """Return the next poses as a table that the command reads."""
    lines = ["x_m,y_m,z_m,qw,qx,qy,qz"]
    for T in plan.Ts_base_flange:
        x, y, z, w = Rotation.from_matrix(np.array(T[:3, :3])).as_quat()
        lines.append(",".join(f"{v:.9g}" for v in (*T[:3, 3], w, x, y, z)))
    return "\n".join(lines) + "\n"


def as_json(run: HandEyeAnswer) -> dict[str, Any]:
    """Return what programs read; m and rad."""
    found = run.found
    held, still = names(run)
    position, angle = found.held_out.rms()
    worst_m, worst_rad = worst_sigmas(found.cov)
    document: dict[str, Any] = {
        "eye": found.eye,
        "untrusted": untrusted(run),
        held: found.T_flange_held.tolist(),
        still: found.T_base_still.tolist(),
        "cov_m_rad": found.cov.tolist(),
        "cov_order": [f"{still}: right tangent, translation then rotation", f"{held}: the same"],
        "held_out_rms_m": position,
        "held_out_rms_rad": angle,
        "held_out_mean_m": found.held_out.mean()[0],
        "held_out_nominal_rms_m": found.held_out_nominal.rms()[0],
        "held_out_nominal_mean_m": found.held_out_nominal.mean()[0],
        "held_out_geometry_rms_m": None if found.held_out_geometry is None else found.held_out_geometry.rms()[0],
        "held_out_geometry_mean_m": None if found.held_out_geometry is None else found.held_out_geometry.mean()[0],
        "rig_calibration_rms_m": found.common_m,
        "arm_rms_m": found.arm_m,
        "camera_rms_m": found.camera_m,
        "noise": {
            "structure": found.structure,
            "arm_off_probability": found.arm_off,
            "sigmas": found.sigmas,
            "of_the_arm": [name for name in found.sigmas if name in OF_THE_ARM],
            "log_likelihood_left_out": found.likelihoods,
        },
        "worst_sigma_m": worst_m,
        "worst_sigma_rad": worst_rad,
        "open_direction": open_direction(run),
        "poses": [
            {
                "name": name,
                "line": int(run.recording.robot.lines[row]),
                "used": bool(used),
                "sigmas_from_the_others": float(np.sqrt(distance)),
                "held_out_m": None if np.isnan(m) else float(m),
                "held_out_rad": None if np.isnan(rad) else float(rad),
            }
            for name, row, used, distance, m, rad in zip(
                run.recording.names,
                run.recording.rows,
                found.used,
                found.distance,
                found.held_out.position_m,
                found.held_out.angle_rad,
                strict=True,
            )
        ],
        "notes": list(run.recording.notes),
    }
    if "scale_walk" in found.sigmas:
        document |= {"target_scale_at_start": found.scale, "target_scale_at_start_sigma": found.sigma_scale}
        document |= {"target_scale_walks_sigma": found.sigmas["scale_walk"], "target_scale_at_end": scale_at_end(found)}
    elif found.sigma_scale:
        document |= {"target_scale": found.scale, "target_scale_sigma": found.sigma_scale}
    if run.offset_s is not None:
        document |= {"clock_offset_s": run.offset_s, "clock_offset_sigma_s": run.sigma_offset_s}
    if run.recording.seen.scatter_px:
        document["reprojection_rms_px"] = run.recording.seen.scatter_px
    if run.plan is not None:
        document["plan"] = {
            "T_base_flange": run.plan.Ts_base_flange.tolist(),
            "sigma_m": run.plan.sigma_m.tolist(),
            "sigma_rad": run.plan.sigma_rad.tolist(),
            "nearest": [run.recording.names[k] for k in run.plan.nearest],
            "rotated_from_nearest_rad": run.plan.rotated_rad.tolist(),
            "moved_from_nearest_m": run.plan.moved_m.tolist(),
            "lowers_most": list(run.plan.reasons),
        }
    return document
