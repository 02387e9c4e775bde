"""Changes of rig, body, joints and clock as hypotheses: their likelihoods, what they do to poses, and how they are said.

Hypotheses that closure fitted: what they may do to a pose widens it; the best is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from armsight.data import Array, Record
from armsight.geometry.pose import adjoint, inverse
from armsight.loop.finding import ALIKE, CAUSES, LEVER_M, Cause, HealthFinding, displacement_m, make_finding, sized

if TYPE_CHECKING:
    from armsight.loop.estimators import PoseMeasurement
    from armsight.loop.estimators.armerror import ErrorLayout

#: A change that begins so much later than another is not the same one, s: beginnings are known to about a second.
LATER_S = 3.0
#: A change is dated to about so much, s: so close to its beginning a measurement may be from before or after it.
DATED_S = 0.7
#: The errors of an arm have longer tails than Gaussian ones: chi-squares count by this factor less.
MARGIN = 1.4
#: The estimate of a drift is off by about this share of it, in any direction (simulated drifts of constant rate).
_OTHERWISE = 0.08
#: Priors so wide that they decide nothing: of a motion (m, rad), of a time, s, and of an angle, rad.
WIDE, _WIDE_S, _WIDE_RAD = np.repeat([0.05, 0.1], 3), 0.05, 0.1

Kind = Literal["rig", "drift", "body", "bend", "joint", "backlash", "time", "rate", "zoom", "shake"]


@dataclass(frozen=True, eq=False)
class ToolView(Record):
    """Who sees the tool: T_base_rig (4, 4), m, and points (N, 3) of the body in the tool's frame, m."""

    T_base_rig: Array
    points: Array

    def zoomed(self, R: Array, p: Array) -> Array:
        """Return what (..., 6) a unit share of both focal lengths does to the tool, right tangent.

        Points appear nearer along the optical axis by that share of their depth; the body is fitted to them. With A the
        scatter of its points and a the axis, it rotates by -(tr A - A)^-1 (A a x a) about their mean.

        ``R``: (..., 3, 3) rotation of the tool in the base. ``p``: (..., 3) its position, m.
        """
        origin, axis, middle = self.T_base_rig[:3, 3], self.T_base_rig[:3, 2], self.points.mean(axis=0)
        A = (self.points - middle).T @ (self.points - middle)
        a = np.swapaxes(R, -1, -2) @ axis
        w = -np.cross(a @ A, a) @ np.linalg.inv(np.trace(A) * np.eye(3) - A)
        depth = (p - origin) @ axis + a @ middle
        return np.concatenate([-a * depth[..., None] - np.cross(w, middle), w], axis=-1)


def changing(parts: ErrorLayout, H: Array, seen: ToolView | None = None) -> Array:
    """Return the columns (..., 6, 18 + 2 n - 1) of what may change, of derivatives (..., 6, K) of the tool's pose.

    Base (6) and delay (1), which may change slowly, too; tool (6), zeros of the joints after the first (its own is a
    rotation of the base), widths of the backlash; what bends under gravity (4); both focal lengths, as a share of them
    (0 where it is not known who sees the tool).
    """
    # Of a gear that grew looser half is taken for each of the two that decide on the side: mostly they agree.
    n, tool = parts.joints, 6 * parts.joints
    widths = 0.5 * (H[..., parts.backlash : parts.backlash + n] + H[..., parts.floats : parts.floats + n])
    delay = H[..., parts.delay : parts.delay + 1]
    # The base's translations are carried to the tool's axes: the last one is upwards.
    columns = [H[..., :6], delay, H[..., tool : tool + 6], H[..., parts.zeros[1:]], widths, bending(-H[..., :3, 2])]
    zoom = np.zeros((*H.shape[:-1], 1))
    if seen is not None:
        # Rotations of the base move the tool by its position: -[p]x in the base's axes.
        R = np.swapaxes(H[..., :3, :3], -1, -2)
        crossed = -R @ H[..., :3, 3:6]
        zoom[..., 0] = seen.zoomed(R, np.stack([crossed[..., 2, 1], crossed[..., 0, 2], crossed[..., 1, 0]], axis=-1))
    return np.concatenate([*columns, zoom], axis=-1)


def bending(down: Array) -> Array:
    """Return what (..., 6, 4) gravity does: a body's tangent by a beam's (3), rad, and a shift, m; ``down`` (..., 3) unit.

    A beam along an axis a of the tool, which bends by an angle where it is level, rotates its end by that times a x down.
    """
    by = np.zeros((*down.shape[:-1], 6, 4))
    by[..., :3, 3], by[..., 3:, :3] = down, np.cross(np.eye(3), down[..., None, :]).swapaxes(-1, -2)
    return by


#: Of these columns those that may change slowly; and how many there are without the backlash, of n joints.
RAMPS = 7


def widths(joints: int) -> Array:
    """Return (18 + 2 n - 1,) standard deviations of the priors of what may change."""
    wide = np.full(RAMPS + 10 + 2 * joints, _WIDE_RAD)
    wide[:6] = wide[RAMPS : RAMPS + 6] = WIDE
    wide[6], wide[-2:] = _WIDE_S, WIDE[0]
    return wide


def thinned(times_s: Sequence[float], now_s: float, all_s: float, ratio: float) -> list[int]:
    """Return the rows of rising times, s, that are kept: all of the newest seconds, older ones each older by a ratio."""
    rows = list[int]()
    for k, t_s in enumerate(times_s):
        age_s = now_s - t_s
        if not rows or age_s <= all_s or now_s - times_s[rows[-1]] >= ratio * age_s:
            rows.append(k)
    return rows


@dataclass(frozen=True)
class Suspect:
    """Something that may change."""

    #: rig: it jumped; drift: it drifts; body: it slipped on the tool; bend: it bends under gravity; joint: its zero
    #: jumped; backlash: it grew; time: the camera's clock jumped; rate: it runs at another rate; zoom: both focal
    #: lengths changed alike; shake: rig and arm move to and fro
    kind: Kind
    joint: int  #: row of the joint; -1 for what is not of one
    columns: slice  #: its parameters among those that may change

    @property
    def cause(self) -> Cause:
        """The cause that a record gives."""
        return CAUSES[self.kind].cause

    @property
    def slow(self) -> bool:
        """Whether it changes as a ramp, else as a step."""
        return self.kind in ("drift", "rate")

    @property
    def moves(self) -> bool:
        """Whether it makes measured poses wrong, beyond what a clock that is followed does."""
        return self.kind in ("rig", "drift", "body", "bend", "zoom")

    @property
    def freedom(self) -> int:
        """Return as how many numbers it counts: a zoom and a shift by gravity as the motion of the rig they look like."""
        return 6 if self.kind in ("zoom", "bend") else self.columns.stop - self.columns.start


def suspects(joints: int) -> tuple[Suspect, ...]:
    """Return all of an arm of n joints."""
    tool, bend = slice(RAMPS, RAMPS + 6), RAMPS + 5 + 2 * joints
    return (
        Suspect("rig", -1, slice(0, 6)),
        Suspect("drift", -1, slice(0, 6)),
        Suspect("body", -1, tool),
        Suspect("bend", -1, slice(bend, bend + 4)),
        Suspect("zoom", -1, slice(bend + 4, bend + 5)),
        Suspect("time", -1, slice(6, 7)),
        Suspect("rate", -1, slice(6, 7)),
        Suspect("joint", 0, slice(5, 6)),
        *(Suspect("joint", i, slice(tool.stop + i - 1, tool.stop + i)) for i in range(1, joints)),
        *(Suspect("backlash", i, slice(tool.stop - 1 + joints + i, tool.stop + joints + i)) for i in range(joints)),
    )


@dataclass(frozen=True, eq=False)
class Change(Record):
    """A hypothesis: something changed, by so much."""

    suspect: Suspect
    begin_s: float
    end_s: float  #: time of the newest measurement that was used, s
    size: Array  #: (D,) by how much: tangent of base or tool [m; rad], an angle, rad, or a time, s; of a ramp so far
    cov: Array  #: (D, D) its covariance
    chi_square: float  #: of the change against none
    #: chi-square less what its parameters explain by chance: twice the logarithm of a likelihood, beyond a limit
    score: float
    effect: Array  #: (6, D) what a unit of it does to the newest measured pose of the tool, right tangent
    T_base_tool: Array  #: (4, 4) that pose
    until_s: float = np.inf  #: when it was put right, s
    besides: bool = False  #: whether it is taken to have happened besides the best one, at another time
    seen: ToolView | None = None  #: who sees the tool; None where that is not known

    def displacement(self, T_base_tool: Array, t_s: float) -> tuple[Array, Array]:
        """Return what it does to a measured pose of the tool (4, 4) at a time, s: right tangent (6,), covariance."""
        by = self.effect
        if self.suspect.kind == "bend":
            by = bending(-T_base_tool[2, :3])
        elif self.suspect.kind == "zoom" and self.seen is not None:
            by = self.seen.zoomed(T_base_tool[:3, :3], T_base_tool[:3, 3])[:, None]
        elif self.suspect.kind != "body":  # the base moves the tool by the lever to it
            by = adjoint(inverse(T_base_tool) @ self.T_base_tool) @ by
        if self.suspect.slow:  # it is taken to go on for as long as it was seen, at most
            seen_s = self.end_s - self.begin_s
            by = by * min(t_s - self.begin_s, 2.0 * seen_s) / seen_s
        return by @ self.size, by @ self.cov @ by.T

    @property
    def newest(self) -> tuple[Array, Array]:
        """What it does to the newest measured pose of the tool (6,), and its covariance (6, 6)."""
        return self.displacement(self.T_base_tool, self.end_s)


def ranked(changes: Sequence[Change]) -> tuple[Change, ...]:
    """Return the hypotheses that cannot be distinguished from the one of highest score, that one first."""
    best = max(each.score for each in changes)
    return tuple(each for each in sorted(changes, key=lambda each: -each.score) if each.score > best - ALIKE)


def happened_besides(changes: Sequence[Change], best: Change) -> tuple[Change, ...]:
    """Return those that move poses, began at another time than the best one and are of another cause: both happened."""
    return tuple(
        replace(each, besides=True)
        for each in changes
        if each.suspect.moves
        and each.suspect.cause != best.suspect.cause
        and abs(each.begin_s - best.begin_s) > LATER_S
    )


def probabilities(changes: Sequence[Change]) -> Array:
    """Return the probabilities (N,) of hypotheses, equally probable before: their likelihoods, normalised."""
    scores = np.array([each.score for each in changes])
    likelihoods = np.exp((scores - scores.max()) / (2.0 * MARGIN))
    return np.asarray(likelihoods / likelihoods.sum())


def doubtful(changes: Sequence[Change]) -> bool:
    """Return whether measured poses may be wrong by one of the hypotheses."""
    return any(each.suspect.moves or (each.suspect.kind, each.suspect.joint) == ("joint", 0) for each in changes)


def suspected(measurement: PoseMeasurement, changes: Sequence[Change]) -> Array | None:
    """Return the covariance (6, 6) of what hypotheses do to a pose measurement of the tool; None where they do nothing."""
    shaken = [each for each in changes if each.suspect.kind == "shake"]
    changes = [each for each in changes if each.suspect.kind != "shake"]
    until_s = min((each.until_s for each in changes if each.until_s > measurement.t_s), default=np.inf)
    changes = [each for each in changes if each.until_s == until_s]
    extra, t_s, T = np.zeros((6, 6)), measurement.t_s, measurement.T_base_tool
    for besides in (False, True):
        some = [each for each in changes if each.besides is besides]
        for each, share in zip(some, probabilities(some) if some else (), strict=True):
            if each.suspect.moves and t_s >= each.begin_s:
                shift, cov = each.displacement(T, t_s)
                metres, radians = np.linalg.norm(shift.reshape(2, 3), axis=1).tolist()
                # It was estimated as if rotations were small; and a drift does something else beside it.
                variances = np.array([(0.5 * radians * metres) ** 2, (0.5 * radians**2) ** 2])
                if each.suspect.kind == "drift":
                    variances += (_OTHERWISE * metres) ** 2, (_OTHERWISE * radians) ** 2
                extra += share * (np.outer(shift, shift) + cov + np.diag(np.repeat(variances, 3)))
    for each in shaken:
        extra += each.displacement(T, t_s)[1]
    return extra if extra.any() else None


def widened(measurement: PoseMeasurement, changes: Sequence[Change]) -> PoseMeasurement:
    """Return a pose measurement of the tool with what may have moved it in its common covariance."""
    extra = suspected(measurement, changes)
    return measurement if extra is None else replace(measurement, cov_common=measurement.cov_common + extra)


def finding(changes: Sequence[Change], names: Sequence[str]) -> HealthFinding:
    """Return the finding of hypotheses that cannot be distinguished, the best first."""
    best, kind, joint = changes[0], changes[0].suspect.kind, changes[0].suspect.joint
    others = [each for each in changes[1:] if {each.suspect.kind, kind} not in ({"rig", "drift"}, {"time", "rate"})]
    unsure = ""
    for besides, says in ((False, "cannot be excluded"), (True, "was reported before, and stays")):
        suspected = [each.suspect for each in others if each.besides is besides]
        named = dict.fromkeys(CAUSES[each.kind].name.format(joint=names[each.joint]) for each in suspected)
        unsure += f"; {' or '.join(named)} {says}" if named else ""
    causes = [each.suspect.cause for each in others]
    if (kind, joint) == ("joint", 0):
        causes.append("fixed")
    alternatives = tuple(cause for cause in dict.fromkeys(causes) if cause != best.suspect.cause)
    # A clock displaces what moves alone.
    cost_m = None if best.suspect.cause == "time" else float(displacement_m(best.newest[0]))
    shift, cov = best.newest
    evidence, words = sized(shift[:3], cov[:3, :3]), dict[str, object]()
    if kind == "bend":  # by the angle of a beam that is level
        evidence, shift_m = sized(best.size[:3], best.cov[:3, :3]), abs(float(best.size[3]))
        words, cost_m = {"shift_mm": 1e3 * shift_m}, shift_m + LEVER_M * evidence[0]
    elif best.suspect.moves:
        so_far = " so far" if best.suspect.slow else ""
        words["by"] = (
            f"displaced by {1e3 * evidence[0]:.2f} mm and {np.degrees(np.linalg.norm(shift[3:])):.3f} deg{so_far}"
        )
    if len(best.size) == 1:
        evidence = float(best.size[0]), float(np.sqrt(best.cov[0, 0]))
    if best.suspect.cause == "joint":
        words = {"joint": names[joint], "same": ""}
        if joint == 0:
            words["same"] = ", or the rig rotated about the axis of this joint: the two look alike"
    said = make_finding(kind, evidence, best.begin_s, cost_m=cost_m, also=alternatives, words={"more": "", **words})
    return replace(said, what=said.what + unsure)
