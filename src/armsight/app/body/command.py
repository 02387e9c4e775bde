"""``armsight body``: assess a body file's geometry, and draw its markers to scale."""

from __future__ import annotations

import click

from armsight.app.body import PAPERS
from armsight.app.options import JSON, argument, declared, option, out
from armsight.app.show.messages import note, print_answer
from armsight.errors import InputError
from armsight.files import check_writable


@click.group("body")
def command() -> None:
    """Check a body file's geometry before the body is built, and print its markers to scale.

    The form of a body file: docs/howto/targets.md.
    """


@command.command()
@declared
def check(
    path: str = argument("BODY.toml"),
    rig_path: str | None = option(
        "The cameras; by default two perfect HD cameras, f 900 px, 0.2 m apart.", "--rig", metavar="RIG.json"
    ),
    distances: tuple[float, ...] = option(
        "Distance from the cameras, m; may be repeated. 0.6, 0.8 and 1.2 by default.", "--distance", metavar="M"
    ),
    as_json: bool = JSON,
) -> int:
    """Assess whether a body is identified by its discs, how well its pose is known, and what to change.

    Exit code 0: usable at every distance; 1: ambiguous or unusable at one of them; 2: no body file.
    """
    for distance in distances:
        if not 0.01 <= distance <= 100:
            raise InputError(f"--distance {distance:g}: expected metres, between 0.01 and 100")

    from armsight.app.body.check import assess
    from armsight.app.body.text import body_report
    from armsight.vision.markers.targets import read_layout
    from armsight.vision.pose.predict import plain_rig
    from armsight.vision.rig import StereoRig

    layout = read_layout(path)
    rig = plain_rig() if rig_path is None else StereoRig.load(rig_path)
    assessment = assess(layout, rig, tuple(sorted(set(distances))) or (0.6, 0.8, 1.2))
    body_report(path, layout, rig, rig_path, assessment).echo(as_json=as_json)
    return 0 if assessment.grade == "usable" else 1


@command.command()
@declared
def draw(
    paths: tuple[str, ...] = argument("BODY.toml|BOARD...", required=True),
    output: str = out("OUT", "The drawing: .pdf, .svg or .png.", kind="%PDF|<svg|PNG"),
    paper: str = option("", default="a4", type=click.Choice(list(PAPERS), case_sensitive=False)),
    split: bool = option("Split a drawing larger than the paper into several overlapping sheets."),
    dpi: int = option("Resolution of a .png, pixels per inch.", default=600, min=72, max=2400),
    as_json: bool = JSON,
) -> None:
    """Draw bodies' markers and calibration boards to scale: print at 100%, measure the bar, glue.

    BOARD is a spec such as chessboard:9x6:20mm. One page for each board and each plane of a body; .svg and .png have a file
    for each page and sheet.
    """
    check_writable(output, apart_from=paths)

    from armsight.app.body.draw import draw_body

    drawing = draw_body(paths, output, paper=paper.lower(), dpi=dpi, split=split)
    note(*drawing.notes)
    pages = [
        {"normal": page.normal.tolist(), "markers": [name or path for name in page.names]}
        for page, path in zip(drawing.pages, drawing.of, strict=True)
    ]
    lines = [f"page {number}: {', '.join(page['markers'])}" for number, page in enumerate(pages, start=1)]
    written = f"written to {', '.join(drawing.files)}; print at 100%, not fitted to the page, and measure the bar"
    answer = {"body": " ".join(paths), "files": drawing.files, "paper": paper.lower(), "pages": pages}
    print_answer(as_json, answer, *lines, written)
