"""`marsyard ingest`: a folder of real pictures with measured poses, made into a campaign of real cases."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marsyard.cli.campaign import says_what_is_wrong

if TYPE_CHECKING:
    from marsyard.scenarios.measured.store import StoredCases

#: Name of the campaign's file.
CAMPAIGN_FILE = "campaign.toml"


@says_what_is_wrong
def ingest(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="ingest.toml, pictures.csv and pictures (docs/real-pictures.md).")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="New folder for the cases and their campaign.")],
) -> None:
    """Make a campaign of real cases from pictures with measured attitude and altitude."""
    from marsyard.campaigns.errors import CampaignError, StoreError
    from marsyard.scenarios.measured.ingest import ingest as ingested
    from marsyard.scenarios.measured.layout import INGEST_FILE, read_ingest_file

    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StoreError(f"{out} is there already, and is not empty; name a new folder with --out")
    unfinished = out.with_name(f"{out.name}.part{os.getpid()}")
    try:
        unfinished.mkdir(parents=True)
        path, stored = ingested(folder, unfinished)
        (unfinished / CAMPAIGN_FILE).write_text(campaign_text(stored, out.resolve() / path.name), encoding="utf-8")
        if out.exists():
            out.rmdir()
        unfinished.rename(out)
    except ValueError as error:
        raise CampaignError(str(error)) from error
    except OSError as error:
        raise StoreError(f"{out}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.reports.wording import count

    try:
        load_campaign(str(out / CAMPAIGN_FILE))
    except CampaignError:
        # what cannot be run does not stay
        shutil.rmtree(out)
        raise
    pictures = sum(len(case.pictures) for case in stored.cases)
    typer.echo(f"{count(len(stored.cases), 'case')} of {count(pictures, 'picture')}: {out}")
    if stored.detector.rows_summed > 1 and read_ingest_file(folder).detector.rows_summed is None:
        typer.echo(
            f"rows_summed = {stored.detector.rows_summed}: taken from the camera, whose pixels are longer than wide by "
            f"that factor; rows_summed under [detector] of {INGEST_FILE} says otherwise"
        )
    typer.echo(f"run them with: marsyard run {out / CAMPAIGN_FILE}")


def campaign_text(stored: StoredCases, cases: Path) -> str:
    """The campaign over ingested cases, whose `cases.json` will lie at a path."""
    number = len(stored.cases)
    values = ", ".join(str(place) for place in range(number))
    parts = [
        f"""# Real cases, written by `marsyard ingest {json.dumps(stored.folder)}`.
# Run it:            marsyard run {CAMPAIGN_FILE}
# With your own:     marsyard run {CAMPAIGN_FILE} --algorithm mypkg.mymodule:Estimator --algorithm OTHER
name = {json.dumps(stored.name)}
scenario = {json.dumps(f"measured-{stored.task}")}
description = {json.dumps(stored.description or _DESCRIPTIONS[stored.task])}
cases = {number}

# The pictures of every case are kept for the report.
[retain]
products = "all"
showcase = "none"

# All measurements, and the hash of every picture; should the folder move, only this path changes.
[parameters.cases]
file = {json.dumps(str(cases))}
""",
        _options(stored),
        f"""[dispersions]
number = {{ distribution = "grid", values = [{values}], source = "every case that was ingested" }}
""",
        _requirement(stored),
    ]
    return "\n".join(part for part in parts if part)


_DESCRIPTIONS = {
    "velocity": "Real descents: horizontal velocity from three pictures.",
    "landing": "Real flights: landing sites from two pictures.",
    "matching": "Real pictures against their measured poses.",
}


def _options(stored: StoredCases) -> str:
    """What the paper's algorithm must know of the pictures."""
    if stored.task != "velocity":
        return ""
    size = binned_size(stored.cases[0].pictures[0].size, stored.detector.rows_summed)
    about = "# DIMES works on square pixels, binned to about 256 columns."
    return f"{about}\n[parameters.dimes]\nbinned_size = {list(size)}\n"


def binned_size(delivered: tuple[int, int], rows_summed: int) -> tuple[int, int]:
    """The size (columns, rows) that DIMES bins delivered pictures to, whose rows are summed already."""
    from marsyard.scenarios.descent.parameters import binned_size_for

    columns, rows = binned_size_for(delivered[0], delivered[1] * rows_summed)
    return (columns, rows) if delivered[1] % rows == 0 else delivered


def _requirement(stored: StoredCases) -> str:
    """What is asked of errors where the truth is known; a proposal where it is not."""
    known = [case.name for case in stored.cases if case.truth.velocity_m_s is not None]
    if stored.task != "velocity" or not known:
        return """# No error can be required where no truth is known; the agreement of pictures and poses can:
# [[requirements]]
# id = "POSES"
# metric = "residual_median_px"
# bound = 2.0
# probability = 0.9
# confidence = 0.9
# decide_by = "estimate"
"""
    return """# Real cases are no random draws: their rate decides, from 100 cases on, and no confidence is claimed.
# MET BY RATE has the exit status 3; accept_rate = true makes it 0.
[[requirements]]
id = "VELOCITY"
statement = "The horizontal velocity that is reported is within 5 m/s of the true one."
metric = "velocity_error_m_s"
bound = 5.0
probability = 0.99
confidence = 0.90
decide_by = "estimate"
population = "valid and truth_known"
"""
