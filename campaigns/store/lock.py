"""Lock of the folder of a new or stored campaign, with a heartbeat for file systems without locks.

The kernel releases its lock when the process ends. File systems of clusters can be mounted without locks, or with locks
that other machines do not see. Therefore, the process that uses a folder also updates the time of the lock file.
Another process takes the folder only if that time does not change for some seconds.
"""

import errno
import fcntl
import os
import platform
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from marsyard.campaigns.errors import StoreError, report_write_errors
from marsyard.campaigns.store.record import RECORD_FILE
from marsyard.campaigns.store.rows import ROWS_FILE, is_empty_store
from marsyard.campaigns.store.temporary_files import machine_id, process_exists, remove_abandoned

#: Lock file of the process that uses the folder.
_LOCK_FILE = "campaign.lock"
#: Files of a campaign; a folder that contains any of them is never used for another campaign.
_CAMPAIGN_FILES = (RECORD_FILE, "cases.parquet", ROWS_FILE, "report.html", "report.json", "cases")
#: Time between two heartbeats, and time without one after which a process is considered dead, s.
_BEAT_S, _SILENCE_S = 2.0, 15.0
#: Errors of `flock` if another process has the lock; other errors mean that the file system has no locks.
_LOCKED = (errno.EWOULDBLOCK, errno.EACCES)


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
            file.write(f"process {os.getpid()} on {platform.node()} ({machine_id()})\n")
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


@contextmanager
def lock_new_folder(directory: Path) -> Iterator[None]:
    """Create and lock the folder of a new campaign.

    The folder of a run that was killed before its first record can be reused. Raises StoreError if the folder contains
    a campaign, another process uses it, or it is not writable.
    """
    _claim_folder(directory)
    with folder_lock(directory):
        # again, because another process may have started a campaign in the folder before the lock
        _claim_folder(directory)
        yield


def _claim_folder(directory: Path) -> None:
    """Create the folder of a new campaign. Raises StoreError if it contains a campaign or is not writable."""
    with report_write_errors(directory):
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise StoreError(f"{directory} is not a folder; choose another folder with --out") from error
        campaign_files = [name for name in _CAMPAIGN_FILES if (directory / name).exists()]
        if campaign_files and (campaign_files != [ROWS_FILE] or not is_empty_store(directory / ROWS_FILE)):
            raise StoreError(f"{directory} contains a campaign ({campaign_files[0]}); choose another folder with --out")


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
    return match is not None and match[2] == machine_id() and not process_exists(int(match[1]))


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


def _remove_abandoned(directory: Path) -> None:
    """Remove temporary files and folders of dead processes of this machine from a campaign's folder and its cases."""
    remove_abandoned((*directory.glob("*.partial"), *directory.glob("cases/*/*.partial")))
