"""Pages of reports: one HTML file that holds everything it shows and needs no network, and the folder it is written to."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from armsight.app.show.plotting import plain
from armsight.files import as_input_error, replacing, try_writing

#: A number, with its sigma or its unit; or the dash where there is none.
_NUMBER = re.compile(r"\u2013|[-+\u2212]?\d[\d.,]*(?: \u00b1 [\d.,]+)?(?: ?[%a-z\u00b0/]{1,5})?")
#: Before a sigma, and what keeps the two in one line.
PLUS_MINUS, NEVER_APART = "\u00b1 ", "\u00b1\u00a0"
#: Name of the page in the folder of every report.
PAGE = "report.html"
STYLE = """
:root { color-scheme: light; --back: #fff; --ink: #1f2933; --muted: #616e7c; --line: #e4e7eb; --soft: #f5f7fa;
  --link: #2b6cb0; --good: #2f7d4f; --fair: #b7791f; --poor: #b83232; }
@media screen and (prefers-color-scheme: dark) { :root { color-scheme: dark; --back: #16191d; --ink: #e4e7eb;
  --muted: #9aa5b1; --line: #323a42; --soft: #20252b; --link: #7fb2ea; --good: #58b981; --fair: #dba94a; --poor: #e57373; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.5rem 4rem; max-width: 64rem; background: var(--back); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 { font-size: 1.3rem; margin: 2.2rem 0 .7rem; padding-top: .9rem; border-top: 1px solid var(--line); }
h3 { font-size: 1.02rem; margin: 1.7rem 0 .5rem; }
p { margin: .5rem 0; max-width: 50rem; }
ul { padding-left: 1.2rem; max-width: 50rem; } li { margin: .2rem 0; }
.sub, nav { color: var(--muted); } nav { margin: .8rem 0 1.6rem; font-size: .92rem; }
nav a { color: var(--link); text-decoration: none; margin-right: 1.1rem; white-space: nowrap; }
.assessment { border-left: .4rem solid; background: var(--soft); padding: .8rem 1.2rem; margin: 1.2rem 0 1.6rem; }
.assessment p { margin: .25rem 0; } .headline { font-size: 1.25rem; font-weight: 650; }
.assessment.good { border-color: var(--good); } .assessment.fair { border-color: var(--fair); }
.assessment.poor { border-color: var(--poor); }
.grade { font-weight: 650; } .grade::before { content: "\\25CF\\00A0"; }
.grade.good { color: var(--good); } .grade.fair { color: var(--fair); } .grade.poor { color: var(--poor); }
table { border-collapse: collapse; margin: .8rem 0 1.2rem; font-size: .92rem; }
th, td { text-align: left; vertical-align: top; padding: .4rem 1.1rem .4rem 0; border-bottom: 1px solid var(--line);
  overflow-wrap: anywhere; }
thead th { color: var(--muted); font-weight: 500; } tbody th { font-weight: 550; }
table.headline td:nth-child(-n+4), table.headline th { white-space: nowrap; }
table.headline td { font-variant-numeric: tabular-nums; } table.headline td:last-child { color: var(--muted); }
table.headline { font-weight: 400; font-size: .95rem; }
table.prose th { font-weight: 400; } table.prose td { min-width: 18rem; }
table.numbers th { overflow-wrap: break-word; } table.numbers thead th { overflow-wrap: normal; }
table.numbers td { font-variant-numeric: tabular-nums; } td.number { white-space: nowrap; }
summary { cursor: pointer; color: var(--link); margin: .6rem 0; }
figure { margin: 0 0 1rem; } figure img { width: 100%; height: auto; display: block; background: #fff; }
figcaption { background: var(--soft); padding: .6rem 1.1rem; margin-top: .6rem; font-size: .95rem; }
figcaption p { margin: .3rem 0; }
@media screen and (max-width: 48rem) {  /* a row is a card: its name, and below it each value under its column's */
  thead { display: none; } table, tbody { display: block; } table, table.headline { font-size: .82rem; }
  tr { display: grid; grid-template-columns: repeat(auto-fill, minmax(6.6rem, 1fr)); gap: .2rem .4rem; padding: .45rem 0;
    align-items: end; border-bottom: 1px solid var(--line); }
  tr > * { border: 0; padding: 0; min-width: 0 !important; white-space: normal !important; } td:empty { display: none; }
  td::before { content: attr(data-column); display: block; color: var(--muted); font-size: .78rem; }
  tbody th, td:last-child:not(.number) { grid-column: 1 / -1; }
  figure::before { content: "Tap it to enlarge it."; position: sticky; left: 0; font-size: .85rem; color: var(--muted); }
  figure:focus-within { overflow-x: auto; } figure:focus-within :is(img, .zoom) { width: 46rem; max-width: none; }
  .zoom { touch-action: pan-x pan-y !important; } figcaption { position: sticky; left: 0; } }
@media print { body { max-width: none; padding: 0; } nav { display: none; }
  table, table.headline { font-size: .7rem; } table.headline th { white-space: normal; overflow-wrap: normal; }
  th, td { padding: .25rem .5rem .25rem 0; } figure { break-inside: avoid; }
  h2, h3, summary { break-after: avoid; } tr { break-inside: avoid; }
  details::details-content { content-visibility: visible; block-size: auto; } }  /* paper is not unfolded */
"""


def text(value: object) -> str:
    """Return a value as text that is safe anywhere in a page."""
    return html.escape(plain(str(value), most=2000))


def sentence(value: object) -> str:
    """Return the same of a sentence, what it has between backticks, to be typed, as code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", text(value))


def _cell(column: str, content: str) -> str:
    """Return a cell of a column; a number, with its sigma perhaps, stays in one line where there is room."""
    kind = ' class="number"' if _NUMBER.fullmatch(content) else ""
    return f'<td data-column="{column}"{kind}>{content.replace(PLUS_MINUS, NEVER_APART)}</td>'


def table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """Return an HTML table; ``head`` is plain text, escaped."""
    top = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    body = "".join(
        f'<tr><th scope="row">{first}</th>{"".join(_cell(*each) for each in zip(head[1:], rest, strict=True))}</tr>\n'
        for first, *rest in rows
    )
    return f'<table class="{kind}"><thead><tr>{top}</tr></thead>\n<tbody>\n{body}</tbody></table>\n'


def bullets(lines: Iterable[str]) -> str:
    """Return a list of plain lines, escaped; nothing where there are none."""
    items = "".join(f"<li>{sentence(line)}</li>\n" for line in lines)
    return f"<ul>{items}</ul>\n" if items else ""


def folded(summary: str, body: str) -> str:
    """Return HTML that is shown when a reader asks for it, under one line of plain text; nothing where there is none."""
    return f"<details><summary>{text(summary)}</summary>\n{body}</details>\n" if body else ""


def picture(data: bytes, description: str, *, zoom: bool = False) -> str:
    """Return an HTML image that holds its own data."""
    kind = "png" if data.startswith(b"\x89PNG") else "svg+xml"
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
    image = f'<img src="{source}" alt="{text(description)}" tabindex="0"{_ZOOMED if zoom else ""}>'
    return f'<div class="zoom" style="overflow:hidden;cursor:grab;touch-action:none">{image}</div>' if zoom else image


#: Script of a page: the wheel zooms about the pointer, dragging moves, a double click shows the whole again.
ZOOM = """
for (const box of document.querySelectorAll(".zoom")) {
  const img = box.firstElementChild; let k = 1, x = 0, y = 0, from = null;
  const show = () => { img.style.transform = `translate(${x}px,${y}px) scale(${k})`; };
  box.addEventListener("wheel", e => { e.preventDefault();
    const r = box.getBoundingClientRect(), px = e.clientX - r.left, py = e.clientY - r.top;
    const n = Math.min(40, Math.max(1, k * Math.exp(-e.deltaY / 400)));
    x = n > 1 ? px - (px - x) * n / k : 0; y = n > 1 ? py - (py - y) * n / k : 0; k = n; show(); }, {passive: false});
  box.addEventListener("pointerdown", e => { from = [e.clientX - x, e.clientY - y]; box.setPointerCapture(e.pointerId); });
  box.addEventListener("pointermove", e => {
    if (from && k > 1) { x = e.clientX - from[0]; y = e.clientY - from[1]; show(); } });
  box.addEventListener("pointerup", () => { from = null; });
  box.addEventListener("dblclick", () => { k = 1; x = y = 0; show(); });
}
"""
_ZOOMED = ' style="transform-origin:0 0" draggable="false"'


def html_page(title: str, heading: str, sub: str, sections: Mapping[str, tuple[str, str]], script: str = "") -> str:
    """Return a page."""
    links = "".join(f'<a href="#{anchor}">{name}</a> ' for anchor, (name, _) in sections.items())
    main = "".join(
        f'<section id="{anchor}">\n<h2>{name}</h2>\n{body}</section>\n' for anchor, (name, body) in sections.items()
    )
    end = f"<script>{script}</script>\n" if script else ""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f'<h1>{html.escape(heading)}</h1>\n<p class="sub">{html.escape(sub)}</p>\n<nav>{links}</nav>\n'
        f"<main>\n{main}</main>\n{end}</body>\n</html>\n"
    )


def writable_folder(directory: str | Path, contents: str) -> Path:
    """Make a folder and check that files can be written to it, before long work begins."""
    folder = Path(directory).expanduser()
    with as_input_error(f"{folder}: {contents} can be written here"):
        folder.mkdir(parents=True, exist_ok=True)
        try_writing(folder)
    return folder


def put_files(folder: Path, files: dict[str, bytes]) -> None:
    """Write files, each complete or not at all; where one fails, those that are new are removed again."""
    made: list[Path] = []
    try:
        for name, data in files.items():
            path = folder / name
            if not path.exists():
                made.append(path)
            with replacing(path, "wb") as file:
                file.write(data)
    except BaseException:
        for path in made:
            path.unlink(missing_ok=True)
        raise
