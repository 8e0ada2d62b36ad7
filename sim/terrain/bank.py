"""The terrains that a campaign draws from, built once and shared by its workers through the disk."""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from weakref import WeakValueDictionary

import numpy as np
from jaxtyping import Float32

from marsyard.sim.cache import CacheWarning, cache_directory, load_array, make_room, save_array, touch
from marsyard.sim.terrain.parameters import TerrainParameters
from marsyard.sim.terrain.rocks.field import RockField
from marsyard.sim.terrain.substreams import substream
from marsyard.sim.terrain.surface import SMALLEST_LEVEL, Surface
from marsyard.sim.terrain.synthesis import synthesise

#: What a terrain's samples do not depend on but through its parameters: sites, figures, and the rocks upon it.
NOT_OF_THE_SAMPLES = ("environment.py", "presets.py", "rocks", "sites.py", "statistics.py")
#: Samples of the terrains that this process uses, by their files: these are not removed to make room.
_IN_USE: WeakValueDictionary[Path, np.ndarray] = WeakValueDictionary()


@cache
def _code_version() -> str:
    """Hash of the code that makes a terrain: a change of it makes cached terrains unknown, never wrong."""
    digest = hashlib.sha256(np.__version__.encode())
    folder = Path(__file__).parent
    for path in sorted(folder.rglob("*.py")):
        if path.relative_to(folder).parts[0] not in NOT_OF_THE_SAMPLES:
            digest.update(path.read_bytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class TerrainBank:
    """Numbered terrains of one kind.

    Terrain k is a pure function of the parameters, the seed and k. On disk it is one array of all levels, memory-mapped
    by every worker that uses it, so workers share its pages. The disk's share is bounded: see
    `marsyard.sim.cache.make_room`.
    """

    parameters: TerrainParameters
    seed: int

    def terrain(self, number: int) -> Surface:
        """Terrain `number`, from the disk if it is there, otherwise built and kept."""
        path = self._path(number)
        flat = self._kept(path)
        if flat is None:
            flat = self._build(number, path)
        else:
            touch(path)
        _IN_USE[path] = flat
        return self._surface(flat)

    def missing_bytes(self, number: int) -> int:
        """Bytes that a terrain would take on disk, but for some hundred; 0 where it is there."""
        return 0 if self._path(number).exists() else 4 * self._size()

    def rocks(self, number: int) -> RockField | None:
        """The rocks of terrain `number`, built anew each time; None where the parameters ask for none."""
        if self.parameters.rocks is None:
            return None
        return RockField.on(self.terrain(number), self.parameters.rocks, substream(self._rng(number), "rocks"))

    def _rng(self, number: int) -> np.random.Generator:
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.seed, spawn_key=(number,))))

    def _path(self, number: int) -> Path:
        parameters = self.parameters.model_dump_json(exclude={"rocks"})
        identity = f"{parameters} {self.seed} {number} {_code_version()} {self._files()}"
        return cache_directory("terrain") / f"{hashlib.sha256(identity.encode()).hexdigest()[:32]}.npy"

    def _files(self) -> str:
        """Hash of the files of real terrain, which may change under the same name."""
        source = self.parameters.source
        if source is None:
            return ""
        paths = [path for path in (source.dtm, source.ortho) if path is not None and path.exists()]
        return " ".join(hashlib.sha256(path.read_bytes()).hexdigest() for path in paths)

    def _kept(self, path: Path) -> Float32[np.ndarray, "samples"] | None:
        """Samples of all levels, memory-mapped; None where the file is missing or damaged."""
        flat = load_array(path)
        return flat if flat is not None and flat.size == self._size() else None

    def _build(self, number: int, path: Path) -> Float32[np.ndarray, "samples"]:
        """Builds a terrain and keeps it on disk; where that cannot be written, in memory only."""
        built = synthesise(self.parameters, self._rng(number))
        flat = np.concatenate([level.reshape(-1) for level in built.levels])
        try:
            make_room(path.parent, 4 * self._size(), set(_IN_USE))
            return save_array(path, flat)
        except OSError as error:
            warnings.warn(f"terrain {number} is not kept: {path}: {error.strerror}", CacheWarning, stacklevel=2)
            flat.flags.writeable = False
            return flat

    def _sides(self) -> list[int]:
        sides = [self.parameters.samples]
        while sides[-1] > SMALLEST_LEVEL:
            sides.append(sides[-1] // 2)
        return sides

    def _size(self) -> int:
        """Values in a terrain's file: height and albedo on every level."""
        return 2 * sum(side**2 for side in self._sides())

    def _surface(self, flat: Float32[np.ndarray, "samples"]) -> Surface:
        levels, start = [], 0
        for side in self._sides():
            stop = start + 2 * side**2
            levels.append(flat[start:stop].reshape(side, side, 2))
            start = stop
        return Surface(tuple(levels), self.parameters.spacing_m)
