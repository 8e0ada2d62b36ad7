"""`marsyard dashboard`: a static site over stored campaigns, and a server for it on this machine alone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from marsyard.cli.options import handle_user_errors

LOOPBACK = "127.0.0.1"


@handle_user_errors
def dashboard(
    directories: Annotated[
        list[Path], Argument(metavar="DIR...", help="Folders of campaigns, or their parent folders.")
    ],
    out: Annotated[Path, Option("--out", metavar="DIR", help="The site's folder.")] = Path("site"),
    requirements: Annotated[
        Path | None, Option("--requirements", metavar="FILE", help="Requirements to show in place of ours.")
    ] = None,
    serve: Annotated[
        int | None, Option("--serve", metavar="PORT", help="Serve the site on this machine only.", min=0)
    ] = None,
    host: Annotated[str, Option("--host", metavar="ADDRESS", help="With --serve: address to listen on.")] = LOOPBACK,
) -> None:
    """Write a dashboard over stored campaigns: requirements, latest verdicts, trends, pages of campaigns and cases."""
    from marsyard.campaigns.definition.requirements import read_requirements
    from marsyard.campaigns.errors import CampaignError, writing
    from marsyard.reports.dashboard.site import write_site

    missing = [str(one) for one in directories if not one.is_dir()]
    if missing:
        raise CampaignError(f"no such folder: {', '.join(missing)}")
    stated = None if requirements is None else {one.id: one for one in read_requirements(requirements)}
    with writing(out):
        site = write_site(out, directories, stated)
    for problem in site.problems:
        typer.echo(f"not shown: {problem}", err=True)
    typer.echo(f"campaigns: {site.campaigns}")
    typer.echo(f"dashboard: {site.index}")
    if serve is not None:
        _serve(out, host, serve)


def _serve(directory: Path, host: str, port: int) -> None:
    from marsyard.campaigns.errors import CampaignError
    from marsyard.cli.site_server import server

    try:
        serving = server(directory, host, port)
    except (OSError, OverflowError) as error:
        raise CampaignError(f"--serve {port}: {error}") from error
    with serving:
        typer.echo(f"serving: http://{host}:{serving.server_port}/ (Ctrl-C ends it)")
        try:
            serving.serve_forever()
        except KeyboardInterrupt:
            typer.echo("ended")
