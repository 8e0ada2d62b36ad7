"""Where compiled kernels are kept: one folder for each state of their sources.

numba keeps a compiled function until its own file changes; it does not see that a function which it calls, in another
file, has changed. A kernel that was compiled against old code would then go on giving the old results. Here every
change of any kernel's source is another folder.
"""

from __future__ import annotations

import hashlib
import os
import sys
from pathlib import Path

from sim.cache import cache_directory

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


def _kernel_sources() -> list[Path]:
    root = Path(__file__).parents[1]
    return sorted(path for folder in _FOLDERS for path in (root / folder).rglob("*.py") if _is_kernel(path))


def _is_kernel(path: Path) -> bool:
    return path.name == "kernels.py" or path.parent.name == "kernels"
