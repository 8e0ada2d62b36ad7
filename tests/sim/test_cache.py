"""What is kept on disk stays below its limit, and what is used last goes last."""

import os
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from marsyard.sim.cache import GIGA, evict_files, limit_bytes, touch


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Five files of 100 bytes, 0 used the longest ago, in a cache of 500 bytes."""
    monkeypatch.setenv("MARSYARD_CACHE_GB", f"{500 / GIGA:.12f}")
    for number in range(5):
        path = tmp_path / str(number)
        path.write_bytes(bytes(100))
        os.utime(path, (number, number))
    return tmp_path


def _left(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_what_was_used_the_minimum_recently_makes_room(folder: Path) -> None:
    evict_files(folder, 150)
    assert _left(folder) == {"2", "3", "4"}


def test_use_keeps_a_file(folder: Path) -> None:
    touch(folder / "0")
    evict_files(folder, 150)
    assert _left(folder) == {"0", "3", "4"}


def test_files_in_use_stay_even_beyond_the_limit(folder: Path) -> None:
    evict_files(folder, 10_000, {folder / "1"})
    assert _left(folder) == {"1"}


def test_nothing_goes_while_there_is_room(folder: Path) -> None:
    evict_files(folder, 0)
    assert len(_left(folder)) == 5


def test_leftovers_go_after_a_day_and_files_being_written_never(folder: Path) -> None:
    for name, age_h in (("old.part", 25.0), ("new.part", 23.0)):
        path = folder / name
        path.write_bytes(bytes(1000))
        os.utime(path, (time.time() - 3600.0 * age_h,) * 2)
    evict_files(folder, 0)
    assert _left(folder) == {"0", "1", "2", "3", "4", "new.part"}


def test_the_limit_is_a_share_of_what_the_disk_could_give(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MARSYARD_CACHE_GB", raising=False)
    free = 20 * GIGA
    monkeypatch.setattr("marsyard.sim.cache.shutil.disk_usage", lambda _: SimpleNamespace(free=free))
    assert limit_bytes(tmp_path, 0) == 8 * GIGA
    # what is kept already does not shrink the limit
    assert limit_bytes(tmp_path, 3 * GIGA) == 9.2 * GIGA
    free = 900 * GIGA
    assert limit_bytes(tmp_path, 0) == 10 * GIGA


@pytest.mark.parametrize("wrong", ["plenty", "0", "-3", "nan", "inf"])
def test_says_what_is_wrong_with_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wrong: str) -> None:
    monkeypatch.setenv("MARSYARD_CACHE_GB", wrong)
    with pytest.raises(ValueError, match=f"MARSYARD_CACHE_GB is '{wrong}'; a number of gigabytes above 0"):
        limit_bytes(tmp_path, 0)
