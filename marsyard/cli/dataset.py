"""`marsyard dataset`: a campaign's pictures with their truth, in shards for learning."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from marsyard.cli.campaign import CampaignArgument, CasesOption, SeedOption, SetOption, says_what_is_wrong, size_text


@says_what_is_wrong
def dataset(
    campaign: CampaignArgument,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of the shards.")],
    cases: CasesOption = None,
    seed: SeedOption = None,
    shard: Annotated[int, typer.Option("--shard", metavar="N", min=1, help="Cases in a shard.")] = 50,
    jobs: Annotated[int, typer.Option("--jobs", metavar="J", min=1, help="Worker processes.")] = 1,
    override: SetOption = None,
) -> None:
    """Write pictures with range, normals, rock masks, hazard maps and poses as WebDataset shards; again to go on.

    Of campaigns of landings. Two pictures a case; shards that are there stay.
    """
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.dataset import write_dataset

    shards = write_dataset(load_campaign(campaign, override or [], cases, seed), out, shard, jobs)
    total = sum(path.stat().st_size for path in shards)
    typer.echo(f"{len(shards)} shards, {size_text(total)}: {out}")
