"""Temporary files and folders that replace their targets when they are complete, and removal of abandoned ones."""

import errno
import glob
import hashlib
import os
import platform
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from marsyard.campaigns.errors import StoreError, report_write_errors

#: End of the names of temporary files, with machine and process.
_PARTIAL = re.compile(r"\.([0-9a-f]{8})-(\d+)\.partial$")


def machine_id() -> str:
    """Return a hash of this machine and its numbering of processes, which differs between containers."""
    names = [platform.node()]
    with suppress(OSError):
        names.append(str(Path("/proc/self/ns/pid").readlink()))
    with suppress(OSError):
        names.append(Path("/proc/sys/kernel/random/boot_id").read_text())
    return hashlib.sha256("\n".join(names).encode()).hexdigest()[:8]


def process_exists(process: int) -> bool:
    """Whether a process of this machine has not ended."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def partial_suffix() -> str:
    """Return the end of the names of this process's temporary files."""
    return f".{machine_id()}-{os.getpid()}.partial"


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Yield the name of a temporary file that replaces `path` at the end; after an exception it is removed."""
    partial = path.with_name(path.name + partial_suffix())
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_atomic(path: Path, text: str) -> None:
    """Write a text file atomically: write a temporary file, then rename it."""
    with replace_file(path) as partial_path:
        # JSON can contain lone surrogates, which cannot be encoded as UTF-8
        partial_path.write_text(text, encoding="utf-8", errors="replace")


def remove_abandoned(paths: Iterable[Path]) -> None:
    """Remove those temporary files and folders (`partial_suffix`) whose processes, on this machine, have ended."""
    for path in paths:
        match = _PARTIAL.search(path.name)
        if match is not None and match[1] == machine_id() and not process_exists(int(match[2])):
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


@contextmanager
def create_folder(directory: Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes the folder `directory` at the end; after an exception it is removed.

    Raises StoreError if `directory` exists and is not empty, or cannot be written.
    """
    directory = directory.resolve()
    temporary = directory.with_name(f".{directory.name}{partial_suffix()}")
    with report_write_errors(directory):
        directory.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned(directory.parent.glob(f".{glob.escape(directory.name)}.*.partial"))
        temporary.mkdir()
    try:
        yield temporary
        try:
            temporary.rename(directory)  # succeeds if `directory` is missing or empty
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                raise StoreError(f"{directory} cannot be written: {error.strerror or error}") from error
            raise StoreError(f"{directory} is not an empty folder; choose another folder with --out") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
