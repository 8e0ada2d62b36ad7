"""Tests of the disk cache of compiled (Numba) kernels: its folder, and the marks of scenarios that are compiled."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from marsyard.sim import kernel_cache
from marsyard.sim.kernel_cache import kernels_are_ready, mark_ready

ROOT = Path(__file__).resolve().parents[2]


def _find_cache_folder(sources: Path, cache: Path, **environment: str) -> str:
    """Return the folder that a new process selects for the kernels in `sources`."""
    base_environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    result = subprocess.run(
        [sys.executable, "-c", "import os, marsyard.sim; print(os.environ['NUMBA_CACHE_DIR'])"],
        cwd=sources,
        env=base_environment | {"MARSYARD_CACHE": str(cache), "PYTHONPATH": str(sources)} | environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    return result.stdout.strip()


@pytest.mark.parametrize("kernels", ["sim/terrain/kernels.py", "algorithms/hda/kernels/motion.py"])
def test_changed_kernel_changes_the_cache_folder(kernels: str, tmp_path: Path) -> None:
    sources = tmp_path / "sources"
    shutil.copytree(ROOT / "marsyard", sources / "marsyard", ignore=shutil.ignore_patterns("__pycache__"))
    original_folder = _find_cache_folder(sources, tmp_path / "cache")
    assert _find_cache_folder(sources, tmp_path / "cache") == original_folder
    kernel_file = sources / "marsyard" / kernels
    kernel_file.write_text(kernel_file.read_text() + "\n# changed\n")
    assert _find_cache_folder(sources, tmp_path / "cache") != original_folder


def test_cache_folder_set_by_the_user_is_used(tmp_path: Path) -> None:
    assert _find_cache_folder(ROOT, tmp_path, NUMBA_CACHE_DIR="/somewhere") == "/somewhere"


def test_kernels_are_ready_only_for_marked_scenario_and_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Changed kernels have another folder, in which no scenario is marked."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "one"))
    assert not kernels_are_ready("descent")
    mark_ready("descent")
    assert kernels_are_ready("descent")
    assert not kernels_are_ready("landing")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "two"))
    assert not kernels_are_ready("descent")


def test_kernels_of_another_checkout_are_not_ready(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numba stores compiled code per source folder, although the cache folder depends on the content of the sources."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    mark_ready("descent")
    monkeypatch.setattr(kernel_cache, "__file__", str(tmp_path / "marsyard" / "sim" / "kernel_cache.py"))
    assert not kernels_are_ready("descent")


def test_kernels_are_never_ready_without_a_cache_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    mark_ready("descent")
    assert not kernels_are_ready("descent")
