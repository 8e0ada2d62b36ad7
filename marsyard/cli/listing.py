"""The catalogue on the terminal, and as plain data: without what running campaigns needs, so that it comes at once."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text


def catalogue_table(campaigns: Mapping[str, Path]) -> Table:
    """The campaigns of the catalogue, a row each."""
    table = Table()
    for heading in ("campaign", "scenario", "cases", "description"):
        table.add_column(heading, overflow="fold")
    for name, path in campaigns.items():
        stated = _as_stated(path)
        texts = (str(stated.get(key, "")) for key in ("scenario", "cases", "description"))
        table.add_row(*(Text(text) for text in (name, *texts)))
    return table


def catalogue_data(campaigns: Mapping[str, Path]) -> list[dict[str, Any]]:
    """The campaigns of the catalogue as plain data."""
    told = []
    for name, path in campaigns.items():
        stated = _as_stated(path)
        told.append(
            {"name": name, "file": str(path), **{k: stated.get(k) for k in ("scenario", "cases", "description")}}
        )
    return told


def _as_stated(path: Path) -> dict[str, Any]:
    """A campaign's file as it stands; what is wrong with it is said by whoever runs it."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        return {"description": f"cannot be read: {error}"}
