from pathlib import Path

import numpy as np
import pytest

from sim.terrain import TerrainBank, TerrainParameters

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
def test_a_damaged_file_is_built_anew(cache: Path, damage: bytes | None) -> None:
    bank = TerrainBank(SMALL, seed=1)
    built = _bytes(bank, 3)
    path = next(cache.iterdir())
    path.write_bytes(path.read_bytes()[:1000] if damage is None else damage)
    assert _bytes(bank, 3) == built


def test_terrains_are_read_only(cache: Path) -> None:
    level = TerrainBank(SMALL, seed=1).terrain(0).levels[0]
    with pytest.raises(ValueError, match="read-only"):
        level[0, 0, 0] = np.float32(1.0)
