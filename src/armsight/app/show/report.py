"""One result: a Report is made once by the command that found something, and shown as text, JSON, page and exit code."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import click
import numpy as np

from armsight.app.show import page
from armsight.app.show.encode import json_of
from armsight.app.show.messages import UNTRUSTED, Level, Note, note, weak
from armsight.app.show.plotting import Figure, data_csv, drawing, png, require_matplotlib, svg
from armsight.app.show.table import TextTable, html_table, plain_text
from armsight.data import Image


@dataclass(frozen=True)
class Fact:
    """Something that was found."""

    sentence: str = ""  #: for people; empty where the values are for programs alone
    #: by their JSON keys, SI units, sigmas among them: whatever :func:`~armsight.app.show.encode.json_of` takes.
    values: Mapping[str, Any] = field(default_factory=dict)


ON_PAGE = 6  # lines that a page shows unfolded; half: a reader unfolds all, double: long pages


@dataclass(frozen=True)
class Lines:
    """Lines that belong together."""

    lines: Sequence[str]
    title: str = ""  #: stands above them on the terminal, where they are indented; empty: they are not
    #: so many are printed, and how many more there are; 0: none; the page folds those beyond ON_PAGE
    most: int | None = None
    none: str = ""  #: what is said instead where there are none


@dataclass(frozen=True)
class Plot:
    """A figure on the page, and as PNG and SVG beside it, with its data as CSV."""

    name: str
    #: plots it, or returns an image (H, W, 3) BGR; None where there is nothing to plot
    draw: Callable[[], Figure | Image | None]
    caption: str  #: HTML; empty: it is a file alone
    description: str  #: for who cannot see it
    folded: bool = False  #: whether it stands beneath its description until a reader asks for it
    zoom: bool = False  #: on the page it stays sharp and the mouse wheel enlarges it


@dataclass(frozen=True)
class Html:
    """HTML that stands on the page alone."""

    html: str


@dataclass(frozen=True)
class Text:
    """Text that stands on the terminal alone."""

    text: str


Grade = Literal["good", "fair", "poor"]
_COLOURS: Mapping[Grade, str] = {"good": "green", "fair": "yellow", "poor": "red"}
#: Files that a figure is written to: picture, lines that stay sharp, and what it shows as numbers.
FIGURE_SUFFIXES = (".png", ".svg", ".data.csv")
Block = Fact | Lines | TextTable | Plot | Html | Text
#: Title on the page, and what stands there.
Section = tuple[str, Sequence[Block]]


@dataclass(frozen=True)
class Report:
    """A result."""

    name: str
    heading: str
    sub: str  #: the line below it
    headline: str  #: the result in one line; empty: the first section says it
    sections: Mapping[str, Section]
    notes: Sequence[Note] = ()
    values: Mapping[str, Any] = field(default_factory=dict)  #: what programs read besides the facts
    prefix: str = "report"
    #: grade and sentence: what was done, how good it is, and what to do next; None: the first section says it
    assessed: tuple[Grade, str] | None = None

    @property
    def blocks(self) -> list[Block]:
        """What stands in all sections."""
        return [block for _, blocks in self.sections.values() for block in blocks]

    def noted(self, level: Level) -> list[str]:
        """Return the notes of one level."""
        return [note.text for note in self.notes if note.level == level]

    def json(self) -> dict[str, Any]:
        """Return what programs read: the values of all facts, and the notes."""
        found: dict[str, Any] = {"notes": self.noted("note"), "weak": self.noted("weak"), **self.values}
        for block in self.blocks:
            found |= block.values if isinstance(block, Fact) else {}
        return {key: json_of(value) for key, value in found.items()}

    def json_text(self) -> str:
        """Return a file of it."""
        return json.dumps(self.json(), indent=1) + "\n"

    def text(self, *, styled: bool = False) -> str:
        """Return what people read on a terminal, with colours or without."""
        lines = [f"do not trust this result: {why}" for why in self.noted("untrusted")]
        if self.assessed:
            grade, sentence = self.assessed
            lines.append(click.style(sentence, fg=_COLOURS[grade]) if styled else sentence)
        lines += [self.headline] if self.headline else []
        for block in self.blocks:
            match block:
                case Fact(sentence) if sentence:
                    lines.append(sentence)
                case Lines():
                    lines += _printed(block)
                case Text(text):
                    lines.append(text)
                case TextTable():
                    lines += ["", plain_text(block), ""]
        lines += map(weak, self.noted("weak"))
        return "\n".join(lines).strip("\n")

    def page(self, images: Mapping[str, bytes]) -> str:
        """Return the page; ``images`` maps the names of figures to PNG data."""
        said = [*(f"do not trust this result: {why}" for why in self.noted("untrusted"))]
        grade, sentence = self.assessed or ("", self.headline)
        box = assessment([*said, sentence], self.headline if self.assessed else "", "poor" if said else grade)
        bodies = {
            anchor: "".join(_html(block, images) for block in blocks) for anchor, (_, blocks) in self.sections.items()
        }
        first = next((anchor for anchor, body in bodies.items() if body), next(iter(bodies)))
        bodies[first] = box + page.bullets([*self.noted("weak"), *self.noted("note")]) + bodies[first]
        shown = {
            anchor: (self.sections[anchor][0], body.replace("</ul>\n<ul>", ""))
            for anchor, body in bodies.items()
            if body
        }
        zooms = any(isinstance(block, Plot) and block.zoom for block in self.blocks)
        return page.html_page(f"armsight: {self.name}", self.heading, self.sub, shown, page.ZOOM if zooms else "")

    def write(self, folder: Path, files: Mapping[str, str | bytes] = MappingProxyType({})) -> Path:
        """Draw the figures, and write page, figures and further files into a folder.

        Raises:
            InputError: matplotlib is missing, or a file cannot be written; then none of the new ones is left.
        """
        plots = {f"{self.prefix}-{block.name}".lstrip("-"): block for block in self.blocks if isinstance(block, Plot)}
        if plots:
            require_matplotlib()
        folder, images, pictures = page.writable_folder(folder, "no report"), dict[str, bytes](), dict[str, bytes]()
        with drawing() if plots else contextlib.nullcontext():
            for file, plot in plots.items():
                if isinstance(drawn := plot.draw(), np.ndarray):
                    import cv2

                    images[plot.name] = pictures[f"{file}.png"] = cv2.imencode(".png", drawn)[1].tobytes()
                elif drawn is not None:
                    data = dict(zip(FIGURE_SUFFIXES, (png(drawn), svg(drawn), data_csv(drawn)), strict=True))
                    pictures |= {f"{file}{suffix}": each for suffix, each in data.items()}
                    images[plot.name] = data[".svg" if plot.zoom and plot.caption else ".png"]
        beside = {name: data.encode() if isinstance(data, str) else data for name, data in files.items()}
        page.put_files(folder, {**pictures, **beside, page.PAGE: self.page(images).encode()})
        for file in (
            {f"{name}{suffix}" for name in plots for suffix in FIGURE_SUFFIXES} - pictures.keys() - files.keys()
        ):
            (folder / file).unlink(missing_ok=True)
        return folder / page.PAGE

    def echo(self, *, as_json: bool, written: str | None = None, **more: object) -> int:
        """Print the result, notes on stderr, and return the exit code."""
        note(*self.noted("note"))
        click.echo(json.dumps({**self.json(), **json_of(more)}) if as_json else self.text(styled=True))
        if written is not None and not as_json:
            click.echo(f"\nwritten: {written}")
        return UNTRUSTED if self.noted("untrusted") else 0


def figure_files(prefix: str, names: Iterable[str]) -> tuple[str, ...]:
    """Return the names of all files that the figures of a report may have."""
    return tuple(f"{prefix}-{name}{suffix}" for name in names for suffix in FIGURE_SUFFIXES)


def figures(
    plots: Mapping[str, tuple[Callable[..., Figure | None], str, str]], *of: object, folded: Sequence[str] = ()
) -> dict[str, Section]:
    """Return a section for each figure: name -> (what plots it from ``of``, title, caption as HTML).

    Those whose names are in ``folded`` are one section, each beneath a line.
    """
    blocks = {
        name: Plot(name, partial(draw, *of), caption, title, name in folded)
        for name, (draw, title, caption) in plots.items()
    }
    shown: dict[str, Section] = {name: (plots[name][1], [plot]) for name, plot in blocks.items() if not plot.folded}
    more = [plot for plot in blocks.values() if plot.folded]
    return shown | ({"more": ("More figures", more)} if more else {})


def _printed(block: Lines) -> list[str]:
    """Return lines as a terminal shows them."""
    if not block.lines:
        return [block.none] if block.none else []
    if block.most == 0:
        return []
    if not block.title:
        return list(block.lines)
    shown = [f"  {line}" for line in block.lines[: block.most]]
    more = len(block.lines) - len(shown)
    return ["", block.title, *shown, *([f"  and {more} more"] if more else [])]


def assessment(headlines: Sequence[str], meaning: str = "", grade: str = "") -> str:
    """Return the box at the top of a page, HTML; ``grade`` is its colour: good, fair or poor."""
    said = "".join(f'<p class="headline">{page.sentence(line)}</p>' for line in headlines if line)
    more = f"<p>{page.sentence(meaning)}</p>" if meaning else ""
    return f'<div class="assessment {grade}">{said}{more}</div>\n' if said else ""


def _html(block: Block, images: Mapping[str, bytes]) -> str:
    match block:
        case Html(html):
            return html
        case TextTable():
            return html_table(block)
        case Plot(name, _, caption, description, folded, zoom) if caption and name in images:
            said = caption if caption.startswith("<p") else f"<p>{caption}</p>"
            shown = page.picture(images[name], description, zoom=zoom)
            figure = f"<figure>{shown}<figcaption>{said}</figcaption></figure>\n"
            return page.folded(description, figure) if folded else figure
        case Fact(sentence) if sentence:
            return page.bullets([sentence])
        case Lines() if block.lines or block.none:
            first, more = block.lines[:ON_PAGE] or [block.none], block.lines[ON_PAGE:]
            title = f"<p>{page.text(block.title)}</p>\n" if block.title and block.lines else ""
            return title + page.bullets(first) + page.folded(f"and {len(more)} more", page.bullets(more))
    return ""
