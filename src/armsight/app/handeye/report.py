"""The result of a hand-eye calibration as a Report: what is said of it, its JSON, its figures, the poses to take next."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from armsight.app.show.messages import Note
from armsight.app.show.plotting import BLUE, INK, MUTED, ORANGE, RED, Figure, subplots
from armsight.app.show.report import Block, Fact, Grade, Lines, Report, Section, figures
from armsight.app.show.table import TextTable
from armsight.data import Array, Record
from armsight.files import table_text
from armsight.geometry.pose import inverse, log_se3, mean_pose, transform
from armsight.geometry.rotation import quaternion_wxyz
from armsight.loop.handeye.handeye import TRUSTED_M, TRUSTED_RAD, HandEye, known_where_seen
from armsight.loop.handeye.recording import PairedPoses
from armsight.loop.handeye.sources import OF_THE_ARM
from armsight.loop.identify.plan import MountingPlan, worst_sigmas

_MANY = 0.25  # as many blunders as this share of the poses are no calibration to trust
#: Sources whose mean log density of a pose left out is within this of the best are not distinguished from them.
DISTINGUISHED = 0.2
ADVISED, MORE = 15, 6  # fewer poses than these are few, and so many more are advised then
#: m; error of poses left out of a good calibration at most; half: worn arms have none, double: 4 mm is good.
GOOD_M = 2e-3
_POSE = ("x, mm", "y, mm", "z, mm", "rx, deg", "ry, deg", "rz, deg")


@dataclass(frozen=True, eq=False)
class HandEyeAnswer(Record):
    """A calibration with what it was made from."""

    recording: PairedPoses  #: both sides
    found: HandEye  #: the calibration
    offset_s: float | None  #: to be added to the eye's times; None where there are no streams; sigma_offset_s its sigma
    sigma_offset_s: float
    plan: MountingPlan | None  #: the poses to take next; None where not asked for


def names(run: HandEyeAnswer) -> tuple[str, str]:
    """Return what the flange carries and what stands still: names of the transforms."""
    if run.found.eye == "in_hand":
        return "T_flange_rig", "T_base_body"
    return "T_flange_body", "T_base_rig"


def handeye_report(run: HandEyeAnswer) -> Report:
    """Return what a calibration says."""
    found, names_ = run.found, run.recording.names
    position, angle = found.held_out.rms()
    headline = (
        f"poses left out: {1e3 * position:.2f} mm, {np.degrees(angle):.3f} deg RMS; {int(found.used.sum())} of "
        f"{len(found.used)} poses used"
    )
    out = np.flatnonzero(~found.used)
    worst = out[np.argsort(-found.distance[out])]
    blunders = [f"{names_[k]}: {np.sqrt(found.distance[k]):.0f} sigma from the others" for k in worst]
    why = _untrusted(run)
    remarks = [
        found.changed_at(names_),
        found.decided_by(names_).removeprefix("; "),
        *found.mistaken_eye(),
        _exchanged(run),
    ]
    decided = [Note("weak", each) for each in remarks if each]
    values = {
        **found.to_dict(),
        "untrusted": why,
        "noise": {
            "structure": found.structure,
            "arm_off_probability": found.arm_off,
            "sigmas": found.sigmas,
            "of_the_arm": [name for name in found.sigmas if name in OF_THE_ARM],
            "log_likelihood_left_out": found.likelihoods,
        },
        "poses": [
            {
                "name": names_[k],
                "line": run.recording.robot.lines[row],
                "used": found.used[k],
                "sigmas_from_the_others": np.sqrt(found.distance[k]),
                "held_out_m": found.held_out.position_m[k],
                "held_out_rad": found.held_out.angle_rad[k],
            }
            for k, row in enumerate(run.recording.rows)
        ],
    }
    if run.recording.seen.scatter_px:
        values["reprojection_rms_px"] = run.recording.seen.scatter_px
    sections: dict[str, Section] = {
        "result": ("Result", [_transforms_table(run), *_facts(run)]),
        **figures(FIGURES, run),
    }
    listed = Lines(blunders, f"blunders, left out: {len(blunders)}", most=10, none="no blunders")
    sections["blunders"] = ("Blunders", [listed])
    if run.plan is not None:
        sections["plan"] = ("Poses to take next", _plan(run.plan, names_, found.structure))
    return Report(
        "handeye",
        "Hand-eye calibration",
        f"{run.recording.robot.path.name} · {len(found.used)} poses · eye {found.eye.replace('_', ' ')}",
        headline,
        sections,
        [*(Note("untrusted", each) for each in why), *(Note("note", each) for each in run.recording.notes), *decided],
        values,
        assessed=assess(run, why, weak=bool(decided)),
    )


def _exchanged(run: HandEyeAnswer) -> str:
    """Say that both tables may be exchanged, which fits as well: the mounting is then the inverse of what stands still."""
    held, still = (np.linalg.norm(T[:3, 3]) for T in (run.found.T_flange_held, run.found.T_base_still))
    if run.found.eye != "in_hand" or run.recording.seen.table is None or held < still:
        return ""
    far = f"the cameras are {held:.2f} m from the flange, the target only {still:.2f} m from the base"
    return f"{far}: if that is not so, --robot and --seen are exchanged"


def assess(run: HandEyeAnswer, why: list[str], *, weak: bool = False) -> tuple[Grade, str]:
    """Return the grade of a calibration, and in one sentence what to do with it; ``why`` it must not be trusted.

    ``weak``: a weakness is named, which is to be looked at first.
    """
    found, position_m = run.found, run.found.held_out.rms()[0]
    used, (worst_m, _) = int(found.used.sum()), worst_sigmas(found.cov)
    if why:
        return "poor", "Do not use this calibration; do what is said above, and calibrate again."
    said = f"{used} poses, those left out are off by {1e3 * position_m:.2f} mm, {names(run)[0]} is known to"
    said += f" {1e3 * worst_m:.2f} mm"
    if found.held_out_geometry is not None and "link_m" in found.sigmas and position_m > GOOD_M:
        corrected_m = found.held_out_geometry.rms()[0]
        only = "Usable only once armsight identify has corrected the arm's model, and not with the nominal one"
        return "fair", f"{only}: {said} along its worst axis; with the geometry found, {1e3 * corrected_m:.2f} mm."
    if worst_m > position_m or used < ADVISED:
        return "fair", f"Usable: {said} along its worst axis; more poses lower that: --plan {MORE} chooses them."
    if weak:
        return "fair", f"Usable only where what is named as weak below is not so: {said}."
    if position_m > GOOD_M:
        return "fair", f"Usable: {said}; the arm's own error is the likeliest reason: armsight identify finds it."
    return "good", f"Good: {said}; leave camera and tool as they are mounted."


def _with_sigma(value: float, sigma: float, decimals: int) -> str:
    """Return a value and its sigma with so many decimals; with more, up to five, where these show nothing of the sigma."""
    while sigma < 0.5 * 10.0**-decimals and decimals < 5:
        decimals += 1
    return f"{value:.{decimals}f} ± {sigma:.{decimals}f}"


def _transforms_table(run: HandEyeAnswer) -> TextTable:
    found = run.found
    sigma = np.sqrt(np.diag(found.cov))
    rows = []
    for name, T, s in zip(names(run), (found.T_flange_held, found.T_base_still), (sigma[6:], sigma[:6]), strict=True):
        along = np.sqrt(np.square(T[:3, :3]) @ np.square(s[:3]))  # the tangent's sigmas are along its own axes
        cells = [_with_sigma(1e3 * v, 1e3 * e, 2) for v, e in zip(T[:3, 3], along, strict=True)]
        cells += [_with_sigma(v, np.degrees(e), 3) for v, e in zip(_angles_deg(T), s[3:], strict=True)]
        rows.append((name, *cells))
    return TextTable("angles: xyz about fixed axes; ± sigma", ("", *_POSE), tuple(rows))


def _facts(run: HandEyeAnswer) -> list[Block]:
    found = run.found
    facts: list[Block] = [_whose(found), _open_direction(run)]
    if run.offset_s is not None:
        offset = f"clock offset {1e3 * run.offset_s:.2f} ± {1e3 * run.sigma_offset_s:.2f} ms"
        sentence = f"{offset}, to be added to the camera's times"
        facts.append(Fact(sentence, {"clock_offset_s": run.offset_s, "clock_offset_sigma_s": run.sigma_offset_s}))
    facts += [Fact(line) for line in _of_the_geometry(run)]
    facts.append(
        Fact(
            f"the arm is not as its model with a probability of {100 * found.arm_off:.0f} %; the sigmas allow with that "
            "weight for what it is then off by in all poses alike"
        )
    )
    common = (
        f"the rig's calibration was fitted too: {1e3 * found.common_m:.2f} mm RMS at the target, at most "
        f"{np.abs(found.common).max():.1f} of its own sigmas; poses used and left out are corrected by it"
        if found.common.size
        else ""
    )
    facts.append(Fact(common, {"rig_calibration_rms_m": found.common_m}))
    return [*facts, *_scale(found)]


def _whose(found: HandEye) -> Fact:
    arm, camera = 1e3 * found.arm_m, 1e3 * found.camera_m
    said = f"at the target the arm is off by {arm:.2f} mm RMS, the camera by {camera:.2f} mm"
    best = max(found.likelihoods.values())
    if all(best - found.likelihoods.get(name, -np.inf) < DISTINGUISHED for name in ("robot", "camera")):
        said += "; these poses hardly distinguish arm from camera"
    said += f" (structure of the noise: {found.structure})"
    return Fact(said, {"arm_rms_m": found.arm_m, "camera_rms_m": found.camera_m})


def _open_direction(run: HandEyeAnswer) -> Fact:
    """Say in which direction the mounting is known worst."""
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
    said = (
        f"worst known along [{named}] of the flange: sigma {1e3 * np.sqrt(values[-1]):.2f} mm, {ratio:.1f} times the best; "
        f"the poses rotate least about [{about}] ({np.degrees(np.sqrt(max(spread[0], 0.0))):.1f} deg RMS)"
    )
    worst_m, worst_rad = worst_sigmas(found.cov)
    return Fact(said, {"open_direction": said, "worst_sigma_m": worst_m, "worst_sigma_rad": worst_rad})


def _of_the_geometry(run: HandEyeAnswer) -> list[str]:
    """Say what the arm's geometry, as the other poses show it, is worth."""
    found = run.found
    if found.held_out_geometry is None:
        return []
    errors = (found.held_out, found.held_out_nominal, found.held_out_geometry)
    plain, nominal, geometry = (1e3 * of.rms()[0] for of in errors)
    what, found_by = "geometry of the arm", "armsight identify finds it"
    if "drift_m" in found.sigmas:
        joints = "" if run.recording.robot.q is not None else "with joints and --model "
        what, found_by = "smooth error of the arm", f"{joints}armsight identify finds its geometry"
    lines = [
        f"with the {what} that the other poses show, poses left out come to {geometry:.2f} mm in place of "
        f"{nominal:.2f}; {found_by}"
    ]
    if "link_m" in found.sigmas:
        lines.append(
            f"the transforms go with the true arm: with its nominal model poses left out are off by {plain:.2f} mm, or by "
            f"{nominal:.2f} mm where the mounting is fitted to that model"
        )
    return lines


def _scale(found: HandEye) -> list[Fact]:
    scale, sigma = found.scale, found.sigma_scale
    of_given = f"{scale:.5f} ± {sigma:.5f} of those given"
    if "scale_walk" in found.sigmas:
        walk = found.sigmas["scale_walk"]
        way = 1.96 * float(np.hypot(walk, sigma / scale))
        low, high = ends = scale * float(np.exp(-way)), scale * float(np.exp(way))
        said = (
            f"the camera's scale walks by {100 * walk:.2g} % over all poses (sigma): the target's lengths are {of_given} "
            f"at the first pose alone, and {low:.4f} to {high:.4f} at the last (95 %)"
        )
        values = {"target_scale_at_start": scale, "target_scale_at_start_sigma": sigma}
        return [Fact(said, values | {"target_scale_walks_sigma": walk, "target_scale_at_end": ends})]
    if not sigma:
        return []
    advice = "no contradiction; without --scale the transforms are known better"
    if abs(scale - 1.0) > 3.0 * sigma:
        advice = "correct --target's size"
    return [
        Fact(f"the target's lengths are {of_given}: {advice}", {"target_scale": scale, "target_scale_sigma": sigma})
    ]


def _untrusted(run: HandEyeAnswer) -> list[str]:
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
    seen = known_where_seen(found, run.recording.poses.B)
    for name, (_, cov) in zip(names(run), seen.values(), strict=True):
        far_m, far_rad = (float(np.sqrt(np.linalg.eigvalsh(part)[-1])) for part in (cov[:3, :3], cov[3:, 3:]))
        if far_m > TRUSTED_M or far_rad > TRUSTED_RAD:
            why.append(
                f"{name} is known, where the body was seen, to {1e3 * far_m:.0f} mm and {np.degrees(far_rad):.1f} deg "
                "only along its worst axes (sigma): rotate the flange further, about axes that are not parallel, and "
                "take more poses"
            )
    return why


def _plan(plan: MountingPlan, names: tuple[str, ...], structure: str) -> list[Block]:
    near, rows = [names[k] for k in plan.nearest], []
    for k, T in enumerate(plan.Ts_base_flange):
        cells = [f"{v:.1f}" for v in (*1e3 * T[:3, 3], *_angles_deg(T))]
        cells += [f"{1e3 * plan.sigma_m[k]:.2f}", f"{np.degrees(plan.sigma_rad[k]):.3f}"]
        far = f"{np.degrees(plan.rotated_rad[k]):.0f} deg, {1e3 * plan.moved_m[k]:.0f} mm"
        rows.append((str(k + 1), *cells, f"{far} from {near[k]}", plan.reasons[k]))
    title = (
        f"poses of the flange to take next (sigma along the worst axis now {1e3 * plan.before[0]:.2f} mm, "
        f"{np.degrees(plan.before[1]):.3f} deg); each is near one that was taken, with the target in view; check that your "
        "arm reaches them freely"
    )
    values = {
        "T_base_flange": plan.Ts_base_flange,
        "sigma_m": plan.sigma_m,
        "sigma_rad": plan.sigma_rad,
        "nearest": near,
        "rotated_from_nearest_rad": plan.rotated_rad,
        "moved_from_nearest_m": plan.moved_m,
        "lowers_most": plan.reasons,
    }
    bounds = f"these sigmas are lower bounds: with {structure} new poses share errors with the others"
    head = ("next", *_POSE, "sigma, mm", "deg", "near", "lowers most")
    fact = Fact("" if structure == "robot and camera" else bounds, {"plan": values})
    return [TextTable(title, head, tuple(rows)), fact]


def _angles_deg(T: Array) -> Array:
    """Return the angles (3,) of a pose about the fixed x, y and z, degrees."""
    return np.asarray(Rotation.from_matrix(np.array(T[:3, :3])).as_euler("xyz", degrees=True))


def plan_csv(plan: MountingPlan) -> str:
    """Return the next poses as a table that the command reads."""
    rows = [[f"{v:.9g}" for v in (*T[:3, 3], *quaternion_wxyz(T[:3, :3]))] for T in plan.Ts_base_flange]
    return table_text(["x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"], rows)


def errors_figure(run: HandEyeAnswer) -> Figure:
    """Plot the error of each pose left out, and how far each is from the others."""
    figure, axes = subplots(6.6, 3, 1, sharex=True)
    found, n = run.found, len(run.found.used)
    lines = run.recording.robot.lines[run.recording.rows]
    by_line = run.offset_s is None and len(np.unique(lines)) == n
    at = np.asarray(lines if by_line else np.arange(n))
    width = 0.9 if n < 100 else 1.0
    axes[0].bar(at, 1e3 * np.nan_to_num(found.held_out.position_m), color=BLUE, width=width)
    axes[0].set_title("left out: distance of the target's middle, mm")
    axes[1].bar(at, np.degrees(np.nan_to_num(found.held_out.angle_rad)), color=BLUE, width=width)
    axes[1].set_title("left out: angle, deg")
    axes[2].bar(at, np.sqrt(found.distance), color=np.where(found.used, MUTED, RED), width=width)
    axes[2].set(
        yscale="log",
        title="residual over its sigma; red: a blunder, left out of the fit",
        xlabel="line of the robot's table" if by_line else "pose",
    )
    axes[2].xaxis.get_major_locator().set_params(integer=True)
    return figure


def sigma_figure(run: HandEyeAnswer) -> Figure:
    """Plot the sigmas of both transforms."""
    figure, axes = subplots(3.0, 1, 2)
    sigma = np.sqrt(np.diag(run.found.cov))
    held, still = names(run)
    at = np.arange(3)
    for ax, rows, factor, unit in ((axes[0], slice(0, 3), 1e3, "mm"), (axes[1], slice(3, 6), np.degrees(1.0), "deg")):
        ax.bar(at - 0.2, factor * sigma[6:][rows], width=0.38, color=BLUE, label=held)
        ax.bar(at + 0.2, factor * sigma[:6][rows], width=0.38, color=ORANGE, label=still)
        ax.set_xticks(at, ["x", "y", "z"])
        ax.set_title(f"sigma along or about the frame's own axes, {unit}")
    axes[0].margins(y=0.25)  # room above the bars
    axes[0].legend(loc="upper center", ncols=2)
    return figure


def structure_figure(run: HandEyeAnswer) -> Figure:
    """Plot how probable the poses left out are under each choice of sources."""
    ranked = sorted(run.found.likelihoods.items(), key=lambda one: one[1])
    figure, ax = subplots(0.34 * len(ranked) + 1.2)
    best = ranked[-1][1]
    ax.barh([name for name, _ in ranked], [value - best for _, value in ranked], color=BLUE, height=0.6)
    for row, (_, value) in enumerate(ranked):
        ax.text(value - best, row, f"{value - best:.2f} ", va="center", ha="right", color=INK)
    ax.margins(x=0.15)
    ax.set_xlabel("mean log density of a pose left out, less that of the best")
    return figure


def coverage_figure(run: HandEyeAnswer) -> Figure:
    """Plot which rotations the flange made, and where the target was seen."""
    figure, (left, right) = subplots(3.6, 1, 2)
    p, used = run.recording.poses, run.found.used
    rotated = np.degrees(log_se3(inverse(mean_pose(p.A)) @ p.A)[:, 3:])
    for other, colour, label in ((1, BLUE, "x and y"), (2, ORANGE, "x and z")):
        left.scatter(rotated[used, 0], rotated[used, other], s=14, color=colour, label=label, linewidths=0)
    left.set_aspect("equal", adjustable="datalim")
    left.set_title("rotation vector from the mean pose, flange, deg")
    left.legend()
    seen = transform(p.B, p.centre)
    shown = right.scatter(
        1e3 * seen[used, 0], 1e3 * seen[used, 1], s=18, c=1e3 * seen[used, 2], cmap="viridis", linewidths=0
    )
    right.set_aspect("equal", adjustable="datalim")
    right.invert_yaxis()
    right.set_title("middle of the target in the camera: x, y, mm")
    figure.colorbar(shown, ax=right, label="depth, mm")
    return figure


#: Name -> the function that plots it, its title and its caption.
FIGURES: dict[str, tuple[Callable[[HandEyeAnswer], Figure], str, str]] = {
    "errors": (
        errors_figure,
        "Errors on poses left out",
        "Each was predicted by a fit to others. Where all is well none stands out, and nothing drifts from first to last.",
    ),
    "sigma": (
        sigma_figure,
        "How well the transforms are known",
        "A bar that stands out is the direction to rotate more in.",
    ),
    "structure": (
        structure_figure,
        "Whose error it is",
        "The longer the bar, the less these sources of error explain the poses left out. A difference below 0.2 is "
        "chance.",
    ),
    "coverage": (
        coverage_figure,
        "Motion and views",
        "Good: rotations spread in both colours, by 20 degrees and more; points on a line are rotations about one axis.",
    ),
}
