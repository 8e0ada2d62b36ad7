"""Command `marsyard dataset`: write training data."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from marsyard.cli import options
from marsyard.cli.console import size_text
from marsyard.cli.errors import handle_user_errors


@handle_user_errors
def dataset(
    campaign: options.CampaignArgument,
    out: Annotated[Path, Option(metavar="DIR", help="Folder of the shards.")],
    cases: options.CasesOption = None,
    seed: options.SeedOption = None,
    shard: Annotated[int, Option(metavar="N", min=1, help="Cases per shard.")] = 50,
    jobs: Annotated[int, Option(metavar="J", min=1, help="Worker processes.")] = 1,
    override: options.SetOption = None,
) -> None:
    """Write images with range, normals, rock masks, hazard maps and poses as WebDataset shards.

    Landing campaigns have two images per case. Existing shards are not written again.
    """
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.dataset import write_dataset

    shards = write_dataset(load_campaign(campaign, override or [], cases, seed), out, shard, jobs)
    total = sum(path.stat().st_size for path in shards)
    typer.echo(f"{len(shards)} shards, {size_text(total)}: {out}")
