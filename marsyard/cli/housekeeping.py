"""Commands `marsyard doctor`, `compile` and `clean`: check the installation, compile kernels, remove caches."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from marsyard.cli.errors import handle_user_errors
from marsyard.cli.options import JsonOption
from marsyard.cli.terminal import create_console, size_text

#: Kinds of cached files, and how they are rebuilt after removal.
KINDS = {
    "terrain": "terrains of campaigns; rebuilt when a case needs one, seconds to minutes each",
    "kernels": "compiled code; recompiled at the next run, about a minute",
}
#: Number of processes that compile the kernels of scenarios.
_COMPILING_PROCESSES = 2
#: Kind of cached files with a size limit (MARSYARD_CACHE_GB).
KIND_WITH_LIMIT = "terrain"


def doctor(as_json: JsonOption = False) -> None:
    """Check the machine and the installation, and print a remedy for each problem."""
    from marsyard.doctor import run as run_checks

    raise typer.Exit(run_checks(create_console(), as_json=as_json))


@handle_user_errors
def compile_kernels() -> None:
    """Compile the numeric kernels before the first run, by running a small descent, drive and landing.

    The compiled code is cached and valid until the source code changes.
    """
    from joblib import Parallel, delayed

    from marsyard.campaigns.running.compilation import list_compilations
    from marsyard.sim.kernel_cache import kernels_are_ready

    missing = []
    for item in list_compilations():
        if kernels_are_ready(item.scenario):
            typer.echo(f"{item.scenario}: already compiled")
        else:
            missing.append(item)
    # all scenarios call the kernels of the renderer: the first one compiles them, then the others run in parallel
    for group, jobs in ((missing[:1], 1), (missing[1:], _COMPILING_PROCESSES)):
        if group:
            lines = Parallel(n_jobs=jobs, return_as="generator")(delayed(_compile_scenario)(*item) for item in group)
            for line in lines:
                typer.echo(line)


def _compile_scenario(scenario: str, name: str, overrides: Sequence[str]) -> str:
    """Compile the kernels of a scenario; return a line of text."""
    from marsyard.campaigns.execution.worker_process import limit_threads
    from marsyard.campaigns.running.compilation import compile_campaign

    limit_threads()
    start_s = time.monotonic()
    compile_campaign(name, overrides)
    return f"{scenario}: compiled, {time.monotonic() - start_s:.0f} s"


@handle_user_errors
def clean(
    kinds: Annotated[
        list[str] | None, Argument(metavar="KIND", help="Kind of cache: terrain or kernels; by default both.")
    ] = None,
    yes: Annotated[bool, Option("--yes", help="Remove the files; by default they are only listed.")] = False,
    as_json: JsonOption = False,
) -> None:
    """List the caches on disk with their sizes; with --yes remove them.

    Folders of campaigns are not changed. Running campaigns continue and rebuild the files that they need.
    """
    from rich import box
    from rich.table import Table

    from marsyard.campaigns.errors import CampaignError, unknown_name_message

    for kind in kinds or []:
        if kind not in KINDS:
            raise CampaignError(unknown_name_message("kind", kind, KINDS))
    caches = [cache_usage(kind) for kind in kinds or KINDS]
    removed_bytes = sum(_remove_contents(cache["folder"]) for cache in caches) if yes else 0
    if as_json:
        typer.echo(json.dumps({"caches": caches, "removed_bytes": removed_bytes}, indent=2, default=str))
        return
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("kind", "files", "size", "limit", "folder", "contents"):
        is_numeric = heading in ("files", "size", "limit")
        table.add_column(heading, justify="right" if is_numeric else "left", overflow="fold")
    for cache in caches:
        limit = "none" if cache["limit_bytes"] is None else size_text(cache["limit_bytes"])
        kind, size = cache["kind"], size_text(cache["bytes"])
        table.add_row(kind, str(cache["files"]), size, limit, str(cache["folder"]), KINDS[kind])
    create_console().print(table)
    if yes:
        typer.echo(f"removed {size_text(removed_bytes)}")
    else:
        typer.echo("nothing was removed; to remove these files: marsyard clean --yes")


def _remove_contents(folder: Path) -> int:
    """Remove the files and folders in a folder, except those in use; return the size of the removed files, bytes."""
    from marsyard.sim.cache import UNFINISHED

    removed_bytes = 0
    for path in sorted(folder.rglob("*"), reverse=True):  # the contents of a folder before the folder
        try:
            if path.is_dir() and not path.is_symlink():
                path.rmdir()
            elif path.suffix != UNFINISHED:  # files with this suffix are being written by another process
                size = path.stat().st_size
                path.unlink()
                removed_bytes += size
        except OSError:  # not empty, in use, or already removed
            continue
    return removed_bytes


def cache_usage(kind: str) -> dict[str, Any]:
    """Return folder, number of files and size of a cache. Raises CampaignError for an invalid MARSYARD_CACHE_GB."""
    from marsyard.campaigns.errors import CampaignError
    from marsyard.sim.cache import cache_directory, limit_bytes

    folder = cache_directory(kind)
    sizes = []
    for path in folder.rglob("*"):
        try:
            if path.is_file() and not path.is_symlink():
                sizes.append(path.stat().st_size)
        except OSError:  # removed by another process
            continue
    size = sum(sizes)
    try:
        limit = limit_bytes(folder, size) if kind == KIND_WITH_LIMIT else None
    except ValueError as error:
        raise CampaignError(str(error)) from error
    return {"kind": kind, "folder": folder, "files": len(sizes), "bytes": size, "limit_bytes": limit}
