"""Command `marsyard ingest`: create a campaign from recorded images."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from marsyard.cli.errors import handle_user_errors

if TYPE_CHECKING:
    from marsyard.scenarios.systems import Ingested

#: Name of the campaign file.
CAMPAIGN_FILE = "campaign.toml"


@handle_user_errors
def ingest(
    folder: Annotated[
        Path,
        Argument(metavar="FOLDER", help="Folder with ingest.toml, images.csv and the images (docs/real-images.md)."),
    ],
    out: Annotated[Path, Option(metavar="DIR", help="New folder for the cases and the campaign file.")],
    system: Annotated[
        str | None,
        Option(
            help="System of an installed package whose importer reads the folder; by default the built-in importer, "
            "for the task that ingest.toml states: velocity, landing, matching or map."
        ),
    ] = None,
) -> None:
    """Create a campaign from recorded images with measured poses, or over a map."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.errors import CampaignError, StoreError, report_write_errors, unknown_name_message
    from marsyard.reports.wording import count
    from marsyard.scenarios.imports import import_object
    from marsyard.scenarios.systems import systems

    importers = {candidate.name: candidate.ingest for candidate in systems() if candidate.ingest}
    name = system or next(iter(importers))
    if name not in importers:
        raise CampaignError(f"--system: {unknown_name_message('system', name, importers)}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StoreError(f"{out} exists and is not empty; give a new folder with --out")
    partial_folder = out.with_name(f"{out.name}.part{os.getpid()}")
    try:
        with report_write_errors(f"{out}:"):
            partial_folder.mkdir(parents=True)
            ingested: Ingested = import_object(importers[name])(folder, partial_folder, out.resolve())
            (partial_folder / CAMPAIGN_FILE).write_text(ingested.campaign, encoding="utf-8")
            if out.exists():
                out.rmdir()
            partial_folder.rename(out)
    except ValueError as error:
        raise CampaignError(str(error)) from error
    finally:
        shutil.rmtree(partial_folder, ignore_errors=True)
    try:
        load_campaign(str(out / CAMPAIGN_FILE))
    except CampaignError:  # remove a campaign that cannot be run
        shutil.rmtree(out)
        raise
    typer.echo(f"{count(ingested.cases, 'case')} of {count(ingested.images, 'image')}: {out}")
    if ingested.note:
        typer.echo(ingested.note)
    typer.echo(f"to run the cases: marsyard run {out / CAMPAIGN_FILE}")
