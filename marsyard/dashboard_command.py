"""`marsyard dashboard`: a static site over stored campaigns, and a server for it on this machine alone."""

from __future__ import annotations

from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Annotated

import typer

from marsyard.campaign_command import says_what_is_wrong

LOOPBACK = "127.0.0.1"


@says_what_is_wrong
def dashboard(
    directories: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Folders of campaigns, or folders that hold such.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="The site's folder.")] = Path("site"),
    requirements: Annotated[
        Path | None, typer.Option("--requirements", metavar="FILE", help="The requirements to show, instead of ours.")
    ] = None,
    serve: Annotated[
        int | None, typer.Option("--serve", metavar="PORT", help="Serve the site, on this machine alone.", min=0)
    ] = None,
    host: Annotated[str, typer.Option("--host", metavar="ADDRESS", help="With --serve: where to listen.")] = LOOPBACK,
) -> None:
    """Write a dashboard over stored campaigns: requirements, latest verdicts, trends, pages of campaigns and cases."""
    from campaigns.definition.requirements import read_requirements
    from campaigns.errors import CampaignError, StoreError
    from reports.dashboard.site import write_site

    missing = [str(one) for one in directories if not one.is_dir()]
    if missing:
        raise CampaignError(f"no such folder: {', '.join(missing)}")
    stated = None if requirements is None else {one.id: one for one in read_requirements(requirements)}
    try:
        site = write_site(out, directories, stated)
    except OSError as error:
        raise StoreError(f"{out} cannot be written: {error}") from error
    for problem in site.problems:
        typer.echo(f"not shown: {problem}", err=True)
    typer.echo(f"campaigns: {site.campaigns}")
    typer.echo(f"dashboard: {site.index}")
    if serve is not None:
        _serve(out, host, serve)


class _Handler(SimpleHTTPRequestHandler):
    """Serves the site's files; lists no folders, follows nothing out of it, and keeps quiet."""

    def translate_path(self, path: str) -> str:
        """The file that a path of the address means; one that is not there where it leads out of the site."""
        found = Path(super().translate_path(path)).resolve()
        root = Path(self.directory).resolve()
        return str(found if found.is_relative_to(root) else root / "no such file")

    def list_directory(self, path: object) -> None:
        """Refuses."""
        self.send_error(404, "no such file")

    def log_message(self, *_: object) -> None:
        """Keeps quiet."""


def server(directory: Path, host: str, port: int) -> ThreadingHTTPServer:
    """A server of a site's folder; port 0 takes one that is free."""
    return ThreadingHTTPServer((host, port), partial(_Handler, directory=str(directory)))


def _serve(directory: Path, host: str, port: int) -> None:
    from campaigns.errors import CampaignError

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
