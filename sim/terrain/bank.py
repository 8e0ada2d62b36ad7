"""The bank of numbered terrains, which can store them on disk for many cases."""

import hashlib
import warnings
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from weakref import WeakValueDictionary

import numpy as np

from marsyard.sim.array_cache import CacheWarning, load_array, save_array
from marsyard.sim.cache import cache_directory, evict_files, touch
from marsyard.sim.streams import substream
from marsyard.sim.terrain.landforms.units import FACTOR_STEP
from marsyard.sim.terrain.parameters import TerrainParameters
from marsyard.sim.terrain.rocks.field import RockField
from marsyard.sim.terrain.surface import UNIFORM, Surface, empty_aligned, level_sides
from marsyard.sim.terrain.synthesis import synthesise

#: Modules whose code does not change the samples of a terrain; `rocks` changes them only with wind tails.
_MODULES_NOT_HASHED = ("rocks", "sites.py", "environment.py", "statistics.py")
#: Beginning of the identity of a terrain on an imported DTM.
IMPORTED_TERRAIN = "DTM"
#: Bytes of a sample, and number of factors of the ground (`Surface.factors`).
_SAMPLE_BYTES, _FACTORS = np.dtype(np.float32).itemsize, UNIFORM.shape[-1]
#: Maximum number of terrains of a bank: one for each case of the largest campaign.
MAX_TERRAINS = 1_000_000_000
#: Samples of the terrains that this process uses, by file: the cache does not evict these files.
_IN_USE: WeakValueDictionary[Path, np.ndarray] = WeakValueDictionary()


@cache
def _code_version(*, has_tails: bool) -> str:
    """Compute a hash of the code that synthesises terrains: a change of the code invalidates cached terrains.

    `has_tails`: whether rocks have wind tails, which are part of the terrain; the hash then includes the code of rocks.
    """
    digest = hashlib.sha256(np.__version__.encode())
    folder = Path(__file__).parent
    for path in sorted(folder.rglob("*.py")):
        part = path.relative_to(folder).parts[0]
        if part not in _MODULES_NOT_HASHED or (has_tails and part == "rocks"):
            digest.update(path.read_bytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class TerrainBank:
    """Numbered terrains with the same parameters. Wind tails of rocks are part of the surface.

    Terrain k is a pure function of the parameters, the seed and k. A terrain that several cases use can be stored on
    disk: its file is one array, which contains all levels, then `Surface.factors` (fine relief, albedo contrast and
    rock density). Workers memory-map it and therefore share its pages. The size of the cache is limited (see
    `marsyard.sim.cache.evict_files`). A terrain of a single case is built in memory, so that the cache does not grow
    with the number of cases.
    """

    parameters: TerrainParameters
    seed: int

    def terrain(self, number: int) -> Surface:
        """Load a terrain from disk if it is stored there; otherwise build it in memory."""
        path = self._path(number)
        samples = self._load(path)
        return self._surface(path, self._build_samples(number) if samples is None else samples)

    def store(self, number: int) -> Surface:
        """Load a terrain from disk, or build and store it; if it cannot be written, it is kept in memory only."""
        path = self._path(number)
        samples = self._load(path)
        if samples is None:
            samples = self._build_samples(number)
            try:
                evict_files(path.parent, _SAMPLE_BYTES * self._size(), set(_IN_USE))
                samples = save_array(path, samples)
            except OSError as error:
                warnings.warn(f"terrain {number} is not stored: {path}: {error.strerror}", CacheWarning, stacklevel=2)
        return self._surface(path, samples)

    def _load(self, path: Path) -> np.ndarray | None:
        """Map the samples of a stored terrain, and mark its file as used; None if it is missing or damaged."""
        samples = load_array(path)
        if samples is None or samples.size != self._size():
            return None
        touch(path)
        return samples

    def _build_samples(self, number: int) -> np.ndarray:
        """Build the samples of a terrain with the wind tails of its rocks, read-only, in the order of its file."""
        surface, rocks = synthesise(self.parameters, self._rng(number)), self.parameters.rocks
        if rocks is not None and rocks.tails is not None:
            field = RockField.draw(surface, rocks, substream(self._rng(number), "rocks"))
            surface = rocks.tails.apply(surface, field, substream(self._rng(number), "wind tails"))
        samples: np.ndarray = empty_aligned((self._size(),), np.float32)
        np.concatenate([surface.samples, surface.factors.reshape(-1)], out=samples)
        samples.flags.writeable = False
        return samples

    def _surface(self, path: Path, samples: np.ndarray) -> Surface:
        """Create the surface from the samples of a terrain."""
        _IN_USE[path] = samples
        factor_side = self._factor_side()
        pyramid, factors = np.split(samples, [samples.size - _FACTORS * factor_side**2])
        return Surface(pyramid, self.parameters.spacing_m, factors.reshape(factor_side, factor_side, _FACTORS))

    def missing_bytes(self, number: int) -> int:
        """Return the bytes that a terrain would add on disk, without the header of the file; 0 if it is stored."""
        return 0 if self._path(number).exists() else _SAMPLE_BYTES * self._size()

    def rocks(self, number: int, surface: Surface) -> RockField | None:
        """Build the rocks of a terrain on its surface; they are not stored. None if the parameters have no rocks."""
        if self.parameters.rocks is None:
            return None
        return RockField.draw(surface, self.parameters.rocks, substream(self._rng(number), "rocks"))

    def _rng(self, number: int) -> np.random.Generator:
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.seed, spawn_key=(number,))))

    def identity(self, number: int) -> str:
        """Return the identity of a terrain; all terrains of a bank on one imported DTM are the same ground."""
        source = self.parameters.source
        if source is not None:
            return f"{IMPORTED_TERRAIN} {self._hash_source()}"
        return f"{self.parameters.model_dump_json(exclude={'rocks'})} {self.seed} {number}"

    def _hash_source(self) -> str:
        """Compute the hashes of the files of the imported DTM; files with the same name can have other contents."""
        source = self.parameters.source
        paths = [Path(name) for name in source.input_files()] if source else []
        return " ".join(hashlib.sha256(path.read_bytes()).hexdigest() for path in paths if path.exists())

    def _path(self, number: int) -> Path:
        rocks = self.parameters.rocks
        has_tails = rocks is not None and rocks.tails is not None
        parameters = self.parameters.model_dump_json(exclude=None if has_tails else {"rocks"})
        version = _code_version(has_tails=has_tails)
        identity = f"{parameters} {self.seed} {number} {version} {self._hash_source()}"
        return cache_directory("terrain") / f"{hashlib.sha256(identity.encode()).hexdigest()[:32]}.npy"

    def _size(self) -> int:
        """Return the number of float32 values in the file of a terrain."""
        # height and albedo of each level's samples
        return 2 * sum(side**2 for side in level_sides(self.parameters.samples)) + _FACTORS * self._factor_side() ** 2

    def _factor_side(self) -> int:
        """Return the side of the grid of `Surface.factors`."""
        return 1 if self.parameters.units is None else self.parameters.samples // FACTOR_STEP
