"""Tests of the cache folders: size limits and eviction, and the compiled kernels of each version of the sources."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from marsyard.sim import kernel_cache
from marsyard.sim.cache import GIGA, cache_directory, evict_files, limit_bytes, touch
from marsyard.sim.kernel_cache import kernels_are_ready, mark_ready


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Create five files of 100 bytes in a cache of 500 bytes; file 0 is the least recently used."""
    monkeypatch.setenv("MARSYARD_CACHE_GB", f"{500 / GIGA:.12f}")
    for number in range(5):
        path = tmp_path / str(number)
        path.write_bytes(bytes(100))
        os.utime(path, (number, number))
    return tmp_path


def _list_files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_files_are_evicted_in_order_of_last_use_unless_in_use(folder: Path) -> None:
    evict_files(folder, 0)
    assert len(_list_files(folder)) == 5, "below the limit"
    touch(folder / "0")
    evict_files(folder, 150)
    assert _list_files(folder) == {"0", "3", "4"}
    evict_files(folder, 10_000, {folder / "3"})
    assert _list_files(folder) == {"3"}


def test_old_partial_files_are_removed(folder: Path) -> None:
    for name, age_h in (("old.part", 25.0), ("new.part", 23.0)):
        path = folder / name
        path.write_bytes(bytes(1000))
        os.utime(path, (time.time() - 3600.0 * age_h,) * 2)
    evict_files(folder, 0)
    assert _list_files(folder) == {"0", "1", "2", "3", "4", "new.part"}


def test_empty_variables_select_the_default_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, value in (("MARSYARD_CACHE", ""), ("XDG_CACHE_HOME", ""), ("HOME", str(tmp_path / "home"))):
        monkeypatch.setenv(name, value)
    assert cache_directory("terrain") == tmp_path / "home" / ".cache" / "marsyard" / "terrain"


def test_default_limit_is_a_fraction_of_available_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The default is 40 % of the sum of free space and cache size, at most 10 GB."""
    monkeypatch.delenv("MARSYARD_CACHE_GB", raising=False)
    free = 20 * GIGA
    monkeypatch.setattr("marsyard.sim.cache.shutil.disk_usage", lambda _: SimpleNamespace(free=free))
    assert limit_bytes(tmp_path, 0) == 8 * GIGA
    # Space that cache files already use counts as available.
    assert limit_bytes(tmp_path, 3 * GIGA) == 9.2 * GIGA
    free = 900 * GIGA
    assert limit_bytes(tmp_path, 0) == 10 * GIGA


@pytest.mark.parametrize("invalid", ["plenty", "0", "-3", "nan", "inf"])
def test_invalid_limit_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, invalid: str) -> None:
    monkeypatch.setenv("MARSYARD_CACHE_GB", invalid)
    with pytest.raises(ValueError, match=f"MARSYARD_CACHE_GB is '{invalid}'; a number of gigabytes above 0"):
        limit_bytes(tmp_path, 0)


ROOT = Path(__file__).resolve().parents[2]


#: Program that prints the folder of the compiled kernels.
PRINT_FOLDER = "import os, marsyard.sim; print(os.environ['NUMBA_CACHE_DIR'])"


def _run(program: str, cache: Path, sources: Path = ROOT, **environment: str) -> str:
    """Run a program with the packages in `sources`, without the cache folders of this process; return its output."""
    base = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "DRJIT_CACHE_DIR")}
    base |= {"MARSYARD_CACHE": str(cache), "PYTHONPATH": str(sources)} | environment
    command = [sys.executable, "-c", program]
    return subprocess.run(
        command, cwd=sources, env=base, capture_output=True, text=True, check=True, timeout=60
    ).stdout.strip()


def test_compiled_programs_of_images_are_in_the_cache_of_kernels(tmp_path: Path) -> None:
    program = """
import os, marsyard.sim.render
from marsyard.sim.render.device import Float
print(os.environ["DRJIT_CACHE_DIR"], Float(1.0, 2.0) + 1.0)
"""
    folder = tmp_path / "kernels" / "drjit"
    assert _run(program, tmp_path, HOME=str(tmp_path / "home")).split()[0] == str(folder)
    assert list(folder.glob("*.bin"))
    assert not (tmp_path / "home").exists()


def test_changed_kernel_changes_the_cache_folder(tmp_path: Path) -> None:
    sources = tmp_path / "sources"
    shutil.copytree(ROOT / "marsyard", sources / "marsyard", ignore=shutil.ignore_patterns("__pycache__"))
    folders = [_run(PRINT_FOLDER, tmp_path / "cache", sources) for _ in range(2)]
    assert folders[0] == folders[1]
    for kernels in ("sim/terrain/kernels.py", "algorithms/hda/kernels/motion.py"):
        kernel_file = sources / "marsyard" / kernels
        kernel_file.write_text(kernel_file.read_text() + "\n# changed\n")
        folders.append(_run(PRINT_FOLDER, tmp_path / "cache", sources))
    assert len(set(folders)) == 3


@pytest.mark.parametrize(
    "kernel", ["algorithms.hda.kernels.motion:solve", "scenarios.landing.kernels:raise_by_triangles"]
)
def test_kernels_are_cached_in_the_folder_for_any_first_import(kernel: str, tmp_path: Path) -> None:
    module, function = kernel.split(":")
    program = f"from marsyard.{module} import {function}; print({function}._cache.cache_path)"
    assert Path(_run(program, tmp_path)).is_relative_to(tmp_path / "kernels")


def test_cache_folder_set_by_the_user_is_used(tmp_path: Path) -> None:
    assert _run(PRINT_FOLDER, tmp_path, NUMBA_CACHE_DIR="/somewhere") == "/somewhere"


def test_kernels_are_ready_only_for_marked_scenario_and_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Changed kernels have another folder, in which no scenario is marked."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "one"))
    assert not kernels_are_ready("descent")
    mark_ready("descent")
    assert kernels_are_ready("descent")
    assert not kernels_are_ready("landing")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "two"))
    assert not kernels_are_ready("descent")
    # Numba stores compiled code per source folder, although the cache folder depends on the content of the sources
    mark_ready("descent")
    with monkeypatch.context() as patch:
        patch.setattr(kernel_cache, "__file__", str(tmp_path / "marsyard" / "sim" / "kernel_cache.py"))
        assert not kernels_are_ready("descent")
    # without a folder
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    mark_ready("descent")
    assert not kernels_are_ready("descent")


def test_kernels_are_never_ready_without_a_cache_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    mark_ready("descent")
    assert not kernels_are_ready("descent")


def test_kernels_of_another_checkout_are_not_ready(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numba stores compiled code per source folder, although the cache folder depends on the content of the sources."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    mark_ready("descent")
    monkeypatch.setattr(kernel_cache, "__file__", str(tmp_path / "marsyard" / "sim" / "kernel_cache.py"))
    assert not kernels_are_ready("descent")
