"""`marsyard clean` and `compile`: cached terrains and compiled kernels on disk."""

from __future__ import annotations

import json
import time
from typing import Annotated, Any

import typer
from typer import Argument, Option

from marsyard.cli.options import JsonOption, console, handle_user_errors, size_text

#: Kinds of cached files, and the cost of removing them.
KINDS = {
    "terrain": "terrains built for campaigns; built again when a case needs one, from seconds to minutes each",
    "kernels": "compiled code; compiled again in the next minute of running",
}
#: The kind with a size limit (MARSYARD_CACHE_GB).
LIMITED = "terrain"


@handle_user_errors
def clean(
    kinds: Annotated[
        list[str] | None, Argument(metavar="[KIND]...", help="terrain, kernels; by default all of them.")
    ] = None,
    yes: Annotated[bool, Option("--yes", help="Remove the files; by default they are only listed.")] = False,
    as_json: JsonOption = False,
) -> None:
    """List the caches on disk with their sizes; with --yes remove them.

    Campaigns' folders are not touched. Running campaigns continue: missing files are built again.
    """
    from rich import box
    from rich.table import Table

    from marsyard.campaigns.errors import CampaignError, unknown_name_message
    from marsyard.sim.cache import UNFINISHED

    for kind in kinds or []:
        if kind not in KINDS:
            raise CampaignError(unknown_name_message("kind", kind, KINDS))
    usages = [cache_usage(kind) for kind in kinds or KINDS]
    freed = 0
    paths = [path for one in usages for path in sorted(one["folder"].rglob("*"), reverse=True)] if yes else []
    for path in paths:
        try:
            if path.is_dir() and not path.is_symlink():
                path.rmdir()
            elif path.suffix != UNFINISHED:  # of another process
                size = path.stat().st_size
                path.unlink()
                freed += size
        except OSError:  # not empty, in use, or gone already
            continue
    if as_json:
        typer.echo(json.dumps({"kept": usages, "removed_bytes": freed}, indent=2, default=str))
        return
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("kind", "files", "size", "limit", "folder", "what it is"):
        right = heading in ("files", "size", "limit")
        table.add_column(heading, justify="right" if right else "left", overflow="fold")
    for one in usages:
        limit = "none" if one["limit_bytes"] is None else size_text(one["limit_bytes"])
        kind, size = one["kind"], size_text(one["bytes"])
        table.add_row(kind, str(one["files"]), size, limit, str(one["folder"]), KINDS[kind])
    console().print(table)
    if yes:
        typer.echo(f"removed {size_text(freed)}")
    else:
        typer.echo("nothing was removed; to remove it: marsyard clean --yes")


def cache_usage(kind: str) -> dict[str, Any]:
    """Folder, number of files and bytes of a kind. Raises CampaignError for a wrong number in MARSYARD_CACHE_GB."""
    from marsyard.campaigns.errors import CampaignError
    from marsyard.sim.cache import cache_directory, limit_bytes

    folder = cache_directory(kind)
    sizes = []
    for path in folder.rglob("*"):
        try:
            if path.is_file() and not path.is_symlink():
                sizes.append(path.stat().st_size)
        except OSError:  # another process has removed it meanwhile
            continue
    size = sum(sizes)
    try:
        limit = limit_bytes(folder, size) if kind == LIMITED else None
    except ValueError as error:
        raise CampaignError(str(error)) from error
    return {"kind": kind, "folder": folder, "files": len(sizes), "bytes": size, "limit_bytes": limit}


@handle_user_errors
def compile_kernels() -> None:
    """Compile the numeric kernels before the first run.

    Each system runs a small case. Compiled code stays on disk until the code changes (`marsyard clean` lists where).
    """
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.execution.worker_process import limit_threads
    from marsyard.scenarios.systems import systems
    from marsyard.sim.kernel_cache import kernels_are_ready, mark_ready

    limit_threads()
    for name, settings in (one for system in systems() for one in system.compiled_by.items()):
        campaign = load_campaign(name, settings)
        scenario = campaign.configuration.scenario
        if kernels_are_ready(scenario):
            typer.echo(f"{scenario}: compiled before")
            continue
        began = time.monotonic()
        campaign.scenario.run(campaign.parameters(0), campaign.streams(0))
        mark_ready(scenario)
        typer.echo(f"{scenario}: compiled, {time.monotonic() - began:.0f} s")
