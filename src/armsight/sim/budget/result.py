"""The budget of a plan: what it will measure, what each cause costs, and what would change it. m and rad inside."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, reduce
from itertools import combinations, product
from typing import Any, NamedTuple

from armsight.data import Record
from armsight.errors import InputError
from armsight.sim.budget.plan import KEYS, CameraClass, RigPlan, catalogue, planned, up
from armsight.vision.calibrate.budget import CAUSES, LEVEL, Budget

#: Least share of its variance that a velocity keeps among shots of which the fastest MOST_LOST are lost: that of a normal
#: distribution that is cut at 1.96 sigma on both sides.
_LEFT = 0.759
#: A change that gains less than this share is not worth a line; half: lines that nobody buys, double: cheap gains lack.
WORTH = 0.1
#: Share of shots in motion that may be lost at the worst position: beyond it 95 % of the shots are within nothing; half:
#: longer exposures and skews count as not reached, double: an answer holds for fewer shots than it says.
MOST_LOST = 1 - LEVEL
AT_REST = "measure at rest"
#: Share of a plan's speed below which a slower one is not searched; half: one search longer, double: slow ones lack.
_LEAST_OF = 1e-3
_MEASURED = {"body_print": "0.01mm", "body_bent": "0.02mm", "body_size": 1e-4}
#: What would make it better -> class of its price, 0 for nothing, and what of a plan it changes.
CHANGES: dict[str, tuple[int, Callable[[RigPlan], dict[str, object]]]] = {
    "start both cameras by one trigger": (2, lambda plan: {"skew_ms": 0.0, "start_ms": 0.05}),
    AT_REST: (0, lambda plan: {"speed": "0m/s"}),
    "twice as many pairs of the board": (0, lambda plan: {"pairs": 2 * plan.pairs}),
    "cameras 1.5 times as far apart": (0, lambda plan: {"baseline": f"{1.5e3 * plan.baseline_m:g}mm"}),
    "a body half as large again": (1, lambda plan: {} if plan.body else {"body_scale": 1.5 * plan.body_scale}),
    "half the exposure, twice the light": (1, lambda plan: {"exposure_ms": 0.5e3 * plan.timing["exposure"]}),
    "a board printed on a stiff plate, its size measured": (1, lambda _: {"board_print": 1e-4, "board_bent": "0.03mm"}),
    "the body's markers measured after printing": (0, lambda _: dict(_MEASURED)),
    "switch the autofocus off": (0, lambda _: {"refocus_ppm": 0.0}),
    "calibrate again when the room is 1 K warmer": (0, lambda _: {"warming_k": 1.0}),
}
#: What another class of cameras brings along, beside its lens.
OF_CAMERA = dict.fromkeys(("skew_ms", "start_ms", "exposure_ms", "refocus_ppm"), -1.0)
#: What ``best`` may choose where the plan does not name it: key -> least and most, m, image widths, and a factor.
BOUNDS = {"baseline": (0.04, 1.0), "distance": (0.15, 4.0), "focal_widths": (0.6, 4.0), "body_scale": (0.4, 1.6),
          "body_depth": (1.0, 2.0)}  # fmt: skip
#: Factors by which it is changed, one after the other; a last one nearer to 1: longer, and better by less than predicted.
_FACTORS = (1.5, 1.15)
_ENOUGH = 0.01  # a step that gains a smaller share ends the search; half: half as long again, double: 2 % worse
#: What was measured is within this factor of what was predicted (docs/measured.md): nearer alternatives are one group.
PREDICTED = 1.25
#: Causes that have no model, each with its reason.
NOT_MODELLED = (
    "the detector's failures (glints, hidden markers): the workcell has them, the budget does not",
    "smear by a camera that mixes images of a moving scene",
    "an autofocus that searches while it measures",
    "poses of the board other than all over the images; `live` asks for the next one where it helps most",
    "a mount that bends, not only grows, as it warms",
    "a board on the body that is bent: it counts as one rigid marker",
)


class Accuracy(NamedTuple):
    """The RMS over the volume, m, rad; what 95 % of the errors are within at its worst or mean position; the share lost."""

    rms_m: float
    rms_rad: float
    level_m: float
    level_rad: float
    lost_share: float = 0.0

    @staticmethod
    def of(found: Budget, plan: RigPlan, *, moving: bool = False, loop: bool = False) -> Accuracy:
        """Return that of a budget, by default at rest; in motion of the shots that are not lost."""
        cov, lost = found.cov(moving=moving, loop=loop), float(found.lost.max()) if moving else 0.0
        far, rotated = map(plan.overall, found.at_level(cov))
        return Accuracy(*found.rms(cov), far, rotated, lost)

    def over(self, m: float = 1.0, rad: float = 0.0) -> float:
        """Return the levels over what is requested; more than 1, and rising, where more shots are lost than may be."""
        value, lost = max(self.level_m / m, self.level_rad / rad if rad else 0.0), self.lost_share / MOST_LOST
        return max(value, 1.0) * lost if lost > 1 else value

    @property
    def mm(self) -> float:
        """What 95 % are within at the worst position."""
        return 1e3 * self.level_m

    @property
    def deg(self) -> float:
        """What 95 % are within at the worst position."""
        return math.degrees(self.level_rad)

    def __str__(self) -> str:
        """Return both, for people."""
        return f"{self.mm:.2g} mm, {self.deg:.2g} deg"


class Cause(NamedTuple):
    """What one cause costs: its RMS, its share of the variance of positions in motion, and what halving it leaves."""

    cause: str
    rms_m: float
    rms_rad: float
    share: float
    halved_level_m: float
    moving: bool
    common: bool
    loop: bool


class Improvement(NamedTuple):
    """What would make it better: the class of its price, 0 for nothing, and the accuracy in motion that it leads to."""

    change: str
    price: int
    level_m: float
    lost_share: float


@dataclass(frozen=True, eq=False)
class RigBudget(Record):
    """What a plan will measure, or a rig that there is; in mm and degrees: ``mm``, ``deg``, ``at_rest.mm``."""

    plan: RigPlan
    found: Budget  #: the covariances by cause and position, m and rad.
    group: int = 0  #: of alternatives: those of one differ by less than what the prediction is off.

    def __repr__(self) -> str:
        """Return the answer in one line."""
        return f"RigBudget({self.moving} in motion; {self.at_rest} at rest; 95 % at the {self.plan.objective} position)"

    @cached_property
    def moving(self) -> Accuracy:
        """In motion."""
        return Accuracy.of(self.found, self.plan, moving=True)

    @cached_property
    def at_rest(self) -> Accuracy:
        """At rest."""
        return Accuracy.of(self.found, self.plan)

    @cached_property
    def states(self) -> dict[str, Accuracy]:
        """moving, at_rest; closed_loop_at_rest where there is an arm; one_camera and three_cameras, at rest."""
        loop = {"closed_loop_at_rest": Accuracy.of(self.found, self.plan, loop=True)} if self.plan.arm else {}
        others = {"one_camera": planned(self.plan, 1), "three_cameras": planned(self.plan, 3)}
        found = {name: Accuracy.of(each, self.plan) for name, each in others.items()}
        return {"moving": self.moving, "at_rest": self.at_rest} | loop | found

    @property
    def mm(self) -> float:
        """What 95 % of the errors in motion are within."""
        return self.moving.mm

    @property
    def deg(self) -> float:
        """The same of rotations."""
        return self.moving.deg

    @cached_property
    def causes(self) -> tuple[Cause, ...]:
        """The causes, the costliest first."""
        found, total, rows = self.found, self.moving.rms_m**2, []
        for name in found.factors:
            (m, rad), kind = found.rms(found.cov(of=name, loop=True)), CAUSES[name]
            share, halved = 0.0 if kind.loop else m**2 / total, self.level_m(scaled=name, by=0.5)
            rows.append(Cause(name, m, rad, share, halved, kind.moving, kind.common, kind.loop))
        return tuple(sorted(rows, key=lambda row: (-row.share, -row.rms_m)))

    def reached(self, state: Accuracy) -> bool:
        """Return whether a state is within what was requested; true where nothing was."""
        return self.plan.requested is None or state.over(*self.plan.requested) <= 1

    def check(self) -> None:
        """Raise an InputError where the print of the body alone costs more than what was requested: no camera helps."""
        floor = [*map(self.plan.overall, self.found.at_level(self.found.cov(of="print of the body")))]
        states = (self.moving, f"at {self.plan.speed}"), (self.at_rest, "at rest")
        had = ", ".join(f"{up(s.mm)}mm,{up(s.deg)}deg {when}" for s, when in states if s.lost_share <= MOST_LOST)
        units = ("mm", 1e3), ("deg", 180 / math.pi)
        for least, most, (unit, scale) in zip(floor, self.plan.requested or (0.0, 0.0), units, strict=True):
            if 0 < most < least:
                raise InputError(
                    f"want {self.plan.want}: the print of the body alone costs {scale * least:.2g} {unit}, no "
                    f"camera reaches {scale * most:g}: {had} can be had with this plan, less with the body's markers "
                    "measured after printing: body_print, body_bent, body_size"
                )

    @cached_property
    def slower_m_s(self) -> float:
        """Speed, two digits, at which what was requested is reached, m/s; 0 where that is never, or at the plan's own."""
        plan, (speed, rotation), low = self.plan, self.plan.speeds, 0.0
        if self.reached(self.moving) or not self.reached(self.at_rest):
            return low
        high, now = speed, speed / max(self.moving.over(*plan.requested or ()), 1.0)
        # Planned again at each: faster, more shots are lost, the errors are of the others, and planning takes longer.
        while high > _LEAST_OF * speed and (now := float(f"{now:.2g}")) not in (low, high):
            at = f"{now:f}m/s,{math.degrees(rotation * now / speed):f}deg/s"
            reached = self.reached(Accuracy.of(planned(other := replace(plan, speed=at)), other, moving=True))
            low, high = (now, high) if reached else (low, now)
            now = min((low + high) / 2, 1.2 * low) if low else high / 1.5
        return low

    def level_m(self, **which: Any) -> float:  # noqa: ANN401
        """Return what 95 % are within for a covariance of the budget, by what :meth:`Budget.cov` takes."""
        return self.plan.overall(self.found.at_level(self.found.cov(**which))[0])

    @cached_property
    def changes(self) -> tuple[Improvement, ...]:
        """What would make it better in motion, the best of a price first."""
        plan, found = self.plan, list[tuple[int, float, Improvement]]()
        lens = {"focal_widths": plan.focal_px / plan.image_size_px[0]}  # it stays
        tried = [(text, price, lens | change(plan)) for text, (price, change) in CHANGES.items()]
        for name, each in catalogue().items():
            if each.price > plan.cameras.price and not plan.rig:
                tried.append((f"{name}: {each.text}", each.price, _of_camera(plan, name)))
        for text, price, change in tried:
            other = replace(plan, want="", **change)  # type: ignore[arg-type]
            if below(other, (1 - WORTH) * self.moving.over()) and (state := in_motion(other)):
                found.append((price, loss(other), Improvement(text, price, state.level_m, state.lost_share)))
        return tuple(one for *_, one in sorted(found))

    def to_dict(self) -> dict[str, Any]:
        """Return what ``armsight budget --json`` prints, in m and rad."""
        found, plan = self.found, self.plan
        rig = {"file": plan.rig, "image_size_px": plan.image_size_px, "baseline_m": plan.baseline_m}
        shares = {f"{share}_rms_m": found.rms(found.cov(of=share))[0] for share in ("precision", "trueness")}
        axes = zip(("lateral_rms_m", "depth_rms_m"), found.along(found.cov()), strict=True)
        return {
            "plan": {key: None if key in plan.of_rig or plan.left_out(key) else getattr(plan, key) for key in KEYS},
            **({"rig": rig} if plan.rig else {}),
            "focal_px": plan.focal_px,
            "results": {name: state._asdict() for name, state in self.states.items()},
            "lost_share_in_motion": float(found.lost.mean()),
            **shares,
            **dict(axes),
            "causes": [cause._asdict() for cause in self.causes],
            "changes": [change._asdict() for change in self.changes],
            "not_modelled": list(NOT_MODELLED),
        }


def budget(path: str = "", **plan: Any) -> RigBudget:  # noqa: ANN401
    """Say what a rig will measure before it is bought, what limits it, and what would change it.

    ``path``: a plan file, or nothing. ``plan``: keys of a plan, as its file has them
    (:class:`~armsight.sim.budget.plan.RigPlan`), such as ``rig="rig.json"``, ``body="plate.toml"``,
    ``camera="webcam-720p"``, ``distance="0.8m"``; they replace the file's. Raises InputError: an unknown key, a value that
    cannot be read, or a rig that cannot be built, with the nearest that can.
    """
    found = RigBudget(given := RigPlan.read(path, **plan), planned(given))
    found.check()
    return found


def best(plan: RigPlan, progress: Callable[[str], None] = lambda _: None) -> tuple[RigBudget, ...]:
    """Return the plans that measure best, one for each class of cameras, the cheapest first, then by mm.

    What the plan names stays. Both cameras see the body everywhere, in focus, its markers large enough
    (:meth:`~armsight.sim.budget.plan.RigPlan.check`).

    ``plan``: what is wished; ``progress``: called with each class of cameras as text. Raises InputError: none can be built;
    the message is that of the plan itself.
    """
    found, ends = list[RigBudget](), dict[CameraClass, RigPlan]()
    classes = [name for name, each in catalogue().items() if each.price]
    for name in [plan.camera] if "camera" in plan.named else classes:
        progress(name)
        alike = replace(catalogue()[name], name="", text="", price=0, bytes_px=0.0, usb=0.0)
        if alike not in ends:
            every = with_pairs(_searched(replace(plan, sets=1, **_of_camera(plan, name))))
            ends[alike] = next(one for one in every if loss(one) <= PREDICTED * loss(every[-1]))
        searched = replace(ends[alike], sets=plan.sets, camera=name)
        if math.isfinite(loss(searched)):
            found.append(RigBudget(searched, planned(searched)))
    if not found:
        replace(plan, **_of_camera(plan, plan.camera)).check()
        raise InputError("no class of the catalogue can measure this volume with what the plan names")
    found.sort(key=lambda one: one.moving.over())
    groups, first, group = list[RigBudget](), found[0], 0
    for one in found:
        if one.moving.over() > PREDICTED * first.moving.over():
            first, group = one, group + 1
        groups.append(replace(one, group=group))
    return tuple(sorted(groups, key=lambda one: (one.plan.cameras.price, one.moving.over())))


def with_pairs(plan: RigPlan) -> list[RigPlan]:
    """Return a plan with each number of pairs of the board that may be chosen: the named, or up to four times as many."""
    return [replace(plan, pairs=plan.pairs * by) for by in ((1,) if "pairs" in plan.named else (1, 2, 4))]


def _of_camera(plan: RigPlan, name: str) -> dict[str, Any]:
    """Return what another class of cameras changes; what the plan names stays."""
    brought = OF_CAMERA | {"focal_widths": catalogue()[name].own_lens}
    return {key: value for key, value in brought.items() if key not in plan.named} | {"camera": name}


@lru_cache(maxsize=128)
def in_motion(plan: RigPlan, *, known: bool = False) -> Accuracy | None:
    """Return the accuracy in motion; None for what cannot be built; ``known``: without what costs most to compute."""
    try:
        return Accuracy.of(planned(plan, known=known), plan, moving=True)
    except InputError:
        return None


def loss(plan: RigPlan, *, known: bool = False) -> float:
    """Return what 95 % are within in motion over what was requested, or m; infinity for what cannot be built.

    ``known``: a bound below it, without markers' noise, calibration and gates, in a fifth of the time.
    """
    state = in_motion(plan, known=known)
    found = state.over(*plan.requested or ()) if state else math.inf
    # Where gates are to be expected at most MOST_LOST are lost and the others slower, or more, which counts as 1 or more.
    return min(math.sqrt(_LEFT) * found, 1.0) if known and plan.apart else found


def below(plan: RigPlan, limit: float) -> bool:
    """Return whether the loss of a plan is below a limit; where its bound shows that, no more is computed."""
    return loss(plan, known=True) < limit and loss(plan) < limit


def chosen(found: Sequence[RigBudget]) -> RigBudget:
    """Return the cheapest alternative that reaches what was requested, else that with the least error."""
    enough = [one for one in found if one.plan.requested and one.reached(one.moving)]
    return enough[0] if enough else min(found, key=lambda one: loss(one.plan))


def kept(plan: RigPlan) -> set[str]:
    """Return what the search leaves: what is named, a body of its own or its depth where mm are asked, a webcam's lens."""
    own = {"body_scale": plan.body, "body_depth": plan.body or not (plan.requested or (0, 0))[1]}
    own["focal_widths"] = plan.cameras.own_lens > 0
    return {*plan.named, *(key for key, is_own in own.items() if is_own)}


def _searched(plan: RigPlan) -> RigPlan:
    """Return a plan by a pattern search over what is free (Hooke and Jeeves 1961), of the start that can be built."""
    fixed = kept(plan)
    free = [key for key in BOUNDS if key not in fixed]

    def changed(now: RigPlan, key: str, by: float) -> RigPlan:
        lens = now.focal_px / now.image_size_px[0]
        least, most = now.between_m if key == "distance" else BOUNDS[key]
        values = dict(zip(BOUNDS, (now.baseline_m, now.distance_m, lens, now.body_scale, now.body_depth), strict=True))
        value = float(f"{min(max(by * values[key], least), most):.3g}")
        new: dict[str, Any] = {key: f"{value:g}m" if key in ("baseline", "distance") else value}
        return replace(now, **new)

    def better(now: RigPlan, others: Iterable[RigPlan]) -> RigPlan:
        for other in others:
            now = other if below(other, (1 - _ENOUGH) * loss(now)) else now
        return now

    # A larger body needs more room, and a longer baseline: two at a time lead along such ridges.
    ways = [*((key,) for key in free), *combinations(free, 2)]
    now = better(plan, (changed(plan, "distance", by) for by in (0.6, 1.6, 2.5) if "distance" in free))
    for factor in _FACTORS:
        last = None
        while now is not last:
            last = now
            for keys, by in product(ways, (factor, 1 / factor)):
                while (other := better(now, [reduce(lambda each, key: changed(each, key, by), keys, now)])) is not now:
                    now = other
    ends: list[dict[str, Any]] = [{"verging_deg": 0.0}]
    if math.isfinite(loss(now)):
        found = RigBudget(now, planned(now))
        shorter = (2, 4) if found.level_m(scaled="exposure blur", by=0.0) < (1 - _ENOUGH) * found.level_m() else ()
        ends += [{"exposure_ms": 1e3 * now.timing["exposure"] / n} for n in shorter]
    return better(now, (replace(now, **end) for end in ends if not fixed & end.keys()))
