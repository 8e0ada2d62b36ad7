"""Console, and formatting of sizes, for the output of commands."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


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
