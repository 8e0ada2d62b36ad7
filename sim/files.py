"""Safe reading of a user's files: regular files only, and archives by what they expand to, checked before they do."""

from __future__ import annotations

import errno
import os
import stat
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

#: Kinds of files that are not regular, for messages.
_KINDS = (
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a character device"),
    (stat.S_ISBLK, "a block device"),
)
#: What numpy and zipfile raise for damaged archives and headers; NotImplementedError is an unknown compression.
ARCHIVE_ERRORS = (OSError, ValueError, EOFError, TypeError, KeyError, NotImplementedError, zipfile.BadZipFile)

#: Shape and type of an array, by its header.
ArrayHeader = tuple[tuple[int, ...], np.dtype[Any]]


def check_regular(path: str | Path) -> os.stat_result:
    """Return the status of a regular file, or of what a link leads to.

    Raises
    ------
    OSError
        Where the file is missing, a folder, a named pipe or a device. Opening a pipe may wait for ever, and a device
        may have no end.
    """
    about = Path(path).stat()
    if stat.S_ISDIR(about.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(about.st_mode):
        kind = next((name for matches, name in _KINDS if matches(about.st_mode)), "a special file")
        raise OSError(errno.EINVAL, f"is {kind}; a regular file is needed", str(path))
    return about


def open_regular(path: str | Path) -> BinaryIO:
    """Open a regular file for reading. Raises OSError, as `check_regular`."""
    check_regular(path)
    return Path(path).open("rb")


def npz_headers(path: str | Path) -> dict[str, ArrayHeader]:
    """Shape and type of each array of an .npz archive, without expanding any.

    Raises
    ------
    OSError, ValueError, EOFError, zipfile.BadZipFile
        Where the file is no archive of arrays (`ARCHIVE_ERRORS`).
    """
    check_regular(path)
    headers: dict[str, ArrayHeader] = {}
    with zipfile.ZipFile(path) as archive:
        for about in archive.infolist():
            if about.filename.endswith(".npy"):
                with archive.open(about) as member:
                    headers[about.filename.removesuffix(".npy")] = npy_header(member)
    return headers


def npy_header(file: Any) -> ArrayHeader:
    """Shape and type that the header of an .npy file states. Raises ValueError where it is none."""
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"version {version} of .npy files is not read")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    return tuple(int(side) for side in shape), dtype


def expanded_bytes(path: str | Path) -> int:
    """Bytes that the members of a zip archive expand to, by its directory, beyond which zipfile reads nothing.

    Raises OSError or zipfile.BadZipFile where the file is no zip archive.
    """
    check_regular(path)
    with zipfile.ZipFile(path) as archive:
        return sum(about.file_size for about in archive.infolist())
