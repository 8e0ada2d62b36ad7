"""One runner at a time in a campaign's folder."""

from __future__ import annotations

import fcntl
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from marsyard.campaigns.errors import StoreError, writing

#: Held for as long as a runner works in the folder; the file stays, the lock goes with the process however it ends.
LOCK_FILE = "campaign.lock"


@contextmanager
def folder_lock(directory: Path) -> Iterator[None]:
    """Holds a campaign's folder.

    Raises
    ------
    StoreError
        Where another runner holds it, or the folder cannot be written.
    """
    path = directory / LOCK_FILE
    with writing(directory):
        file = path.open("a+", encoding="utf-8")
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.seek(0)
            holder = file.read().strip() or "another process"
            raise StoreError(f"{directory} is in use: {holder} works in it; wait for it, or end it") from error
        # only for the message to others: a full disk, of which the store will say more, is no reason to stop here
        with suppress(OSError):
            file.truncate(0)
            file.write(f"process {os.getpid()} on {platform.node()}\n")
            file.flush()
        yield


def is_locked(directory: Path) -> bool:
    """Whether a runner works in a folder."""
    try:
        with (directory / LOCK_FILE).open("r", encoding="utf-8") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False
