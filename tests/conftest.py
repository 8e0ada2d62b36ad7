"""Options and fixtures of all tests. The statements at module level run before any import of Marsyard's packages."""

import contextlib
import ctypes
import functools
import importlib.metadata
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


def _can_load(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


# One OpenGL backend per process, selected before the first import of PyOpenGL. Default: OSMesa if it is installed.
_BACKEND = os.environ.setdefault("MARSYARD_GL", "osmesa" if _can_load("libOSMesa.so.8") else "egl")
os.environ["PYOPENGL_PLATFORM"] = _BACKEND

# One thread per process, because pytest-xdist uses the cores. Set before the import of NumPy, whose BLAS counts cores.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_variable] = "1"
os.environ["MPLBACKEND"] = "Agg"
# The installed distributions are constant during the tests; listing them takes half a second, twice per campaign.
importlib.metadata.packages_distributions = functools.cache(importlib.metadata.packages_distributions)
# Programs started by tests, and their workers, import test modules by name.
os.environ["PYTHONPATH"] = os.pathsep.join([*filter(None, [os.environ.get("PYTHONPATH")]), str(ROOT)])
# Terrains of tests have a separate persistent cache; compiled kernels are shared with the user's cache.
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

#: Packages whose signatures (array shapes and types) are checked at run time by the tests.
CHECKED_PACKAGES = [
    "marsyard.sim.camera",
    "marsyard.sim.dynamics",
    "marsyard.sim.frames",
    "marsyard.sim.measurements",
    "marsyard.algorithms",
    "marsyard.reports",
]


class _SkipKernels(MetaPathFinder):
    """Import `kernels` modules and packages without the checking hook: numba cannot compile wrapped functions."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if "kernels" in fullname.split("."):
            return PathFinder.find_spec(fullname, path, target)
        return None


_early_imports = sorted(set(CHECKED_PACKAGES) & set(sys.modules))
if _early_imports:
    raise RuntimeError(f"imported before the run-time checks of shapes were enabled: {', '.join(_early_imports)}")
jaxtyping.install_import_hook(CHECKED_PACKAGES, "beartype.beartype")
sys.meta_path.insert(0, _SkipKernels())


def pytest_report_header() -> list[str]:
    """Report the OpenGL backend and the shared data, on which the results depend."""
    data = SHARED_DATA if SHARED_DATA.is_dir() else "missing: tests that need it are skipped"
    return [f"GL backend: {_BACKEND}", f"shared data: {data}"]


@pytest.fixture(autouse=True, scope="session")
def _opencv_single_threaded() -> None:
    import cv2

    cv2.setNumThreads(1)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real camera labels and terrain next to the repository; skip the test without it."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"needs the real data in {SHARED_DATA}, which does not exist")
    return SHARED_DATA


@pytest.fixture
def inline_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the cases of campaigns in the process of the test."""
    from tests.inline_workers import use_inline_workers

    use_inline_workers(monkeypatch)
