"""What all tests share. Everything above the fixtures happens before any of Marsyard's packages is imported."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

import hypothesis
import jaxtyping
import pytest

ROOT = Path(__file__).resolve().parents[1]
SHARED_DATA = ROOT.parent / "shared" / "data"


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


# One GL backend a process, chosen before PyOpenGL's first import: OSMesa if MARSYARD_GL is silent and it is there.
_BACKEND = os.environ.setdefault("MARSYARD_GL", "osmesa" if _loads("libOSMesa.so.8") else "egl")
os.environ["PYOPENGL_PLATFORM"] = _BACKEND

# One thread a process: pytest-xdist has the cores. Before NumPy is imported, or its BLAS has counted them already.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_variable] = "1"
os.environ["MPLBACKEND"] = "Agg"
# Programs that tests start, and their workers, import the tests' modules by name.
os.environ["PYTHONPATH"] = os.pathsep.join([*filter(None, [os.environ.get("PYTHONPATH")]), str(ROOT)])
# Terrains that tests build outlive the run, but stay out of the user's own cache; compiled kernels are shared with it.
if "MARSYARD_CACHE" not in os.environ:
    _CACHE = ROOT / "build" / "test-cache"
    _KERNELS = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "marsyard" / "kernels"
    os.environ["MARSYARD_CACHE"] = str(_CACHE)
    if _KERNELS.is_dir() and not (_CACHE / "kernels").exists():
        _CACHE.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            (_CACHE / "kernels").symlink_to(_KERNELS)

hypothesis.settings.register_profile("marsyard", deadline=None, derandomize="CI" in os.environ)
hypothesis.settings.load_profile("marsyard")

#: Packages whose signatures (array shapes, units' types) are checked at run time while the tests run.
CHECKED_PACKAGES = [
    "marsyard.sim.camera",
    "marsyard.sim.dynamics",
    "marsyard.sim.frames",
    "marsyard.sim.measurements",
    "marsyard.algorithms",
    "marsyard.reports",
]


class _KernelsAreLeftAlone(MetaPathFinder):
    """Finds `kernels` (modules, packages) past the checking hook: numba cannot compile a wrapped function."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if "kernels" in fullname.split("."):
            return PathFinder.find_spec(fullname, path, target)
        return None


_too_early = sorted(set(CHECKED_PACKAGES) & set(sys.modules))
if _too_early:
    raise RuntimeError(f"imported before the run-time checks of shapes were switched on: {', '.join(_too_early)}")
jaxtyping.install_import_hook(CHECKED_PACKAGES, "beartype.beartype")
sys.meta_path.insert(0, _KernelsAreLeftAlone())


def pytest_report_header() -> list[str]:
    """Says what the outcome depends on beside the sources."""
    data = SHARED_DATA if SHARED_DATA.is_dir() else "absent: the tests that need it are skipped"
    return [f"GL backend: {_BACKEND}", f"shared data: {data}"]


@pytest.fixture(autouse=True, scope="session")
def _opencv_single_threaded() -> None:
    import cv2

    cv2.setNumThreads(1)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real camera labels and terrain beside the checkout; the test is skipped where there is none."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"needs the real data in {SHARED_DATA}, which is not there")
    return SHARED_DATA
