"""Where compiled kernels are kept: one folder for each state of their sources.

numba keeps a compiled function until its own file changes; it does not see that a function which it calls, in another
file, has changed. A kernel that was compiled against old code would then go on giving the old results. Here every
change of any kernel's source is another folder.
"""

from __future__ import annotations

import hashlib
import os
import sys
from contextlib import suppress
from pathlib import Path

from marsyard.sim.cache import cache_directory
from marsyard.sim.processor import processor_features

#: The folders that hold kernels, side by side in the tree and where they are installed.
_FOLDERS = ("sim", "algorithms", "scenarios")


def use_own_folder() -> None:
    """Points numba, without importing it, at the folder of the kernels as they are, unless the user has chosen one."""
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    digest = hashlib.sha256(sys.version.encode())
    for source in _kernel_sources():
        digest.update(source.read_bytes())
    try:
        folder = cache_directory("kernels") / digest.hexdigest()[:16]
    except OSError:
        # Nowhere to keep them: numba falls back to its own places, or compiles in every process.
        return
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)


def kernels_are_ready(user: str) -> bool:
    """Whether a user of the kernels (a scenario) has run to its end with those that are there, on this processor.

    False where nothing can be kept: then each process compiles them anew.
    """
    mark = _mark(user)
    return mark is not None and mark.exists()


def note_ready(user: str) -> None:
    """Notes that this user's kernels are compiled."""
    mark = _mark(user)
    if mark is not None:
        with suppress(OSError):
            mark.parent.mkdir(parents=True, exist_ok=True)
            mark.touch()


def compiled_functions() -> int:
    """Number of compiled functions that are kept so far; 0 where none can be kept."""
    folder = os.environ.get("NUMBA_CACHE_DIR")
    return 0 if folder is None else sum(1 for _ in Path(folder).rglob("*.nbc"))


def _mark(user: str) -> Path | None:
    # numba keeps one compiled form for each kind of processor, as compiled code runs on its own kind only
    folder = os.environ.get("NUMBA_CACHE_DIR")
    digest = hashlib.sha256(f"{user} {processor_features()}".encode())
    return None if folder is None else Path(folder) / f"{digest.hexdigest()[:16]}.ready"


def _kernel_sources() -> list[Path]:
    root = Path(__file__).parents[1]
    return sorted(path for folder in _FOLDERS for path in (root / folder).rglob("*.py") if _is_kernel(path))


def _is_kernel(path: Path) -> bool:
    return path.name == "kernels.py" or path.parent.name == "kernels"
