"""Omission of the rows and columns of a table that contain only dashes."""

from collections.abc import Sequence
from dataclasses import replace

from marsyard.reports.section import Grid
from marsyard.reports.wording import NOTHING


def omit_empty_rows(rows: Sequence[Sequence[str]]) -> tuple[list[Sequence[str]], str]:
    """Omit the rows that have only dashes; return the other rows and a sentence that names the omitted rows."""
    is_empty = [all(text == NOTHING for text in row[1:]) for row in rows]
    names = [row[0].split(" (")[0] for row, empty in zip(rows, is_empty, strict=True) if empty]
    sentence = f"Too few cases to estimate: {', '.join(names)}. " if names else ""
    return [row for row, empty in zip(rows, is_empty, strict=True) if not empty], sentence


def drop_empty_columns(grid: Grid) -> Grid:
    """Remove the columns after the first that contain only dashes."""
    kept = [0, *(index for index in range(1, len(grid.head)) if any(row[index] != NOTHING for row in grid.rows))]
    return replace(
        grid, head=[grid.head[index] for index in kept], rows=[[row[index] for index in kept] for row in grid.rows]
    )
