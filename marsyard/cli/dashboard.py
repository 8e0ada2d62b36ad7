"""Command `marsyard dashboard`: publish stored campaigns."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from marsyard.cli.errors import handle_user_errors

LOOPBACK_ADDRESS = "127.0.0.1"


@handle_user_errors
def dashboard(
    directories: Annotated[
        list[Path], Argument(metavar="DIR...", help="Folders of campaigns, or their parent folders.")
    ],
    out: Annotated[Path, Option(metavar="DIR", help="Folder of the dashboard.")] = Path("site"),
    requirements: Annotated[
        Path | None, Option(metavar="FILE", help="Requirements file to use instead of the built-in requirements.")
    ] = None,
    serve: Annotated[
        int | None, Option(metavar="PORT", help="Also serve the dashboard over HTTP on this port.", min=0)
    ] = None,
    host: Annotated[str, Option(metavar="ADDRESS", help="With --serve: address to listen on.")] = LOOPBACK_ADDRESS,
) -> None:
    """Write a dashboard of stored campaigns: requirements, latest verdicts, trends, pages of campaigns and cases."""
    from marsyard.campaigns.definition.requirements import read_requirements
    from marsyard.campaigns.errors import CampaignError, report_write_errors
    from marsyard.reports.dashboard.site import write_site

    missing = [str(directory) for directory in directories if not directory.is_dir()]
    if missing:
        raise CampaignError(f"no such folder: {', '.join(missing)}")
    requirements_by_id = None if requirements is None else {item.id: item for item in read_requirements(requirements)}
    with report_write_errors(out):
        site = write_site(out, directories, requirements_by_id)
    for problem in site.problems:
        typer.echo(f"not shown: {problem}", err=True)
    typer.echo(f"campaigns: {site.campaigns}")
    typer.echo(f"dashboard: {site.index}")
    if serve is None:
        return
    from marsyard.reports.dashboard.server import create_server

    try:
        server = create_server(out, host, serve)
    except (OSError, OverflowError) as error:
        raise CampaignError(f"--serve {serve}: {error}") from error
    with server:
        typer.echo(f"serving: http://{host}:{server.server_port}/ (stop with Ctrl-C)")
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            typer.echo("stopped")
