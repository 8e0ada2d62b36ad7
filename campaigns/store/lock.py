"""Lock of a campaign's folder, with a heartbeat for file systems without locks, and abandoned temporary files.

The kernel releases its lock when the process ends. File systems of clusters can be mounted without locks, or with locks
that other machines do not see. Therefore, the process that uses a folder also updates the time of the lock file.
Another process takes the folder only if that time does not change for some seconds.
"""

from __future__ import annotations

import errno
import fcntl
import glob
import hashlib
import os
import platform
import re
import shutil
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from marsyard.campaigns.errors import StoreError, report_write_errors

#: Lock file of the process that uses the folder.
_LOCK_FILE = "campaign.lock"
#: Time between two heartbeats, and time without one after which a process is considered dead, s.
_BEAT_S, _SILENCE_S = 2.0, 15.0
#: Errors of `flock` if another process has the lock; other errors mean that the file system has no locks.
_LOCKED = (errno.EWOULDBLOCK, errno.EACCES)
#: End of the names of temporary files, with machine and process.
_PARTIAL = re.compile(r"\.([0-9a-f]{8})-(\d+)\.partial$")


@contextmanager
def folder_lock(directory: Path) -> Iterator[None]:
    """Lock a campaign's folder, and remove temporary files of dead processes.

    Raises StoreError if another process uses the folder, or the folder is not writable.
    """
    path = directory / _LOCK_FILE
    with report_write_errors(directory):
        file = path.open("a+", encoding="utf-8")
    with file:
        holder = _read_holder(file)
        if not _lock(file) or (holder and not _is_dead(holder) and _has_heartbeat(path)):
            raise StoreError(
                f"{directory} is in use: {holder or 'another process'} uses it; wait until it ends, or stop it"
            )
        # a full disk is ignored, since the text is only used by other processes
        with suppress(OSError):
            file.truncate(0)
            file.write(f"process {os.getpid()} on {platform.node()} ({_machine()})\n")
            file.flush()
        _remove_abandoned(directory)
        ended = threading.Event()
        heart = threading.Thread(target=_beat, args=(path, ended), daemon=True)
        heart.start()
        try:
            yield
        finally:
            ended.set()
            heart.join()
            with suppress(OSError):
                file.truncate(0)


def is_locked(directory: Path) -> bool:
    """Whether a process uses a campaign's folder."""
    path = directory / _LOCK_FILE
    try:
        with path.open("r", encoding="utf-8") as file:
            holder = _read_holder(file)
            if not _lock(file, fcntl.LOCK_SH):
                return True
            return bool(holder) and not _is_dead(holder) and _has_heartbeat(path)
    except FileNotFoundError:
        return False
    except OSError:
        return True


def _lock(file: TextIO, kind: int = fcntl.LOCK_EX) -> bool:
    """Lock a file; False if another process has locked it. On a file system without locks, the heartbeat decides."""
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in _LOCKED
    return True


def _read_holder(file: TextIO) -> str:
    file.seek(0)
    return file.read().strip()


def _is_dead(holder: str) -> bool:
    """Whether a holder was a process of this machine that has ended."""
    match = re.fullmatch(r"process (\d+) on .* \(([0-9a-f]+)\)", holder)
    return match is not None and match[2] == _machine() and not _exists(int(match[1]))


def _has_heartbeat(path: Path) -> bool:
    """Watch a lock file: whether its time changes. Clocks of machines differ, so that the time itself says nothing."""
    first, end_s = _read_time(path), time.monotonic() + _SILENCE_S
    while time.monotonic() < end_s:
        time.sleep(_BEAT_S / 4.0)
        if _read_time(path) != first:
            return True
    return False


def _read_time(path: Path) -> int:
    """Return the modification time of a file, ns; a network file system asks its server when a file is opened."""
    with path.open("rb") as file:
        return os.fstat(file.fileno()).st_mtime_ns


def _beat(path: Path, ended: threading.Event) -> None:
    while not ended.wait(_BEAT_S):
        with suppress(OSError):
            os.utime(path)


def _machine() -> str:
    """Return a hash of this machine and its numbering of processes, which differs between containers."""
    names = [platform.node()]
    with suppress(OSError):
        names.append(str(Path("/proc/self/ns/pid").readlink()))
    with suppress(OSError):
        names.append(Path("/proc/sys/kernel/random/boot_id").read_text())
    return hashlib.sha256("\n".join(names).encode()).hexdigest()[:8]


def _exists(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def partial_suffix() -> str:
    """Return the end of the names of this process's temporary files."""
    return f".{_machine()}-{os.getpid()}.partial"


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


def _remove_abandoned(directory: Path) -> None:
    """Remove temporary files and folders of dead processes of this machine from a campaign's folder and its cases."""
    remove_abandoned((*directory.glob("*.partial"), *directory.glob("cases/*/*.partial")))


def remove_abandoned(paths: Iterable[Path]) -> None:
    """Remove those temporary files and folders (`partial_suffix`) whose processes, on this machine, have ended."""
    for path in paths:
        match = _PARTIAL.search(path.name)
        if match is not None and match[1] == _machine() and not _exists(int(match[2])):
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
