"""Arrays in the disk cache: memory-mapped files, written atomically, with checksums."""

import contextlib
import os
import tempfile
import warnings
import zlib
from pathlib import Path

import numpy as np

from marsyard.sim.cache import UNFINISHED

_CHECKSUM_BYTES = 4  #: Bytes of the checksum after an array.
#: Files that this process has verified, with their state at that time: device, inode, modification time and size.
_VERIFIED: dict[Path, tuple[int, int, int, int]] = {}


class CacheWarning(UserWarning):
    """A cached file is damaged and will be rebuilt, or cannot be written. Results do not depend on it."""


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
