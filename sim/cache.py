"""Where things built once are kept on disk, how much room they may take, and how they are written and verified."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import time
import warnings
import zlib
from collections.abc import Collection
from pathlib import Path

import numpy as np

#: Room that cached terrains may take where ``MARSYARD_CACHE_GB`` does not say: a share of what the disk could give, and
#: a bound on it. Gigabytes are of 10**9 bytes.
FREE_SHARE, LIMIT_GB = 0.4, 10.0
GIGA = 10**9
#: Ending of files that are being written, and the age from which one is what an interrupted process left behind.
UNFINISHED, ABANDONED_S = ".part", 86400.0


#: Bytes of the checksum behind an array.
_CHECKSUM_BYTES = 4
#: Files that this process has verified, and their state at that time: device, inode, time of change and size.
_VERIFIED: dict[Path, tuple[int, int, int, int]] = {}


class CacheWarning(UserWarning):
    """A cached file is damaged and built again, or cannot be written; results do not depend on it."""


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

    ``MARSYARD_CACHE_GB`` where it is set, else 40 % of what would be free without them, at most 10 GB. Raises
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


def kept_bytes(folder: Path) -> int:
    """Bytes that the files in a folder take together, those being written left out."""
    total = 0
    for path in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):
            total += 0 if path.suffix == UNFINISHED else path.stat().st_size
    return total


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
                kept.append((status.st_atime, path, status.st_size))
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
    """Marks a file as used now; in a folder that cannot be written to nothing is ever removed either.

    Only the time of access changes: the time of change says whether the file is the one that was verified.
    """
    with contextlib.suppress(OSError):
        os.utime(path, ns=(time.time_ns(), path.stat().st_mtime_ns))


def save_array(path: Path, array: np.ndarray) -> np.ndarray:
    """Write an array with its checksum, whole or not at all, and return it memory-mapped and read-only.

    File and folder are synced, so that a loss of power leaves the whole file or none. The file is mapped before it gets
    its name: another process may remove it at once. Raises OSError where it cannot be written.
    """
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=UNFINISHED, delete=False) as part:
        try:
            np.save(part.file, array)
            part.write(_checksum(array))
            part.flush()
            os.fsync(part.fileno())
            mapped: np.ndarray = np.load(part.name, mmap_mode="r").view(np.ndarray)
            state = _state(Path(part.name))
            Path(part.name).replace(path)
        except BaseException:
            Path(part.name).unlink(missing_ok=True)
            raise
    _sync_folder(path.parent)
    _VERIFIED[path] = state
    return mapped


def load_array(path: Path) -> np.ndarray | None:
    """Map an array that `save_array` wrote, read-only; None where there is none, or where it is damaged.

    The first use of a file by a process verifies its checksum (about 0.3 s per GB of cached pages), later uses only
    compare the file's state. Warns with `CacheWarning` of a damaged file.
    """
    try:
        state = _state(path)
        mapped: np.ndarray = np.load(path, mmap_mode="r").view(np.ndarray)
        if _VERIFIED.get(path) != state and _stored_checksum(path) != _checksum(mapped):
            raise ValueError("its checksum does not match its content")
    except FileNotFoundError:
        return None
    except (OSError, ValueError, EOFError) as error:
        warnings.warn(f"the cached file {path} is damaged and built again: {error}", CacheWarning, stacklevel=2)
        return None
    _VERIFIED[path] = state
    return mapped


def _state(path: Path) -> tuple[int, int, int, int]:
    """What changes when a file is written to or replaced."""
    status = path.stat()
    return status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size


def _checksum(array: np.ndarray) -> bytes:
    return zlib.crc32(np.ascontiguousarray(array).data).to_bytes(_CHECKSUM_BYTES, "little")


def _stored_checksum(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(-_CHECKSUM_BYTES, os.SEEK_END)
        return file.read()


def _sync_folder(folder: Path) -> None:
    """Syncs the names in a folder; not every file system can."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
