"""Where things built once are kept on disk, and how much room they may take."""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Collection
from pathlib import Path

#: Room that cached terrains may take where ``MARSYARD_CACHE_GB`` does not say: a share of what the disk could give, and
#: a bound on it. Gigabytes are of 10**9 bytes.
FREE_SHARE, LIMIT_GB = 0.4, 30.0
GIGA = 10**9
#: Ending of files that are being written, and the age from which one is what an interrupted process left behind.
UNFINISHED, ABANDONED_S = ".part", 86400.0


def cache_directory(kind: str) -> Path:
    """The folder for cached things of this kind: under ``MARSYARD_CACHE``, else the user's cache folder. Created."""
    configured = os.environ.get("MARSYARD_CACHE")
    root = (
        Path(configured) if configured else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "marsyard"
    )
    directory = root / kind
    directory.mkdir(parents=True, exist_ok=True)
    return directory


def limit_bytes(folder: Path, kept_bytes: int) -> int:
    """Most that the files in a folder may take together, where they take `kept_bytes` now.

    ``MARSYARD_CACHE_GB`` where it is set, else 40 % of what would be free without them, at most 30 GB. Raises
    ValueError where the variable is not a positive number.
    """
    configured = os.environ.get("MARSYARD_CACHE_GB")
    if not configured:
        return int(min(FREE_SHARE * (shutil.disk_usage(folder).free + kept_bytes), LIMIT_GB * GIGA))
    try:
        gigabytes = float(configured)
    except ValueError:
        gigabytes = 0.0
    if not 0.0 < gigabytes < float("inf"):
        raise ValueError(f"MARSYARD_CACHE_GB is '{configured}'; a number of gigabytes above 0 is needed")
    return int(gigabytes * GIGA)


def make_room(folder: Path, wanted_bytes: int, in_use: Collection[Path] = ()) -> None:
    """Removes the files of a folder that were used least recently, until one of `wanted_bytes` fits under the limit.

    Files `in_use` stay, whatever the limit. So do those being written, but for what an interrupted process left a day
    ago. Other processes may remove files at the same time, and may hold a removed one open: it goes when they let go.
    Raises ValueError as `limit_bytes` does.
    """
    kept, kept_bytes = [], 0
    for path in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):
            status = path.stat()
            if path.suffix != UNFINISHED:
                kept.append((status.st_mtime, path, status.st_size))
                kept_bytes += status.st_size
            elif time.time() - status.st_mtime > ABANDONED_S:
                path.unlink()
    limit = limit_bytes(folder, kept_bytes)
    for _, path, size in sorted(kept):
        if kept_bytes + wanted_bytes <= limit:
            break
        if path not in in_use:
            path.unlink(missing_ok=True)
            kept_bytes -= size


def touch(path: Path) -> None:
    """Marks a file as used now; in a folder that cannot be written to nothing is ever removed either."""
    with contextlib.suppress(OSError):
        os.utime(path)
