"""Safe reading of user files: regular files only; the expanded size of archives is checked before they are read."""

import errno
import os
import stat
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

#: Types of special files, for messages.
_SPECIAL_FILES = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
}
ArrayHeader = tuple[tuple[int, ...], np.dtype[Any]]  #: Shape and type of an array.


@contextmanager
def report_damage(path: str | Path, error: type[Exception], problem: str, allowed: str = "") -> Iterator[None]:
    """Convert every exception of the context, in which a library decodes a file, to `error` with path and problem.

    NumPy, zlib, GDAL, trimesh, Arrow and pandas raise exceptions of many undocumented types for damaged files.
    """
    try:
        yield
    except (error, ImportError):
        raise
    except Exception as fault:
        reason = " ".join(str(fault).split())[:200] or type(fault).__name__
        raise error(f"{path}: {problem} ({reason}){allowed}") from fault


def check_regular(path: str | Path) -> os.stat_result:
    """Return the status of a regular file or of the target of a link.

    Raises OSError if the file is missing, a folder, a named pipe or a device: opening a pipe can block forever, and a
    device can return infinitely many bytes.
    """
    status = Path(path).stat()
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        kind = _SPECIAL_FILES.get(stat.S_IFMT(status.st_mode), "a special file")
        raise OSError(errno.EINVAL, f"is {kind}; a regular file is needed", str(path))
    return status


def open_regular(path: str | Path) -> BinaryIO:
    """Open a regular file for reading. Raises OSError as `check_regular` does."""
    check_regular(path)
    return Path(path).open("rb")


def read_npz_headers(path: str | Path) -> dict[str, ArrayHeader]:
    """Read shape and type of each array of an .npz archive without expanding it; for `report_damage`."""
    check_regular(path)
    headers: dict[str, ArrayHeader] = {}
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            if entry.filename.endswith(".npy"):
                with archive.open(entry) as member:
                    headers[entry.filename.removesuffix(".npy")] = read_npy_header(member)
    return headers


def read_npy_header(file: Any) -> ArrayHeader:
    """Read shape and type from the header of an open .npy file. Raises ValueError if it has no valid header."""
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"version {version} of .npy files is not supported")
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(file)
    return tuple(int(side) for side in shape), dtype


def expanded_bytes(path: str | Path) -> int:
    """Sum the expanded sizes in the directory of a zip archive. Raises OSError or zipfile.BadZipFile."""
    check_regular(path)
    with zipfile.ZipFile(path) as archive:
        return sum(entry.file_size for entry in archive.infolist())
