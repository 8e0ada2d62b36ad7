"""`marsyard clean`: what is kept on disk between runs, with its size; removes it where asked to."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer

from marsyard.cli.campaign import JsonOption, console, says_what_is_wrong, size_text

#: What is kept, and what it costs to be without it.
KINDS = {
    "terrain": "terrains built for campaigns; built again when a case needs one, from seconds to minutes each",
    "kernels": "compiled code; compiled again in the next minute of running",
}

#: The kind whose size is limited, by MARSYARD_CACHE_GB.
LIMITED = "terrain"


@dataclass(frozen=True)
class Kept:
    """What is kept of one kind: its folder, how many files, how many bytes on disk they take and may take."""

    kind: str
    folder: Path
    files: int
    bytes: int
    limit_bytes: int | None = None


@says_what_is_wrong
def clean(
    kinds: Annotated[
        list[str] | None, typer.Argument(metavar="[KIND]...", help="terrain, kernels; by default all of them.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Remove it; without this it is only shown.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show what Marsyard keeps on disk beside campaigns, with sizes; with --yes remove it.

    Campaigns' folders are never touched. Running campaigns go on: what they need is built again.
    """
    from marsyard.campaigns.errors import CampaignError, not_allowed

    for kind in kinds or []:
        if kind not in KINDS:
            raise CampaignError(not_allowed("kind", kind, KINDS))
    found = [kept(kind) for kind in kinds or KINDS]
    freed = sum(_removed(one.folder) for one in found) if yes else 0
    if as_json:
        typer.echo(json.dumps({"kept": [asdict(one) for one in found], "removed_bytes": freed}, indent=2, default=str))
        return
    _print(found)
    if yes:
        typer.echo(f"removed {size_text(freed)}")
    else:
        typer.echo("nothing was removed; to remove it: marsyard clean --yes")


def kept(kind: str) -> Kept:
    """What is kept of a kind. Raises CampaignError where MARSYARD_CACHE_GB is not a number of gigabytes."""
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
    return Kept(kind, folder, len(sizes), size, limit)


def _removed(folder: Path) -> int:
    """Removes all files in a folder; returns their bytes. What another process writes just now stays."""
    from marsyard.sim.cache import UNFINISHED

    freed = 0
    for path in sorted(folder.rglob("*"), reverse=True):
        try:
            if path.is_dir() and not path.is_symlink():
                path.rmdir()
            elif path.suffix != UNFINISHED:
                size = path.stat().st_size
                path.unlink()
                freed += size
        except OSError:  # not empty, in use, or gone already
            continue
    return freed


def _print(found: list[Kept]) -> None:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("kind", "files", "size", "limit", "folder", "what it is"):
        right = heading in ("files", "size", "limit")
        table.add_column(heading, justify="right" if right else "left", overflow="fold")
    for one in found:
        limit = "none" if one.limit_bytes is None else size_text(one.limit_bytes)
        table.add_row(one.kind, str(one.files), size_text(one.bytes), limit, str(one.folder), KINDS[one.kind])
    console().print(table)
