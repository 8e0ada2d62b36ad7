"""Commands `marsyard list` and `show`: the built-in campaigns, and the contents of one."""

import json
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from marsyard.cli.errors import handle_user_errors
from marsyard.cli.options import CampaignArgument, JsonOption, SetOption
from marsyard.cli.terminal import create_console


@handle_user_errors
def list_campaigns(as_json: JsonOption = False) -> None:
    """List the built-in campaigns."""
    import tomllib

    from rich.table import Table
    from rich.text import Text

    from marsyard.scenarios.systems import catalogue, problems

    for problem in problems():
        typer.echo(f"warning: {problem}", err=True)
    keys = ("scenario", "cases", "description")
    rows, table = [], Table()
    for heading in ("campaign", *keys):
        table.add_column(heading, overflow="fold")
    for name, path in catalogue().items():
        try:
            definition = tomllib.loads(path.read_text(encoding="utf-8"))  # not validated: `run` reports errors
        except (OSError, ValueError) as error:
            definition = {"description": f"cannot be read: {error}"}
        rows.append({"name": name, "file": str(path), **{key: definition.get(key) for key in keys}})
        table.add_row(Text(name), *(Text(str(definition.get(key, ""))) for key in keys))
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
    else:
        create_console().print(table)


@handle_user_errors
def show(
    campaign: CampaignArgument,
    override: SetOption = None,
    draw: Annotated[
        int | None, Option(metavar="N", help="Show the drawn parameter values of the first N cases.")
    ] = None,
    figure: Annotated[
        Path | None,
        Option(metavar="FILE", help="With --draw: write histograms and pairwise scatter plots (.svg, .png)."),
    ] = None,
    as_json: Annotated[bool, Option("--json", help="Print JSON, with all draws.")] = False,
) -> None:
    """Show a campaign: parameters, dispersions with their sources, requirements; with --draw its random values."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.errors import CampaignError
    from marsyard.cli.showing import describe_campaign, show_campaign, show_draws, write_draws_figure

    if figure is not None and draw is None:
        raise CampaignError("--figure plots draws: give the number of cases with --draw N")
    selected = load_campaign(campaign, override or [])
    if figure is not None and draw is not None:
        write_draws_figure(selected, draw, figure)
    if as_json:
        typer.echo(json.dumps(describe_campaign(selected, draw), indent=2))
    elif draw is None:
        show_campaign(selected, create_console())
    else:
        show_draws(selected, draw, create_console())
    if figure is not None:
        typer.echo(f"figure: {figure}", err=as_json)
