"""Disk cache of arrays: location, size limit, eviction, atomic writing and checksums."""

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

#: Default size limit if ``MARSYARD_CACHE_GB`` is not set: a fraction of the free space, at most `LIMIT_GB` gigabytes.
FREE_FRACTION, LIMIT_GB = 0.4, 10.0
GIGA = 10**9
#: Suffix of files that are being written, and the age after which such a file belongs to an interrupted process.
UNFINISHED, MAX_UNFINISHED_AGE_S = ".part", 86400.0
_CHECKSUM_BYTES = 4  #: Bytes of the checksum after an array.
#: Files that this process has verified, with their state at that time: device, inode, modification time and size.
_VERIFIED: dict[Path, tuple[int, int, int, int]] = {}


class CacheWarning(UserWarning):
    """A cached file is damaged and will be rebuilt, or cannot be written. Results do not depend on it."""


def cache_directory(kind: str) -> Path:
    """Create and return the cache folder `kind`, a subfolder of ``MARSYARD_CACHE`` or of the user's cache folder."""
    default = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "marsyard"
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


def save_array(path: Path, array: np.ndarray) -> np.ndarray:
    """Write an array with its checksum atomically; return it memory-mapped and read-only.

    File and folder are synced, so that after a power loss the file is either complete or missing. The file is mapped
    before it is renamed, because another process may delete it at once. Raises OSError if it cannot be written.
    """
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=UNFINISHED, delete=False) as part:
        try:
            np.save(part.file, array)
            part.write(_compute_checksum(array))
            part.flush()
            os.fsync(part.fileno())
            mapped_array: np.ndarray = np.load(part.name, mmap_mode="r").view(np.ndarray)
            state = _read_file_state(Path(part.name))
            Path(part.name).replace(path)
        except BaseException:
            Path(part.name).unlink(missing_ok=True)
            raise
    with contextlib.suppress(OSError), contextlib.ExitStack() as stack:  # not every file system can sync a folder
        descriptor = os.open(path.parent, os.O_RDONLY)
        stack.callback(os.close, descriptor)
        os.fsync(descriptor)
    _VERIFIED[path] = state
    return mapped_array


def load_array(path: Path) -> np.ndarray | None:
    """Map an array written by `save_array`, read-only; return None if the file is missing or damaged.

    The first load of a file in a process verifies its checksum (about 0.3 s per GB if the file is in memory). Later
    loads compare only the file's state (`_VERIFIED`). Issues a `CacheWarning` for a damaged file.
    """
    try:
        state = _read_file_state(path)
        mapped_array: np.ndarray = np.load(path, mmap_mode="r").view(np.ndarray)
        if _VERIFIED.get(path) != state:
            with path.open("rb") as file:
                file.seek(-_CHECKSUM_BYTES, os.SEEK_END)
                stored_checksum = file.read()
            if stored_checksum != _compute_checksum(mapped_array):
                raise ValueError("its checksum does not match its content")
    except FileNotFoundError:
        return None
    except (OSError, ValueError, EOFError) as error:
        warnings.warn(f"the cached file {path} is damaged and will be rebuilt: {error}", CacheWarning, stacklevel=2)
        return None
    _VERIFIED[path] = state
    return mapped_array


def _read_file_state(path: Path) -> tuple[int, int, int, int]:
    """Return device, inode, modification time (ns) and size of a file."""
    status = path.stat()
    return status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size


def _compute_checksum(array: np.ndarray) -> bytes:
    """Compute the CRC-32 of an array's elements."""
    return zlib.crc32(np.ascontiguousarray(array).data).to_bytes(_CHECKSUM_BYTES, "little")
