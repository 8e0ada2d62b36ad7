"""Cache folders of compiled code, and markers of scenarios whose code is compiled.

numba has one folder per version of the kernel sources, Dr.Jit one folder.

numba recompiles a function when its file changes, but not when a function that it calls in another file changes. The
cached function would then return outdated results. Therefore a change of any kernel source selects a new folder. Dr.Jit
names its files by a hash of the compiled instructions, so one folder suffices.
"""

import hashlib
import os
import platform
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path

from marsyard.sim.cache import cache_directory

#: The folders that contain kernels, in the source tree and in an installation.
_FOLDERS = ("sim", "algorithms", "scenarios")


@cache
def processor_features() -> str:
    """Return the machine type and a hash of the processor's instruction set extensions."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    extensions = next((line.split(":", 1)[1] for line in lines if line.startswith(("flags", "Features"))), "")
    flags = " ".join(sorted(extensions.split()))
    return f"{platform.machine()}-{hashlib.sha256(flags.encode()).hexdigest()[:12]}"


def set_cache_folders() -> None:
    """Set the cache folders of numba and Dr.Jit, unless they are set; imports neither."""
    with suppress(OSError):  # without a writable folder Dr.Jit uses its default folder
        os.environ.setdefault("DRJIT_CACHE_DIR", str(cache_directory("kernels") / "drjit"))
    _set_numba_folder()


def _set_numba_folder() -> None:
    """Set NUMBA_CACHE_DIR to a folder named by the hash of the kernel sources, unless set."""
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    root, digest = Path(__file__).parents[1], hashlib.sha256(sys.version.encode())
    folders = (Path(path) for folder in _FOLDERS for path, *_ in os.walk(root / folder))
    patterns = ((folder, "*.py" if folder.name == "kernels" else "kernels.py") for folder in folders)
    for source in sorted(path for folder, pattern in patterns for path in folder.glob(pattern)):
        digest.update(source.read_bytes())
    try:
        folder = cache_directory("kernels") / digest.hexdigest()[:16]
    except OSError:
        return  # without a writable folder numba uses its default folder, or compiles in every process
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)


def kernels_are_ready(scenario: str) -> bool:
    """Return whether a scenario has completed a run with the cached kernels on this type of processor."""
    marker = _marker_path(scenario)
    return marker is not None and marker.exists()


def mark_ready(scenario: str) -> None:
    """Create a marker file: all kernels of a scenario are compiled."""
    if (marker := _marker_path(scenario)) is not None:
        with suppress(OSError):
            marker.parent.mkdir(parents=True, exist_ok=True)
            marker.touch()


def _marker_path(scenario: str) -> Path | None:
    # numba stores compiled code per processor type and folder of the sources
    folder = os.environ.get("NUMBA_CACHE_DIR")
    digest = hashlib.sha256(f"{scenario} {processor_features()} {Path(__file__).parents[1]}".encode())
    return None if folder is None else Path(folder) / f"{digest.hexdigest()[:16]}.ready"
