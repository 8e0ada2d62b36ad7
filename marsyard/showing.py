"""Campaigns on the terminal: the catalogue, and one campaign in full."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from campaigns.configuration import CampaignConfiguration
from campaigns.sampling import leaves
from reports.wording import asked_text


def catalogue_table(campaigns: Mapping[str, Path]) -> Table:
    """The campaigns of the catalogue, a row each."""
    table = _table("", "campaign", "scenario", "cases", "description")
    for name, path in campaigns.items():
        stated = _as_stated(path)
        texts = (str(stated.get(key, "")) for key in ("scenario", "cases", "description"))
        table.add_row(*(Text(text) for text in (name, *texts)))
    return table


def _as_stated(path: Path) -> dict[str, Any]:
    """A campaign's file as it stands; what is wrong with it is said by whoever runs it."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        return {"description": f"cannot be read: {error}"}


def show_campaign(configuration: CampaignConfiguration, console: Console) -> None:
    """Prints a campaign: what it is, its parameters, its dispersions and its requirements."""
    for line in (
        f"{configuration.name}: {configuration.description}",
        f"scenario {configuration.scenario}, {configuration.cases} cases, seed {configuration.seed}",
    ):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    console.print(_parameters(configuration))
    console.print(_dispersions(configuration))
    console.print(_requirements(configuration))


def _parameters(configuration: CampaignConfiguration) -> Table:
    table = _table("Parameters", "parameter", "value")
    for path, value in leaves(configuration.parameters):
        shown = "dispersed" if path in configuration.dispersions else str(value)
        table.add_row(Text(path), Text(shown))
    return table


def _dispersions(configuration: CampaignConfiguration) -> Table:
    table = _table("Dispersions", "parameter", "distribution", "source")
    for path, dispersion in configuration.dispersions.items():
        table.add_row(Text(path), Text(dispersion.describe()), Text(dispersion.source))
    return table


def _requirements(configuration: CampaignConfiguration) -> Table:
    table = _table("Requirements", "id", "statement", "asked")
    for asked in configuration.requirements:
        table.add_row(Text(asked.id), Text(asked.statement), Text(asked_text(asked, asked.metric)))
    return table


def _table(title: str, *headings: str) -> Table:
    table = Table(title=title or None, title_justify="left")
    for heading in headings:
        table.add_column(heading, overflow="fold")
    return table
