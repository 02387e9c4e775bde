"""Tables for people: one record, shown as HTML on a page, and as aligned text on the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from armsight.app.show import page


@dataclass(frozen=True)
class TextTable:
    """A table."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def html_table(table: TextTable) -> str:
    """Return a table of numbers as HTML, its title above it."""
    head = [page.text(cell) for cell in table.columns]
    rows = [[page.text(cell) for cell in row] for row in table.rows]
    title = f"<p>{page.text(table.title)}</p>\n" if table.title else ""
    return title + page.table(head, rows, "numbers")


def plain_text(table: TextTable) -> str:
    """Return a table as lines of text."""
    lines = aligned([*([table.columns] if any(table.columns) else []), *table.rows])
    return "\n".join([table.title, *lines])


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as lines: the first column to the left, the others right-aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    padded = [[row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])] for row in rows]
    return ["  ".join(cells).rstrip() for cells in padded]
