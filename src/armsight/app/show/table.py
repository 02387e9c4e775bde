"""Tables for people: one record, shown as HTML in a page, and in the terminal.

On a terminal a table is printed with rich; elsewhere (a pipe, a file) it is plain text with aligned columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import click
from rich.console import Console
from rich.table import Table

from armsight.app.show import page


@dataclass(frozen=True)
class TextTable:
    """A table.

    Attributes:
        title: one line.
        columns: titles of the columns; the first is that of the rows' names, and may be empty.
        rows: cells of plain text, as many as there are columns.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def html_table(table: TextTable) -> str:
    """Return a table of numbers as HTML, its title above it."""
    head = [page.text(cell) for cell in table.columns]
    rows = [[page.text(cell) for cell in row] for row in table.rows]
    title = f"<p>{page.text(table.title)}</p>\n" if table.title else ""
    return title + page.table(head, rows, "numbers")


def print_table(table: TextTable) -> None:
    """Print a table on stdout; colours and lines only where that is a terminal."""
    console = Console(highlight=False)
    if not console.is_terminal:
        click.echo(plain_text(table))
        return
    shown = Table(
        title=table.title,
        title_justify="left",
        box=None,
        pad_edge=False,
        padding=(0, 2, 0, 0),
        show_header=any(table.columns),
    )
    for number, column in enumerate(table.columns):
        title = "\n".join(column.rsplit(" ", 1))
        shown.add_column(title, justify="right" if number else "left", no_wrap=True)
    for row in table.rows:
        shown.add_row(*row)
    console.print(shown)


def plain_text(table: TextTable) -> str:
    """Return a table as lines of text: names to the left, the other columns right-aligned."""
    lines = [*([table.columns] if any(table.columns) else []), *table.rows]
    widths = [max(len(line[k]) for line in lines) for k in range(len(table.columns))]

    def aligned(line: tuple[str, ...]) -> str:
        cells = [
            line[0].ljust(widths[0]),
            *(cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True)),
        ]
        return "  ".join(cells).rstrip()

    return "\n".join([table.title, *map(aligned, lines)])
