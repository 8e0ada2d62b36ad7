"""Commands `marsyard dashboard` and `assure`: publish stored campaigns as a web site or as an assurance package."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from marsyard.cli.errors import Exit, handle_user_errors

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
        raise typer.Exit(1 if site.problems else 0)
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


@handle_user_errors
def assure(
    runs: Annotated[
        list[Path] | None, Argument(metavar="[RUN...]", help="Folders of finished campaigns, one or more.")
    ] = None,
    out: Annotated[Path, Option(metavar="DIR", help="New folder of the package.")] = Path("assurance"),
    sign: Annotated[
        Path | None, Option(metavar="KEY", help="Sign the package with this OpenSSH key (ssh-keygen -Y sign).")
    ] = None,
    verify: Annotated[
        Path | None, Option(metavar="DIR", help="Verify a package: every file, row, record, verdict and claim.")
    ] = None,
    signers: Annotated[
        Path | None,
        Option(metavar="FILE", help="With --verify: require a signature by a key of this file of allowed signers."),
    ] = None,
) -> None:
    """Write an assurance package: claims, arguments, evidence and open defeaters of campaigns in one offline folder.

    The exit status does not depend on the verdicts. With --verify it is 1 if the package does not verify.
    """
    from marsyard.campaigns.errors import CampaignError

    if verify is not None:
        if runs or sign is not None:
            raise CampaignError("--verify verifies an existing package: give no RUN and no --sign")
        _verify_package(verify, signers)
        return
    if not runs:
        raise CampaignError("give the folders of one or more finished campaigns, or --verify DIR")
    if signers is not None:
        raise CampaignError("--signers needs --verify")
    _write_package(runs, out, sign)


def _write_package(runs: list[Path], out: Path, key: Path | None) -> None:
    from marsyard.campaigns.errors import StoreError, report_write_errors
    from marsyard.campaigns.store.temporary_files import create_folder
    from marsyard.reports.assurance.package import MANIFEST, PAGE, write_package
    from marsyard.reports.assurance.signature import check_key, sign_file
    from marsyard.reports.wording import count

    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StoreError(f"{out} is not an empty folder; choose another folder with --out")
    if key is not None:
        check_key(key)
    with report_write_errors(out), create_folder(out) as folder:
        argument = write_package(runs, folder)
        if key is not None:
            sign_file(folder / MANIFEST, key)
    for run in argument.runs:
        typer.echo(f"{run.report.campaign}: {run.report.verdict}, {count(run.report.cases, 'case')}")
    typer.echo(f"claim: {argument.root.state}; {count(len(argument.defeaters), 'open defeater')}")
    typer.echo(f"package: {out / PAGE}{'' if key else ' (not signed)'}")
    typer.echo(f"to verify: marsyard assure --verify {out}")


def _verify_package(folder: Path, signers: Path | None) -> None:
    from marsyard.reports.assurance.verification import verify_package
    from marsyard.reports.wording import count

    result = verify_package(folder, signers)
    for note in result.notes:
        typer.echo(f"checked: {note}" if not note.startswith("no signature") else note)
    for problem in result.problems:
        typer.echo(f"problem: {problem}")
    if result.problems:
        typer.echo(f"NOT VERIFIED: {count(len(result.problems), 'problem')} in {folder}")
        raise typer.Exit(Exit.FAILED)
    typer.echo(f"OK: {folder}")
