"""Tests of the cache of compiled kernels."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from marsyard.sim.kernel_cache import kernels_are_ready, mark_ready

ROOT = Path(__file__).resolve().parents[2]


def _print_cache_folder(sources: Path, cache: Path, **environment: str) -> str:
    stored = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", "import os, marsyard.sim; print(os.environ['NUMBA_CACHE_DIR'])"],
        cwd=sources,
        env=stored | {"MARSYARD_CACHE": str(cache), "PYTHONPATH": str(sources)} | environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    return done.stdout.strip()


@pytest.mark.parametrize("kernels", ["sim/terrain/kernels.py", "algorithms/hda/kernels/motion.py"])
def test_changed_kernel_recompiles_its_callers(kernels: str, tmp_path: Path) -> None:
    sources = tmp_path / "sources"
    shutil.copytree(ROOT / "marsyard", sources / "marsyard", ignore=shutil.ignore_patterns("__pycache__"))
    before = _print_cache_folder(sources, tmp_path / "cache")
    assert _print_cache_folder(sources, tmp_path / "cache") == before
    changed = sources / "marsyard" / kernels
    changed.write_text(changed.read_text() + "\n# changed\n")
    assert _print_cache_folder(sources, tmp_path / "cache") != before


def test_user_cache_folder_is_kept(tmp_path: Path) -> None:
    assert _print_cache_folder(ROOT, tmp_path, NUMBA_CACHE_DIR="/somewhere") == "/somewhere"


def test_completed_runs_are_recorded_until_kernels_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "one"))
    assert not kernels_are_ready("descent")
    mark_ready("descent")
    assert kernels_are_ready("descent")
    assert not kernels_are_ready("landing")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "two"))
    assert not kernels_are_ready("descent")


def test_unwritable_cache_records_no_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    mark_ready("descent")
    assert not kernels_are_ready("descent")
