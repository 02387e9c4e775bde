"""The report of a test: one page that holds its figures, the figures as PNGs, the numbers and the rows they are made of.

The figures of a test in words, mm.

Figures of a test's report: the poses' scatter, errors over the workspace, drift, paths, the circle.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from armsight.app.calibrate.report import bullets, table
from armsight.app.calibrate.report import text as cell_text
from armsight.app.check.rows import Row, rows_csv
from armsight.app.report.page import html_page, put_files
from armsight.app.report.plotting import BLUE, INK, MUTED, ORANGE, RED, drawing, new_figure, nice, png
from armsight.data import Array
from armsight.loop.iso9283.paths import square_to

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.projections.polar import PolarAxes

#: Name, short name and what it is, of every figure.
MEANINGS = {
    "AP": "pose accuracy: from the command to the middle of the attained places",
    "RP": "pose repeatability: mean distance from that middle, plus three standard deviations",
    "vAP": "accuracy from several directions: largest distance between their middles",
    "AD": "distance accuracy: error of the mean distance between two poses",
    "RD": "distance repeatability: three standard deviations of it",
    "dAP": "drift: how far the middle wanders over five parts of the time",
    "mean error": "mean distance from the command over all poses",
    "largest error": "the largest of them",
    "AT": "path accuracy: largest distance of the mean path from the commanded one",
    "RT": "path repeatability: the largest along it",
    "circularity": "largest less smallest radius",
    "hysteresis": "largest difference of the radii of both ways",
    "play": "how much the radius jumps where the motion along that direction turns back",
    "jump": "the same where a joint turns back: what its backlash does to the radius there",
}


def figures(facts: Mapping[str, Any]) -> Iterator[tuple[str, str, Mapping[str, float | None]]]:
    """Give short name, of what, and figure, of all figures of a test."""
    for name, p in facts.get("poses", {}).items():
        what = f"{name}, {p['count']} times"
        yield "AP", what, p["AP_m"]
        yield "RP", what, p["RP_m"]
        if name in facts.get("vAP_m", {}):
            yield "vAP", name, facts["vAP_m"][name]
    if "anywhere" in facts:
        a = facts["anywhere"]
        yield "mean error", f"{a['count']} poses", a["mean_m"]
        yield "largest error", f"{a['count']} poses", a["max_m"]
    if "distance" in facts:
        d = facts["distance"]
        what = f"{d['from']} to {d['to']}, {1e3 * d['commanded_m']:.1f} mm"
        yield "AD", what, d["AD_m"]
        yield "RD", what, d["RD_m"]
    if "drift" in facts:
        yield "dAP", f"{facts['drift']['pose']}, {np.ptp(facts['drift']['t_s']):.0f} s", facts["drift"]["max_m"]
    for name, p in facts.get("paths", {}).items():
        yield "AT", f"{name}, {p['count']} times", p["AT_m"]
        yield "RT", f"{name}, {p['count']} times", p["RT_m"]
    if "circle" in facts:
        c = facts["circle"]
        what = f"radius {1e3 * c['radius_m']:.1f} mm"
        yield "circularity", what, c["circularity_m"]
        yield "hysteresis", what, c["hysteresis_m"]
        for axis, play in zip(c["axes"], c["backlash_m"], strict=True):
            yield "play", f"along {direction(axis)}", play
        for turn in c["turns"]:
            way = "counter-clockwise" if turn["way"] > 0 else "clockwise"
            joints = ", ".join(map(str, turn["joints"]))
            yield (
                "jump",
                f"{'joints' if len(turn['joints']) > 1 else 'joint'} {joints} at {turn['angle_deg']:.0f} deg, {way}",
                turn["jump_m"],
            )


def direction(axis: list[float]) -> str:
    """Return a direction in words: x, or the numbers where it is along no axis of the base."""
    near = int(np.argmax(np.abs(axis)))
    return "xyz"[near] if axis[near] > 1 - 1e-6 else "({:.2f}, {:.2f}, {:.2f})".format(*(np.round(axis, 2) + 0.0))


def said(figure: Mapping[str, float | None]) -> str:
    """Return what a figure is, in words."""
    raw, clean, low, high, least = (1e3 * (figure[k] or 0.0) for k in ("raw", "clean", "low", "high", "resolvable"))
    if figure["low"] is None:
        return f"{raw:.3f} mm as measured; no interval without the instrument's sigma"
    if figure["clean"] is None:
        below = f"below {high:.3f} mm" if low >= 0 else f"{low:.3f} to {high:.3f} mm"
        return f"not resolvable: {below}; {least:.3f} mm could have been told ({raw:.3f} as measured)"
    return f"{clean:.3f} mm, {low:.3f} to {high:.3f} ({raw:.3f} as measured)"


def text(facts: Mapping[str, Any]) -> str:
    """Return all figures in words."""
    rows = list(figures(facts))
    wide = max(len(what) for _, what, _ in rows)
    lines = [f"{name:14s} {what:{wide}s}  {said(figure)}" for name, what, figure in rows]
    return "\n".join(
        ["figure without the instrument's noise, the interval that holds it to 95 %, as measured:", *lines]
    )


#: Poses that are shown with their scatter.
_MOST = 6
_VIEWS = ((0, 1, "from above"), (0, 2, "from the side"))


def scatter_figure(facts: Mapping[str, Any], rows: Sequence[Row]) -> Figure | None:
    """Draw the attained places of each pose about their middle, coloured by when, and RP as a circle."""
    from matplotlib.ticker import MaxNLocator

    names = list(facts.get("poses", {}))[:_MOST]
    if not names:
        return None
    figure = new_figure(4.6)
    panels = figure.subplots(2, len(names), squeeze=False, sharex=True, sharey=True)
    reach = 0.0
    for column, name in enumerate(names):
        p = _places(rows, name)
        off, middle = p - p.mean(axis=0), facts["poses"][name]
        RP = middle["RP_m"]["clean"]
        reach = max(reach, 1.15 * float(np.abs(off).max()), 1.1 * (RP or 0.0))
        for row, (i, j, view) in enumerate(_VIEWS):
            ax = panels[row, column]
            dots = ax.scatter(
                1e3 * off[:, i], 1e3 * off[:, j], c=np.arange(len(off)) + 1, cmap="viridis", s=13, zorder=3
            )
            ax.axhline(0, color="#e4e7eb", lw=0.8, zorder=0)
            ax.axvline(0, color="#e4e7eb", lw=0.8, zorder=0)
            _ring(ax, 1e3 * (RP if RP is not None else middle["RP_m"]["high"]), dotted=RP is None)
            ax.set_aspect("equal")
            if row == 0:
                ax.set_title(f"{name}: command is\n{1e3 * middle['AP_m']['raw']:.2f} mm off")
            if row == 1:
                ax.set_xlabel("x, mm")
            if column == 0:
                ax.set_ylabel(f"{'xyz'[j]}, mm ({view})")
    panels[0, 0].set_xlim(-1e3 * reach, 1e3 * reach)
    panels[0, 0].set_ylim(-1e3 * reach, 1e3 * reach)
    bar = figure.colorbar(dots, ax=panels, label="time round", shrink=0.7)
    bar.locator = MaxNLocator(integer=True)
    bar.update_ticks()
    return figure


def _ring(ax: Axes, radius: float, *, dotted: bool) -> None:
    a = np.linspace(0, 2 * np.pi, 120)
    ax.plot(radius * np.cos(a), radius * np.sin(a), color=ORANGE, lw=1.2, ls=":" if dotted else "-")


def _places(rows: Sequence[Row], name: str) -> Array:
    return np.array([row.T[:3, 3] for row in rows if row.test == "pose" and row.pose == name])


def anywhere_figure(facts: Mapping[str, Any], rows: Sequence[Row]) -> Figure | None:
    """Draw where in the workspace the error is how large."""
    if "anywhere" not in facts:
        return None
    chosen = [row for row in rows if row.test == "pose"]
    at = np.array([row.T_command[:3, 3] for row in chosen])
    error = 1e3 * np.linalg.norm([(row.T - row.T_command)[:3, 3] for row in chosen], axis=1)
    figure = new_figure(3.6)
    panels = figure.subplots(1, 3, width_ratios=(1, 1, 1))
    for ax, (i, j, view) in zip(panels, _VIEWS, strict=False):
        dots = ax.scatter(at[:, i], at[:, j], c=error, s=26, cmap="viridis", vmin=0)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_title(view)
        ax.set_xlabel(f"{'xyz'[i]}, m")
        ax.set_ylabel(f"{'xyz'[j]}, m")
    figure.colorbar(dots, ax=list(panels[:2]), label="error, mm", shrink=0.8)
    panels[2].hist(error, bins=15, color=BLUE)
    panels[2].set_xlim(left=0)
    panels[2].set_title("poses")
    panels[2].set_xlabel("error, mm")
    return figure


def drift_figure(facts: Mapping[str, Any], rows: Sequence[Row]) -> Figure | None:
    """Draw where the first pose was attained over time, and the wander of its middle."""
    if "drift" not in facts:
        return None
    d = facts["drift"]
    chosen = [row for row in rows if row.test == "pose" and row.pose == d["pose"] and row.t_s is not None]
    t = np.array([row.t_s for row in chosen], float)
    p = np.array([row.T[:3, 3] for row in chosen])
    figure = new_figure(3.2)
    ax = figure.subplots()
    for i, colour in enumerate((RED, "#2f7d4f", BLUE)):
        ax.plot(t - t.min(), 1e3 * (p - p.mean(axis=0))[:, i], ".-", lw=0.7, ms=4, color=colour, label="xyz"[i])
    ax.plot(np.array(d["t_s"]) - t.min(), 1e3 * np.array(d["dAP_m"]), "s-", color=INK, ms=5, label="dAP")
    ax.axhline(0, color="#e4e7eb", lw=0.8, zorder=0)
    ax.set_xlabel("s")
    ax.set_ylabel(f"{d['pose']} about its middle, mm")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4)
    return figure


def paths_figure(facts: Mapping[str, Any], rows: Sequence[Row]) -> Figure | None:
    """Draw how far off each path is along it."""
    if "paths" not in facts:
        return None
    figure = new_figure(3.2)
    ax = figure.subplots()
    for (name, p), colour in zip(
        facts["paths"].items(), (BLUE, ORANGE, MUTED, RED) * len(facts["paths"]), strict=False
    ):
        share = 100 * (np.arange(len(p["off_m"])) + 1) / (len(p["off_m"]) + 1)
        ax.plot(share, 1e3 * np.array(p["off_m"]), color=colour, label=name)
        cycles = {row.cycle for row in rows if row.test == "path" and (row.approach or "path") == name}
        for cycle in sorted(cycles):
            chosen = [r for r in rows if r.test == "path" and (r.approach or "path") == name and r.cycle == cycle]
            off = np.array([(row.T - row.T_command)[:3, 3] for row in chosen])
            off = (square_to(np.array([row.T_command[:3, 3] for row in chosen])) @ off[..., None])[..., 0]
            ax.plot(share, 1e3 * np.linalg.norm(off, axis=1), color=colour, lw=0.5, alpha=0.5)
    ax.set_ylim(bottom=0)
    ax.set_xlabel("of the way, %")
    ax.set_ylabel("distance from the path, mm\n(thick: of the mean path)")
    ax.legend()
    return figure


def circle_figure(facts: Mapping[str, Any], rows: Sequence[Row]) -> Figure | None:
    """Draw the circle, its deviations enlarged, both ways, with the play that its quadrants show."""
    if "circle" not in facts:
        return None
    c = facts["circle"]
    angle = np.radians(np.append(c["angle_deg"], c["angle_deg"][0]))
    radii = 1e3 * np.array(c["radii_m"])
    span = max(float(np.abs(radii).max()), 1e-6)
    figure = new_figure(6.4)
    ax = cast("PolarAxes", figure.subplots(subplot_kw={"projection": "polar"}))
    for way, name, colour in ((0, "counter-clockwise", BLUE), (1, "clockwise", ORANGE)):
        ax.plot(angle, np.append(radii[way], radii[way][0]), color=colour, lw=1.4, label=name)
    ax.plot(np.linspace(0, 2 * np.pi, 200), np.zeros(200), color=MUTED, lw=0.9, ls="--", label="fitted circle")
    ax.set_ylim(-3 * span, 1.6 * span)
    step = nice(span / 1.5)
    ax.set_yticks([-step, 0, step], ["", "", ""])
    ax.set_thetagrids([0, 90, 180, 270], [f"{a} deg" for a in (0, 90, 180, 270)])
    for k in range(4):
        jumps = " / ".join(f"{1e3 * s[k]:+.3f}" for s in c["steps_m"])
        ax.annotate(
            f"jump, mm\n{jumps}", (np.radians(90 * k), -1.5 * span), ha="center", va="center", color=INK, fontsize=8
        )
    told: list[float] = []
    for turn in c["turns"]:
        if any(abs((turn["angle_deg"] - other + 180) % 360 - 180) < 5 for other in told):
            continue  # the same joints, the other way
        told.append(turn["angle_deg"])
        at = np.radians(turn["angle_deg"])
        ax.plot([at, at], [-0.2 * span, 1.1 * span], color=RED, lw=0.8, ls=":")
        label = "J" + ",".join(map(str, turn["joints"]))
        ax.annotate(label, (at, 1.3 * span), ha="center", va="center", color=RED, fontsize=8)
    first, second = (direction(axis) for axis in c["axes"])
    ax.set_title(
        f"radius {1e3 * c['radius_m']:.1f} mm, grey rings {step:g} mm off; 0 deg is along {first}, 90 deg along {second}"
    )
    ax.legend(loc="lower left", bbox_to_anchor=(-0.35, -0.02))
    return figure


PAGE = "report.html"
#: Anchor -> title, how it is drawn (None where there is nothing to draw), and what it shows.
FIGURES: dict[str, tuple[str, Callable[[Mapping[str, Any], Sequence[Row]], Figure | None], str]] = {
    "scatter": (
        "The poses",
        scatter_figure,
        "Where each pose was attained, about the middle of it, and RP as a circle: dotted where it cannot be resolved, "
        "then it is the bound. The instrument's noise is still in the dots.",
    ),
    "anywhere": ("The workspace", anywhere_figure, "How far from the command each pose was attained."),
    "drift": (
        "Drift",
        drift_figure,
        "Where the first pose was attained over time, and how far its middle has wandered.",
    ),
    "paths": (
        "The paths",
        paths_figure,
        "Distance from the commanded path along it: mean path thick, every cycle thin.",
    ),
    "circle": (
        "The circle",
        circle_figure,
        "Deviations from the fitted circle, enlarged. Where the motion along an axis turns back the radius jumps by the "
        "play: at each such place stands the jump counter-clockwise / clockwise, mm. J: these joints turn back there; the "
        "play of an arm of turning joints shows there, and not where x or y turns back.",
    ),
}


def write_check(facts: Mapping[str, Any], rows: Sequence[Row], source: Path, folder: Path) -> Path:
    """Write the report of a test.

    Args:
        facts: its figures.
        rows: what they are made of.
        source: where those came from.
        folder: an existing folder; files of an earlier report in it are replaced.

    Returns:
        The page; check.json, check.csv and the figures are beside it.

    Raises:
        InputError: matplotlib is missing, or a file cannot be written; then none of the new ones is left.
    """
    images: dict[str, bytes] = {}
    with drawing():
        for name, (_, draw, _) in FIGURES.items():
            drawn = draw(facts, rows)
            if drawn is not None:
                images[name] = png(drawn)
    files = {f"check-{name}.png": data for name, data in images.items()}
    files["check.json"] = (json.dumps(facts, indent=1) + "\n").encode()
    files["check.csv"] = rows_csv(list(rows)).encode()
    put_files(folder, {**files, PAGE: _page(facts, images, source).encode()})
    for name in FIGURES.keys() - images.keys():
        (folder / f"check-{name}.png").unlink(missing_ok=True)
    return folder / PAGE


def _page(facts: Mapping[str, Any], images: Mapping[str, bytes], source: Path) -> str:
    """Return the page."""
    sections = {"result": ("Result", _result(facts))}
    for name, data in images.items():
        title, _, caption = FIGURES[name]
        image = f'<img src="data:image/png;base64,{base64.b64encode(data).decode("ascii")}" alt="{cell_text(title)}">'
        sections[name] = (title, f"<figure>{image}<figcaption><p>{cell_text(caption)}</p></figcaption></figure>")
    return html_page("armsight: check", "What robots are judged by", f"ISO 9283 · {source}", sections)


def _mm(value: float | None) -> str:
    """Return a length, m, in mm; nothing where there is none."""
    return "" if value is None else f"{1e3 * value:.3f}"


def _result(facts: Mapping[str, Any]) -> str:
    """Return the table of all figures."""
    rows = []
    for name, what, f in figures(facts):
        raw, sigma, low, high, least = (_mm(f[key]) for key in ("raw", "sigma", "low", "high", "resolvable"))
        told = "not resolvable" if f["clean"] is None else _mm(f["clean"])
        ends = f"{low} to {high}" if low else ""
        rows.append((cell_text(name), cell_text(what), f"<b>{told}</b>", sigma, ends, raw, least))
    head = ("", "of", "mm", "sigma", "95 %, from to", "as measured", "could be told")
    used = {name for name, _, _ in figures(facts)}
    meant = [f"{name}: {meaning}." for name, meaning in MEANINGS.items() if name in used]
    words = (
        "<p>Each figure without the noise, the interval that holds the true one 95 times in a hundred, and the figure as "
        "the standard computes it. What the noise could make as well is called not resolvable; from which figure on it "
        "could have been told stands last. Without the instrument's sigma a figure may have no interval.</p>\n"
    )
    return words + table(head, rows, "numbers") + bullets(meant) + (bullets(facts["notes"]) if facts["notes"] else "")
