"""Disk cache: its folders, size limit and eviction."""

import contextlib
import os
import shutil
import time
from collections.abc import Collection
from pathlib import Path

#: Default size limit if ``MARSYARD_CACHE_GB`` is not set: a fraction of the free space, at most `LIMIT_GB` gigabytes.
FREE_FRACTION, LIMIT_GB = 0.4, 10.0
GIGA = 10**9
#: Suffix of files that are being written, and the age after which such a file belongs to an interrupted process.
UNFINISHED, MAX_UNFINISHED_AGE_S = ".part", 86400.0


def cache_directory(kind: str) -> Path:
    """Create and return the cache folder `kind`, a subfolder of ``MARSYARD_CACHE`` or of the user's cache folder."""
    default = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "marsyard"
    directory = Path(os.environ.get("MARSYARD_CACHE") or default) / kind
    directory.mkdir(parents=True, exist_ok=True)
    return directory


def limit_bytes(folder: Path, stored_bytes: int) -> int:
    """Return the size limit of a cache folder whose files have the total size `stored_bytes`.

    ``MARSYARD_CACHE_GB`` if it is set; otherwise 40 % of the space that is free without the cached files, at most
    10 GB. Raises ValueError if the variable is not a positive number.
    """
    text = os.environ.get("MARSYARD_CACHE_GB")
    if not text:
        return int(min(FREE_FRACTION * (shutil.disk_usage(folder).free + stored_bytes), LIMIT_GB * GIGA))
    try:
        gigabytes = float(text)
    except ValueError:
        gigabytes = 0.0
    if not 0.0 < gigabytes < float("inf"):
        raise ValueError(f"MARSYARD_CACHE_GB is '{text}'; a number of gigabytes above 0 is needed")
    return int(gigabytes * GIGA)


def cached_bytes(folder: Path) -> int:
    """Return the total size of the finished files in a folder."""
    total = 0
    for path in (path for path in folder.iterdir() if path.suffix != UNFINISHED):
        with contextlib.suppress(FileNotFoundError):
            total += path.stat().st_size
    return total


def evict_files(folder: Path, new_file_bytes: int, in_use: Collection[Path] = ()) -> None:
    """Delete the least recently used files of a folder until a file of `new_file_bytes` fits under the limit.

    Files `in_use` are never deleted. Unfinished files are deleted once they are a day old. Other processes may delete
    files at the same time, or still read a deleted file. Raises ValueError under the same condition as `limit_bytes`.
    """
    entries, stored_bytes = [], 0
    for path in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):
            status = path.stat()
            if path.suffix != UNFINISHED:
                entries.append((status.st_atime, path, status.st_size))
                stored_bytes += status.st_size
            elif time.time() - status.st_mtime > MAX_UNFINISHED_AGE_S:
                path.unlink()
    limit = limit_bytes(folder, stored_bytes)
    for _, path, size in sorted(entries):
        if stored_bytes + new_file_bytes <= limit:
            break
        if path not in in_use:
            path.unlink(missing_ok=True)
            stored_bytes -= size


def touch(path: Path) -> None:
    """Set a file's access time to now and leave its modification time unchanged; does nothing if not permitted."""
    with contextlib.suppress(OSError):
        os.utime(path, ns=(time.time_ns(), path.stat().st_mtime_ns))
