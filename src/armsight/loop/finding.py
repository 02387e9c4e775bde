"""What was found wrong: the record, its JSON, its line for people, and the table of causes that makes it of evidence."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import Enum
from typing import Any, Literal, NamedTuple

import numpy as np

from armsight.data import Array
from armsight.estimate.chance import chi_square_limit

#: rig: one camera against the other; body: the body, or what looks the same; fixed: the rig against the arm's base;
#: time: shots that are not of one time; lens: what the model of the cameras cannot express; joint: a potentiometer that
#: slipped, backlash that grew; estimator: measurements that contradict what it had learned, without another cause; host:
#: images that are delivered twice.
Cause = Literal["rig", "body", "fixed", "time", "lens", "joint", "estimator", "host"]
#: Probability of a false alarm of each test within a minute, while its noise model holds.
FALSE_ALARMS_PER_MINUTE = 1e-4
#: Chance of a test below which it widens poses; half: a change costs NEES for longer, double: healthy poses are too
#: wide.
SUSPECTED = 0.02
#: What displaces the tool by less, m, forbids no result. Half: webcams' processing is said, double: a stand's shaking
#: not.
COSTS_M = 1e-4
#: Explanations whose chi-squares differ by less are not distinguished. Half: the wrong one alone is named, double: more
#: alternatives stand beside it.
ALIKE = 12.0
#: A rotation counts by what it does at this distance from the body's origin, m.
LEVER_M = 0.1

#: What changes in the words of a finding while it is the same: 1.24, and 3 of 9; the number of a joint does not.
_MEASURED = re.compile(r"\d+\.\d+|\d+ of \d+")


class Trust(Enum):
    """How far a loop may rely on the poses that vision measures."""

    FULL = "nothing is suspected"
    DOUBTED = "measured poses contradict what was learned, and the cause is not known yet"
    NONE = "what vision measures is wrong: the cameras, the rig or the body moved"


@dataclass(frozen=True)
class HealthFinding:
    """Something that no longer holds, and because of which results must not be trusted."""

    cause: Cause  #: what is wrong: rig, body, fixed, time, lens, joint, estimator, host
    what: str  #: what was found, one sentence
    since_s: float | None  #: since when, s on the clock of the shots; None where the shots have no times
    size: float  #: by how much, in ``unit``
    sigma: float  #: standard deviation of the size
    unit: str  #: deg, mm, px, %, ms, or measurements
    advice: str  #: what to do
    alternatives: tuple[Cause, ...] = ()  #: other causes that explain it nearly as well
    corrected_s: float | None = None  #: when it was put right, s; None where it was not
    #: by how much it displaces the tool, or what is measured, at most so far, mm; None where that is not known
    cost_mm: float | None = None
    #: sigma of measured positions, as without what was found, the least since, mm; None without a pose
    pose_sigma_mm: float | None = None

    @property
    def subject(self) -> tuple[str, str]:
        """What it is about: its cause, and its words before it says by how much, without measured numbers and counts."""
        return self.cause, _MEASURED.sub("", self.what.partition(" by ")[0])

    def since(self, before: HealthFinding | None) -> HealthFinding:
        """Return it with the largest cost and the least sigma since it was found before: ``forbids`` does not flicker."""
        if before is None:
            return self
        costs, sigmas = (
            [each for each in both if each is not None]
            for both in ((self.cost_mm, before.cost_mm), (self.pose_sigma_mm, before.pose_sigma_mm))
        )
        cost_mm = None if self.cost_mm is None else max(costs)
        return replace(self, cost_mm=cost_mm, pose_sigma_mm=min(sigmas, default=None))

    @property
    def forbids(self) -> bool:
        """Whether results must not be trusted because of it: not where it displaces them by less than is known of them."""
        return self.cost_mm is None or self.cost_mm > max(1e3 * COSTS_M, self.pose_sigma_mm or 0.0)

    def to_json(self) -> dict[str, Any]:
        """Return the object that summary.json and ``--json`` hold."""
        return asdict(self)

    def line(self) -> str:
        """Return the finding as one line for people."""
        since = "" if self.since_s is None else f" since {self.since_s:.1f} s"
        right = "" if self.corrected_s is None else f", put right at {self.corrected_s:.1f} s"
        costs = "" if self.cost_mm is None else f", which displaces poses by up to {self.cost_mm:.2f} mm"
        sigma = "" if not costs or self.pose_sigma_mm is None else f" (sigma {self.pose_sigma_mm:.2f} mm)"
        return f"{self.cause}: {self.what}{since}{costs}{sigma}{right}; {self.advice}"


def sized(x: Array, cov: Array) -> tuple[float, float]:
    """Return the length of a vector (n,), and its standard deviation by its covariance (n, n)."""
    size = float(np.linalg.norm(x))
    along = x / max(size, 1e-12)
    return size, float(np.sqrt(along @ cov @ along))


def displacement_m(shift: Array) -> Array:
    """Return by how much tangents (..., 6), or roots of variances, displace the tool, m: rotations at ``LEVER_M``."""
    return np.asarray(np.linalg.norm(shift[..., :3], axis=-1) + LEVER_M * np.linalg.norm(shift[..., 3:], axis=-1))


def health_lines(health: Sequence[HealthFinding]) -> list[str]:
    """Return the lines for a log, a terminal or a report: none where nothing was found."""
    meanwhile = {True: "this result", False: "what was measured meanwhile"}
    return [
        f"do not trust {meanwhile[found.corrected_s is None]}: {found.line()}"
        if found.forbids
        else f"note: {found.line()}"
        for found in health
    ]


def unseen_lines(names: Sequence[str]) -> list[str]:
    """Return the lines for a log or a terminal on fixed bodies that could not be watched."""
    return [
        f"the fixed body {name} was seen too rarely to be watched: both cameras must see it, as its file describes it"
        for name in names
    ]


def alarm_limit(freedom: int, tests_per_s: float, hypotheses: int = 1, estimated: int | None = None) -> float:
    """Return the chi-square of an alarm (Bonferroni); ``estimated``: degrees of freedom of the noise, if unknown."""
    chance = FALSE_ALARMS_PER_MINUTE / (60.0 * tests_per_s * hypotheses)
    if estimated is None:
        return chi_square_limit(freedom, chance)
    from scipy.special import fdtri  # not above: SciPy takes longer than a pair of images

    # The reciprocal of F, since chance is far below what 1 resolves.
    return freedom / float(fdtri(estimated, freedom, chance))


_TO_UNIT = {"deg": float(np.degrees(1.0)), "mm": 1e3, "%": 100.0, "ms": 1e3, "px": 1.0, "measurements": 1.0}
#: Advice that several causes share.
_AGAIN = "fasten the cameras and calibrate the rig again"
_STEADY = "switch autofocus and image stabilisation off, fasten focus and zoom"
_ONE_CLOCK = "stamp images and readings by one clock, with the cameras' own stamps instead of times of arrival"
_TOGETHER = (
    "trigger both cameras together, with one rate and the same exposure; in a recording --skew find moves the detections "
    "to one time, and finds rolling shutters"
)
_BASES = "fasten the rig and the base of the arm, and run again: that repeats the hand-eye calibration"
_POINTS = "look at these points; clean or fasten them, and measure the body again (armsight body)"


class CauseRow(NamedTuple):
    """A cause."""

    cause: Cause
    unit: str  #: of its size
    what: str  #: one sentence: {size}, in the unit and without its sign, {way}, and words of the evidence
    advice: str
    ways: tuple[str, str] = ("", "")  #: what {way} says of a size above zero, and of another
    name: str = ""  #: what others cannot exclude
    alternatives: tuple[Cause, ...] = ()  #: other causes that explain it nearly as well


# fmt: off
CAUSES: dict[str, CauseRow] = {
    # The cameras against each other, the body, and their times.
    "rotated": CauseRow("rig", "deg",
        "the right camera is rotated by {size:.3f} deg and shifted by {shift_mm:.2f} mm against the left one, compared "
        "with the calibration{more}",
        _AGAIN, name="a rotation of one camera"),
    "scaled": CauseRow("body", "%",
        "the body looks {size:.2f} % {way} than its file says: the body file or the baseline of the rig is wrong, and "
        "the two cannot be distinguished",
        "measure the distances on the body with calipers; if they agree with its file, calibrate the rig again",
        ("larger", "smaller"), "a body of another size"),
    "skewed": CauseRow("time", "ms",
        "the right camera exposes {size:.2f} ms {way} than is known, against the left one",
        _TOGETHER, ("later", "earlier")),
    "apart": CauseRow("time", "ms",
        "the two exposures of a shot are about {size:.1f} ms apart, and by another time in each shot: one camera has "
        "another rate or drops images, or images of different moments are paired",
        _TOGETHER),
    "rolls": CauseRow("time", "ms",
        "the rows of the {side} camera are exposed one after the other, over {size:.1f} ms more than is known: a "
        "rolling shutter",
        _TOGETHER),
    "contradicted": CauseRow("rig", "px",
        "{shown}, and no one change of the cameras explains them: did they move again and again, or do left and right "
        "images not belong together?",
        "look at the pairs of images; fasten the cameras and calibrate the rig again", alternatives=("time",)),
    # What moves to and fro.
    "nods": CauseRow("rig", "deg",
        "a camera nods: the right one rotates by {size:.3f} deg (RMS) to and fro against the left one; which of the "
        "two moves cannot be distinguished",
        "fasten the cameras on one stiff bar, away from what vibrates; poses have this in their sigma"),
    "breathes": CauseRow("lens", "%",
        "a lens breathes: within a second the focal length of one camera changes by {size:.3f} % (RMS) to and fro "
        "against that of the other; which of the two cannot be distinguished",
        f"{_STEADY}; poses have this in their sigma", alternatives=("rig",)),
    "swings": CauseRow("lens", "%",
        "the focal length of one camera changes against that of the other by {size:.3f} % (RMS), within seconds",
        f"{_STEADY} of both lenses, calibrate the rig again", alternatives=("rig",)),
    "shake": CauseRow("fixed", "mm",
        "rig and arm shake against each other: the tool moves by {size:.2f} mm and {angle_deg:.3f} deg (RMS) to and "
        "fro within a second",
        "mount the rig and the arm on one stiff base, away from what vibrates; poses have this in their sigma"),
    # Lenses, and points of the body.
    "lens": CauseRow("lens", "px",
        "residuals of {size:.3f} px RMS depend on the position in the images alone, which the model of the cameras "
        "cannot express",
        "calibrate again with a richer lens model and with targets over the whole of both images; look for a lens that "
        "is loose or behind a window"),
    "focal": CauseRow("lens", "%",
        "the focal length of the {longer} camera is {size:.3f} % longer against that of the {shorter} one than "
        "calibrated{more}; which of the two changed cannot be distinguished",
        "fasten focus and zoom of both lenses, let the cameras warm up, and calibrate the rig again",
        alternatives=("rig",)),
    "strained": CauseRow("body", "mm",
        "the body is elongated, sheared or bent against its file: its lengths differ by {strain:.2f} % from one "
        "direction to another, {point} is displaced by {size:.2f} mm",
        "measure the body along two directions and both diagonals with calipers, or take its shape from images "
        "(armsight body); printers are off along one axis"),
    "point": CauseRow("body", "mm",
        "{point} is displaced by {size:.2f} mm on the body against its file: it moved, or is partly covered{more}",
        _POINTS),
    "points": CauseRow("body", "mm",
        "the body is bent, or points of it moved: against the others {points} are not where its file says",
        _POINTS),
    # Rig, body, joints and clock, as an arm shows them.
    "rig": CauseRow("fixed", "mm",
        "the rig moved against the base of the arm: the tool appears {by}",
        _BASES, name="a rig that moved"),
    "drift": CauseRow("fixed", "mm",
        "the rig drifts against the base of the arm: the tool appears {by}",
        _BASES, name="a rig that drifts"),
    "body": CauseRow("body", "mm",
        "the body slipped on the tool: it is {by}",
        "fasten the body on the tool, and run again", name="a body that slipped on the tool"),
    "bend": CauseRow("body", "deg",
        "what holds the body bends under gravity: by up to {size:.3f} deg and {shift_mm:.2f} mm",
        "stiffen the bracket of the body, fasten its screws, and run again", name="a bracket that bends under gravity"),
    "zoom": CauseRow("lens", "%",
        "both focal lengths changed alike by {signed:.3f} %: the tool appears {by}",
        "switch autofocus off, fasten focus and zoom of both lenses, calibrate the rig again",
        name="both focal lengths that changed alike"),
    "joint": CauseRow("joint", "deg",
        "the sensor of {joint} slipped by {signed:.2f} deg against its link{same}",
        "fasten the potentiometer, or the belt behind a motor's encoder, and set its zero (an AR4: home it)",
        name="a sensor of {joint} that slipped"),
    "backlash": CauseRow("joint", "deg",
        "the backlash of {joint} {way} by {size:.2f} deg",
        "look at the gear of this joint", ("grew", "shrank"), "more backlash of {joint}"),
    "time": CauseRow("time", "ms",
        "the images come {size:.2f} ms {way} than at the beginning, against the readings of the joints{more}",
        _ONE_CLOCK, ("later", "earlier"), "a clock that jumped"),
    "stamps": CauseRow("time", "ms",
        "the clock that stamps the images {how}, against their arrival; stamps were put right, to some milliseconds",
        "stamp images by a clock that nothing sets (monotonic), and open the cameras once"),
    "reopened": CauseRow("estimator", "measurements",
        "measured poses contradicted what had been learned about the arm {size:.0f} time{plural}",
        "check the body on the tool, the joints for slip, and for obstacles that the arm met"),
    # The cameras together, as fixed bodies and the background show them.
    "together": CauseRow("fixed", "mm",
        "both cameras moved together: by {size:.2f} mm and {angle_deg:.3f} deg, as {count} fixed bodies show{more}",
        "fasten the rig, and run again: that repeats the hand-eye calibration"),
    "not fixed": CauseRow("fixed", "mm",
        "{what}",
        "fasten what moved, or leave the body out of --fixed; more fixed bodies say more"),
    "scene": CauseRow("rig", "deg",
        "{who}, as {count} spots of the background show",
        _AGAIN),
    "scene together": CauseRow("fixed", "deg",
        "{who}, as {count} spots of the background show",
        "fasten the rig, and run again"),
    # What a sync LED and the first shots of a measurement show.
    "swept apart": CauseRow("time", "ms",
        "a sweep of the arm finds the images {size:.2f} ms {way} against the readings of the joints than the sync LED does "
        "against the board's clock, which was used",
        "look for joints that lag or slip (armsight identify), and for a filter of the readings before the board",
        ("later", "earlier")),
    "led": CauseRow("time", "ms",
        "{what} {size:.2f} ms {way} than at first, by the sync LED",
        "trigger both cameras by one signal, and use the cameras' own stamps instead of times of arrival",
        ("later", "earlier")),
    "shutters": CauseRow("time", "ms",
        "the cameras do not expose at one time: {shutters}",
        "--skew find moves the detections to one time"),
    "inconsistent": CauseRow("rig", "measurements",
        "in {size:.0f} of {shots} shots that were measured most points contradict each other, and no motion of the cameras "
        "explains most of them: one camera has another zoom or focus, or shows a part of its image, or left and right "
        "images do not belong together",
        "look at the pairs of images; calibrate the rig again with images as they are now", alternatives=("lens", "time")),
    "board": CauseRow("body", "measurements",
        "{other}: {size:.0f} shots were missed", "give the board as it is, as --target or in its file"),
    # The computer.
    "stalled": CauseRow("host", "ms",
        "the computer stalled {times}, for {size:.0f} ms at most: commands were late",
        "end other programs on this computer, or give the run a higher priority (chrt, nice)"),
    "repeated": CauseRow("host", "%",
        "{count} of {shots} shots repeat the one before: their images are older than their times",
        "lower the rate of the cameras, or give each its own USB controller"),
}
# fmt: on
CAUSES["rate"] = CAUSES["time"]._replace(name="a clock of another rate")


def make_finding(
    name: str,
    evidence: tuple[float, float],
    since_s: float | None = None,
    *,
    cost_m: float | None = None,
    unsure: str = "",
    also: tuple[Cause, ...] = (),
    unit: str | None = None,
    words: Mapping[str, object] | None = None,
) -> HealthFinding:
    """Return the finding of a cause, by the name of its row.

    Args:
        name: of the row.
        evidence: size and standard deviation, SI.
        since_s: since when, s; None where that is not known.
        cost_m: by how much it displaces the tool at most, m; None where that is not known: then it forbids any result.
        unsure: what cannot be excluded.
        also: more causes that explain it as well.
        unit: another one than the row's.
        words: what the row's sentence names besides.
    """
    row = CAUSES[name]
    unit = unit or row.unit
    size, sigma = (_TO_UNIT[unit] * float(each) for each in evidence)
    what = row.what.format(size=abs(size), signed=size, way=row.ways[size <= 0.0], **(words or {}))
    what += f"; {unsure} cannot be excluded" if unsure else ""
    cost_mm = None if cost_m is None else 1e3 * cost_m
    return HealthFinding(
        row.cause, what, since_s, size, sigma, unit, row.advice, (*row.alternatives, *also), cost_mm=cost_mm
    )
