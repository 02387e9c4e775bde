"""A page that holds everything it shows: style, sections, figures; needs no network."""

from __future__ import annotations

import html
from collections.abc import Mapping
from pathlib import Path

from armsight.files import replacing

STYLE = """
:root { color-scheme: light; --ink: #1f2933; --muted: #616e7c; --line: #e4e7eb; --soft: #f5f7fa;
  --good: #2f7d4f; --fair: #b7791f; --poor: #b83232; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.5rem 4rem; max-width: 64rem; background: #fff; color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 { font-size: 1.3rem; margin: 3rem 0 .9rem; padding-top: .9rem; border-top: 1px solid var(--line); }
h3 { font-size: 1.02rem; margin: 1.7rem 0 .5rem; }
p { margin: .5rem 0; max-width: 50rem; }
ul { padding-left: 1.2rem; max-width: 50rem; } li { margin: .35rem 0; }
.sub, nav { color: var(--muted); } nav { margin: .8rem 0 1.6rem; font-size: .92rem; }
nav a { color: #2b6cb0; text-decoration: none; margin-right: 1.1rem; white-space: nowrap; }
.verdict { border-left: .4rem solid; background: var(--soft); padding: .8rem 1.2rem; margin: 1.2rem 0 1.6rem; }
.verdict p { margin: .25rem 0; } .headline { font-size: 1.25rem; font-weight: 650; }
.verdict.good { border-color: var(--good); } .verdict.fair { border-color: var(--fair); }
.verdict.poor { border-color: var(--poor); }
.grade { font-weight: 650; } .grade::before { content: "\\25CF\\00A0"; }
.grade.good { color: var(--good); } .grade.fair { color: var(--fair); } .grade.poor { color: var(--poor); }
table { border-collapse: collapse; margin: .8rem 0 1.2rem; font-size: .92rem; }
th, td { text-align: left; vertical-align: top; padding: .4rem 1.1rem .4rem 0; border-bottom: 1px solid var(--line);
  overflow-wrap: anywhere; }
thead th { color: var(--muted); font-weight: 500; } tbody th { font-weight: 550; }
table.headline td:nth-child(-n+4), table.headline th { white-space: nowrap; }
table.headline td { font-variant-numeric: tabular-nums; } table.headline td:last-child { color: var(--muted); }
table.headline { font-weight: 400; font-size: .95rem; }
table.words th { font-weight: 400; } table.words td { min-width: 18rem; }
table.numbers tbody th { white-space: nowrap; } table.numbers td { font-variant-numeric: tabular-nums; }
figure { margin: 0 0 1rem; } figure img { width: 100%; height: auto; display: block; }
figcaption { background: var(--soft); padding: .6rem 1.1rem; margin-top: .6rem; font-size: .95rem; }
figcaption p { margin: .3rem 0; }
@media (max-width: 48rem) { table { display: block; overflow-x: auto; } }
@media print { body { max-width: none; padding: 0; } nav { display: none; } figure { break-inside: avoid; } }
"""


def html_page(title: str, heading: str, sub: str, sections: Mapping[str, tuple[str, str]], script: str = "") -> str:
    """Return a page.

    Args:
        title: of the browser's window.
        heading: the first line.
        sub: the line below it, plain text.
        sections: anchor -> title and HTML of each section, in order.
        script: JavaScript to run at its end.
    """
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


def put_files(folder: Path, files: dict[str, bytes]) -> None:
    """Put files in place, each whole; where one fails, those that were not there before are taken away again."""
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
