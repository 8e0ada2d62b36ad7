import errno
import hashlib
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import marsyard.sim.cache as cache_module
from marsyard.sim.cache import CacheWarning
from marsyard.sim.terrain import TerrainBank, TerrainParameters

SMALL = TerrainParameters(samples=64)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MARSYARD_CACHE", str(tmp_path))
    return tmp_path / "terrain"


def _bytes(bank: TerrainBank, number: int) -> bytes:
    return b"".join(level.tobytes() for level in bank.terrain(number).levels)


def test_a_cached_terrain_is_the_terrain_that_was_built(cache: Path) -> None:
    bank = TerrainBank(SMALL, seed=1)
    built = _bytes(bank, 0)
    assert len(list(cache.iterdir())) == 1
    assert _bytes(bank, 0) == built
    next(cache.iterdir()).unlink()
    assert _bytes(bank, 0) == built


def test_numbers_seeds_and_parameters_tell_terrains_apart(cache: Path) -> None:
    terrains = {
        _bytes(TerrainBank(SMALL, 1), 0),
        _bytes(TerrainBank(SMALL, 1), 1),
        _bytes(TerrainBank(SMALL, 2), 0),
        _bytes(TerrainBank(SMALL.model_copy(update={"hurst": 0.5}), 1), 0),
    }
    assert len(terrains) == 4


@pytest.mark.parametrize("damage", [b"", b"not an array", None])
def test_a_damaged_file_is_built_again(cache: Path, damage: bytes | None) -> None:
    bank = TerrainBank(SMALL, seed=1)
    built = _bytes(bank, 3)
    path = next(cache.iterdir())
    path.write_bytes(path.read_bytes()[:1000] if damage is None else damage)
    with pytest.warns(CacheWarning, match="damaged and built again"):
        assert _bytes(bank, 3) == built
    assert _bytes(bank, 3) == built


def test_zeros_in_a_cached_file_are_noticed_and_the_terrain_is_built_again(cache: Path) -> None:
    """Also by a process that has verified the file before, and although the time of use was set meanwhile."""
    bank = TerrainBank(SMALL, seed=1)
    built = _bytes(bank, 0)
    assert _bytes(bank, 0) == built
    with next(cache.iterdir()).open("r+b") as file:
        file.seek(5000)
        file.write(bytes(20_000))
    with pytest.warns(CacheWarning, match="checksum"):
        assert _bytes(bank, 0) == built
    assert _bytes(bank, 0) == built


def test_a_file_is_verified_once_by_a_process(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bank = TerrainBank(SMALL, seed=1)
    built = _bytes(bank, 0)
    monkeypatch.setattr("marsyard.sim.cache._VERIFIED", {})
    summed: list[int] = []
    checksum = cache_module._checksum

    def count(array: np.ndarray) -> object:
        summed.append(array.size)
        return checksum(array)

    monkeypatch.setattr("marsyard.sim.cache._checksum", count)
    assert [_bytes(bank, 0), _bytes(bank, 0)] == [built, built]
    assert len(summed) == 1


def test_a_terrain_is_synced_before_it_gets_its_name(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[str] = []
    replace, sync = Path.replace, os.fsync

    def record_sync(file: int) -> None:
        steps.append(str(Path(f"/proc/self/fd/{file}").readlink()))
        sync(file)

    def record_rename(self: Path, path: Path) -> Path:
        steps.append("named")
        return replace(self, path)

    monkeypatch.setattr("os.fsync", record_sync)
    monkeypatch.setattr(Path, "replace", record_rename)
    TerrainBank(SMALL, seed=1).terrain(0)
    assert [Path(step).suffix or Path(step).name for step in steps] == [".part", "named", "terrain"]


def test_a_cache_that_cannot_be_written_costs_time_only(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bank = TerrainBank(SMALL, seed=1)
    built = _bytes(bank, 0)
    next(cache.iterdir()).unlink()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.warns(CacheWarning, match="No space left"):
        assert _bytes(bank, 0) == built
    assert not list(cache.iterdir())


def test_a_terrain_larger_than_the_limit_is_built_and_used(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MARSYARD_CACHE_GB", "0.00001")
    bank = TerrainBank(SMALL, seed=1)
    held = bank.terrain(0)
    other = bank.terrain(1)
    assert held.levels[0].tobytes() == TerrainBank(SMALL, seed=1).terrain(0).levels[0].tobytes()
    assert np.isfinite(other.levels[0]).all()


def test_terrains_are_read_only(cache: Path) -> None:
    level = TerrainBank(SMALL, seed=1).terrain(0).levels[0]
    with pytest.raises(ValueError, match="read-only"):
        level[0, 0, 0] = np.float32(1.0)


def test_a_terrain_not_in_use_makes_room_for_the_next(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bank = TerrainBank(SMALL, seed=1)
    held = bank.terrain(0)
    size = next(cache.iterdir()).stat().st_size
    monkeypatch.setenv("MARSYARD_CACHE_GB", f"{2.5 * size / 1e9:.12f}")
    first = set(cache.iterdir())
    built = _bytes(bank, 1)
    second = set(cache.iterdir()) - first
    bank.terrain(2)
    assert len(list(cache.iterdir())) == 2
    assert first <= set(cache.iterdir()), "held by this process"
    assert not second & set(cache.iterdir())
    assert _bytes(bank, 1) == built
    assert np.isfinite(held.levels[0]).all()


def test_a_terrain_removed_by_another_process_stays_readable(cache: Path) -> None:
    surface = TerrainBank(SMALL, seed=1).terrain(0)
    before = surface.levels[0].tobytes()
    next(cache.iterdir()).unlink()
    assert surface.levels[0].tobytes() == before


def test_many_processes_may_build_at_once_in_a_cache_too_small(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each finds its terrains whole, whatever the others remove; nothing half-written is left."""
    monkeypatch.setenv("MARSYARD_CACHE_GB", "0.0002")
    with ProcessPoolExecutor(3, mp_context=multiprocessing.get_context("spawn")) as pool:
        seen = list(pool.map(_digests, range(3)))
    assert seen[0] == seen[1] == seen[2]
    assert not list(cache.glob("*.part"))
    assert sum(path.stat().st_size for path in cache.iterdir()) <= 5 * 45_000 + 3 * 45_000


def _digests(_: int) -> list[str]:
    bank = TerrainBank(SMALL, seed=1)
    return [hashlib.sha256(_bytes(bank, number % 8)).hexdigest() for number in range(24)]
