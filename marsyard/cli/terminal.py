"""Output of commands on the terminal: console, tables, and sizes."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from marsyard.reports.section import Grid


def create_console(*, stderr: bool = False) -> Console:
    """Create a console for a command's output."""
    from rich.console import Console

    return Console(stderr=stderr)


def size_text(count: float) -> str:
    """Format a number of bytes with a unit prefix."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count:.0f} bytes"


def grid_table(title: str, grid: Grid) -> Table:
    """Convert a table of a report to a terminal table: names left-aligned, numbers right-aligned."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left")
    for index, heading in enumerate(grid.head):
        table.add_column(heading, justify="right" if index else "left", overflow="fold")
    for row in grid.rows:
        table.add_row(*map(Text, row))
    return table
