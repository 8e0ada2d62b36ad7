"""`marsyard ingest`: a folder of real pictures with measured poses, made into a campaign of real cases."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from marsyard.cli.options import handle_user_errors

if TYPE_CHECKING:
    from marsyard.scenarios.system import Ingested

#: Name of the campaign's file.
CAMPAIGN_FILE = "campaign.toml"


@handle_user_errors
def ingest(
    folder: Annotated[
        Path, Argument(metavar="FOLDER", help="ingest.toml, pictures.csv and pictures (docs/real-pictures.md).")
    ],
    out: Annotated[Path, Option("--out", metavar="DIR", help="New folder of the cases and their campaign.")],
    system: Annotated[str | None, Option("--system", help="System of the cases; by default real pictures.")] = None,
) -> None:
    """Make a campaign of real cases from pictures with measured attitude and altitude."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.errors import CampaignError, StoreError, not_allowed
    from marsyard.reports.wording import count
    from marsyard.scenarios.systems import systems

    known = {one.name: one.ingest for one in systems() if one.ingest}
    chosen = system or next(iter(known))
    if chosen not in known:
        raise CampaignError(f"--system: {not_allowed('system', chosen, known)}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StoreError(f"{out} is there already, and is not empty; name a new folder with --out")
    made = _ingested(known[chosen], folder, out)
    try:
        load_campaign(str(out / CAMPAIGN_FILE))
    except CampaignError:
        # what cannot be run does not stay
        shutil.rmtree(out)
        raise
    typer.echo(f"{count(made.cases, 'case')} of {count(made.pictures, 'picture')}: {out}")
    if made.note:
        typer.echo(made.note)
    typer.echo(f"run them with: marsyard run {out / CAMPAIGN_FILE}")


def _ingested(path: str, folder: Path, out: Path) -> Ingested:
    """Write the cases of a folder with the function at ``module:NAME``, and their campaign; all of it or nothing."""
    from marsyard.campaigns.errors import CampaignError, StoreError
    from marsyard.scenarios.import_path import import_object

    unfinished = out.with_name(f"{out.name}.part{os.getpid()}")
    try:
        unfinished.mkdir(parents=True)
        made: Ingested = import_object(path)(folder, unfinished, out.resolve())
        (unfinished / CAMPAIGN_FILE).write_text(made.campaign, encoding="utf-8")
        if out.exists():
            out.rmdir()
        unfinished.rename(out)
    except ValueError as error:
        raise CampaignError(str(error)) from error
    except OSError as error:
        raise StoreError(f"{out}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return made
