"""Tables of the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich import box
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from marsyard.reports.section import Grid


def grid_table(title: str, grid: Grid) -> Table:
    """Convert a table of a report to a terminal table: names left-aligned, numbers right-aligned."""
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left")
    for index, heading in enumerate(grid.head):
        table.add_column(heading, justify="right" if index else "left", overflow="fold")
    for row in grid.rows:
        table.add_row(*map(Text, row))
    return table
