"""Tests of the terrain bank, the numbered terrains of a campaign, and of its disk cache."""

import errno
import hashlib
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import marsyard.sim.array_cache as cache_module
from marsyard.sim.array_cache import CacheWarning
from marsyard.sim.terrain import TerrainBank, TerrainParameters

SMALL = TerrainParameters(samples=64)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MARSYARD_CACHE", str(tmp_path))
    return tmp_path / "terrain"


def _read_bytes(bank: TerrainBank, number: int) -> bytes:
    return b"".join(level.tobytes() for level in bank.store(number).levels)


def test_terrain_of_a_single_case_is_not_written(cache: Path) -> None:
    """The cache contains the terrains that were stored, however many others are built."""
    bank = TerrainBank(SMALL, seed=1)
    built = [b"".join(level.tobytes() for level in bank.terrain(number).levels) for number in range(5)]
    assert not list(cache.iterdir())
    assert built[3] == _read_bytes(bank, 3)
    assert len(list(cache.iterdir())) == 1
    # a stored terrain is mapped, not built
    level = bank.terrain(3).levels[0]
    assert level.tobytes() == built[3][: level.nbytes]
    assert not level.flags.owndata


def test_number_seed_and_parameters_identify_a_terrain(cache: Path) -> None:
    terrains = {
        _read_bytes(TerrainBank(SMALL, 1), 0),
        _read_bytes(TerrainBank(SMALL, 1), 1),
        _read_bytes(TerrainBank(SMALL, 2), 0),
        _read_bytes(TerrainBank(SMALL.model_copy(update={"hurst": 0.5}), 1), 0),
    }
    assert len(terrains) == 4


@pytest.mark.parametrize("damage", ["empty", "another file", "cut", "zeros", "removed"])
def test_damaged_file_is_rebuilt(cache: Path, damage: str, recwarn: pytest.WarningsRecorder) -> None:
    """A file that this process has already verified is verified again if its modification time has changed."""
    bank = TerrainBank(SMALL, seed=1)
    expected = _read_bytes(bank, 3)
    assert _read_bytes(bank, 3) == expected
    path = next(cache.iterdir())
    content = path.read_bytes()
    if damage == "removed":
        path.unlink()
    else:
        zeroed = content[:5000] + bytes(20_000) + content[25_000:]
        path.write_bytes(
            {"empty": b"", "another file": b"not an array", "cut": content[:1000], "zeros": zeroed}[damage]
        )
    assert _read_bytes(bank, 3) == expected
    messages = [str(warning.message) for warning in recwarn if warning.category is CacheWarning]
    assert len(messages) == (damage != "removed")
    assert all("damaged and will be rebuilt" in message for message in messages)
    assert ("checksum" in "".join(messages)) == (damage == "zeros")
    assert _read_bytes(bank, 3) == expected


def test_file_is_verified_once_per_process(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bank = TerrainBank(SMALL, seed=1)
    expected = _read_bytes(bank, 0)
    monkeypatch.setattr("marsyard.sim.array_cache._VERIFIED", {})
    checked_sizes: list[int] = []
    compute_checksum = cache_module._compute_checksum

    def count_and_compute(array: np.ndarray) -> object:
        checked_sizes.append(array.size)
        return compute_checksum(array)

    monkeypatch.setattr("marsyard.sim.array_cache._compute_checksum", count_and_compute)
    assert [_read_bytes(bank, 0), _read_bytes(bank, 0)] == [expected, expected]
    assert len(checked_sizes) == 1


def test_terrain_is_synced_before_rename(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[str] = []
    rename, sync = Path.replace, os.fsync

    def record_sync(file: int) -> None:
        steps.append(str(Path(f"/proc/self/fd/{file}").readlink()))
        sync(file)

    def record_rename(self: Path, path: Path) -> Path:
        steps.append("renamed")
        return rename(self, path)

    monkeypatch.setattr("os.fsync", record_sync)
    monkeypatch.setattr(Path, "replace", record_rename)
    TerrainBank(SMALL, seed=1).store(0)
    assert [Path(step).suffix or Path(step).name for step in steps] == [".part", "renamed", "terrain"]


def test_terrains_are_built_without_a_writable_cache(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bank = TerrainBank(SMALL, seed=1)
    expected = _read_bytes(bank, 0)
    next(cache.iterdir()).unlink()

    def raise_disk_full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", raise_disk_full)
    with pytest.warns(CacheWarning, match="No space left"):
        assert _read_bytes(bank, 0) == expected
    assert not list(cache.iterdir())


def test_terrain_larger_than_the_limit_is_built(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MARSYARD_CACHE_GB", "0.00001")
    bank = TerrainBank(SMALL, seed=1)
    first = bank.store(0)
    second = bank.store(1)
    assert first.levels[0].tobytes() == TerrainBank(SMALL, seed=1).store(0).levels[0].tobytes()
    assert np.isfinite(second.levels[0]).all()


def test_terrains_are_read_only(cache: Path) -> None:
    level = TerrainBank(SMALL, seed=1).store(0).levels[0]
    with pytest.raises(ValueError, match="read-only"):
        level[0, 0, 0] = np.float32(1.0)


def test_unused_terrain_is_evicted_for_the_next(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bank = TerrainBank(SMALL, seed=1)
    terrain_in_use = bank.store(0)
    size = next(cache.iterdir()).stat().st_size
    monkeypatch.setenv("MARSYARD_CACHE_GB", f"{2.5 * size / 1e9:.12f}")
    first = set(cache.iterdir())
    expected = _read_bytes(bank, 1)
    second = set(cache.iterdir()) - first
    bank.store(2)
    assert len(list(cache.iterdir())) == 2
    assert first <= set(cache.iterdir()), "in use by this process"
    assert not second & set(cache.iterdir())
    assert _read_bytes(bank, 1) == expected
    assert np.isfinite(terrain_in_use.levels[0]).all()


@pytest.mark.slow
def test_concurrent_builds_in_a_small_cache_are_complete(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each process gets complete terrains while others evict files; no partial file remains."""
    monkeypatch.setenv("MARSYARD_CACHE_GB", "0.0002")
    with ProcessPoolExecutor(3, mp_context=multiprocessing.get_context("spawn")) as pool:
        hashes = list(pool.map(_hash_terrains, range(3)))
    assert hashes[0] == hashes[1] == hashes[2]
    assert not list(cache.glob("*.part"))
    # The limit of 200 kB holds five files of 45 kB. Each of the three processes may have one more file in use.
    assert sum(path.stat().st_size for path in cache.iterdir()) <= 5 * 45_000 + 3 * 45_000


def _hash_terrains(_: int) -> list[str]:
    bank = TerrainBank(SMALL, seed=1)
    return [hashlib.sha256(_read_bytes(bank, number % 8)).hexdigest() for number in range(24)]
