"""Synthesis of terrains from seeds, and the bank of numbered terrains, which can store them on disk for many cases."""

import hashlib
import warnings
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from weakref import WeakValueDictionary

import numpy as np
from jaxtyping import Float32

from marsyard.sim.array_cache import CacheWarning, load_array, save_array
from marsyard.sim.cache import cache_directory, evict_files, touch
from marsyard.sim.terrain.imported import blend_into_ground, embed, extract_fine_detail
from marsyard.sim.terrain.landforms.craters import add_craters, draw_craters
from marsyard.sim.terrain.landforms.ground import FractalField, TerrainGround, refine, substream
from marsyard.sim.terrain.landforms.kernels.shapes import interleave_samples
from marsyard.sim.terrain.landforms.units import FACTOR_STEP
from marsyard.sim.terrain.parameters import LANDFORMS, TerrainParameters
from marsyard.sim.terrain.rocks.field import RockField
from marsyard.sim.terrain.surface import (
    ROUGHNESS,
    TEXTURE,
    UNIFORM,
    Surface,
    empty_aligned,
    empty_pyramid,
    level_sides,
    split_levels,
)

#: Height of the ridges of fine relief, divided by its mean absolute height (assumed): the ground between them is level.
RIDGE_HEIGHT = 1.5
#: Modules whose code does not change the samples of a terrain; `rocks` changes them only with wind tails.
_MODULES_NOT_HASHED = ("rocks", "sites.py", "environment.py", "published_sites.py")
#: Beginning of the identity of a terrain on an imported DTM.
IMPORTED_TERRAIN = "DTM"
#: Maximum number of terrains of a bank: one for each case of the largest campaign.
MAX_TERRAINS = 1_000_000_000
#: Samples of the terrains that this process uses, by file: the cache does not evict these files.
_IN_USE: WeakValueDictionary[Path, np.ndarray] = WeakValueDictionary()


def synthesise(parameters: TerrainParameters, rng: np.random.Generator) -> Surface:
    """Synthesise a terrain from parameters and a random stream; the same stream gives bit-identical samples.

    Each landform has its own named substream: a new or changed landform does not change the others. The synthesis is
    single-threaded, so that the samples do not depend on the number of threads.
    """
    p = parameters
    relief = FractalField.power_law(p.samples, p.spacing_m, p.hurst, p.outer_scale_m)
    rms_slope = np.tan(np.radians(p.rms_slope_deg))
    relief_m = rms_slope / relief.line_slope_rms(p.slope_baseline_m)
    albedo = FractalField.power_law(p.samples, p.spacing_m, p.albedo_hurst, p.outer_scale_m)
    contrast = p.albedo_contrast * float(np.exp(p.contrast_spread * substream(rng, "contrast").standard_normal()))
    craters = draw_craters(p, substream(rng, "craters"))
    # equal random modes: hollows are dark, and crests bright, at all scales
    albedo_rng = substream(rng, "relief" if p.albedo_follows_relief else "albedo")
    if p.units is None:
        height = relief.draw_field(substream(rng, "relief"), relief_m)
        log_albedo = albedo.draw_field(albedo_rng, contrast)
        fine = ground = TerrainGround(height, log_albedo, p.spacing_m)
    else:
        height, fine_relief = relief.draw_split_field(substream(rng, "relief"), relief_m, p.fine_below_m)
        log_albedo, fine_albedo = albedo.draw_split_field(albedo_rng, contrast, p.fine_below_m)
        ground = TerrainGround(height, log_albedo, p.spacing_m)
        fine = TerrainGround(fine_relief, fine_albedo, p.spacing_m)
    dtm = None
    if p.source is not None:
        dtm = embed(p.source, ground.side, ground.spacing_m)
        detail = extract_fine_detail(fine, dtm) if p.source.roughen else None
    for name in LANDFORMS:
        landform = getattr(p, name)
        if landform is not None:
            landform.apply(ground, substream(rng, name))
    factors = UNIFORM
    if p.units is not None:
        factors = p.units.apply(ground, craters, substream(rng, "units"))
        _add_fine_ground(ground, fine, factors, p.relief_log_albedo)
    if len(craters):
        add_craters(ground, craters)
    if p.drifts is not None:
        p.drifts.apply(ground, substream(rng, "drifts"))
    if dtm is not None:
        blend_into_ground(ground, dtm, detail)
    relative_albedo = np.exp(ground.log_albedo, out=ground.log_albedo)
    pyramid = empty_pyramid(ground.side)
    samples = split_levels(pyramid, level_sides(ground.side))[0]
    interleave_samples(
        ground.height, relative_albedo, p.albedo / float(relative_albedo.mean(dtype=np.float64)), samples
    )
    return Surface.from_pyramid(pyramid, ground.spacing_m, factors)


def _add_fine_ground(
    ground: TerrainGround, fine: TerrainGround, factors: Float32[np.ndarray, "side side 3"], relief_log_albedo: float
) -> None:
    """Add fine relief and albedo, scaled by the factors of the surface units.

    With `relief_log_albedo` the relief z becomes ridges along its level lines z = 0, of height ``-min(|z|, limit)``.
    The log albedo falls by `relief_log_albedo` per mean of abs(z) below their crests: sand fills the ground between.
    """
    height, log_albedo = fine.height, fine.log_albedo
    roughness, texture = (
        refine(np.ascontiguousarray(factors[..., channel]), ground.side) for channel in (ROUGHNESS, TEXTURE)
    )
    if relief_log_albedo:
        np.abs(height, out=height)
        mean = float(height[::FACTOR_STEP, ::FACTOR_STEP].mean(dtype=np.float64))
        np.minimum(height, np.float32(RIDGE_HEIGHT * mean), out=height)
        np.negative(roughness, out=roughness)
    height *= roughness
    log_albedo *= texture
    ground.add(fine)
    if relief_log_albedo:
        height *= np.float32(relief_log_albedo / mean)
        np.add(ground.log_albedo, height, out=ground.log_albedo)


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
                evict_files(path.parent, 4 * self._size(), set(_IN_USE))
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
        """Build the samples of a terrain, read-only, in the order of its file."""
        surface = self._build(number)
        samples: np.ndarray = empty_aligned((self._size(),), np.float32)
        np.concatenate([surface.samples, surface.factors.reshape(-1)], out=samples)
        samples.flags.writeable = False
        return samples

    def _surface(self, path: Path, samples: np.ndarray) -> Surface:
        """Create the surface from the samples of a terrain."""
        _IN_USE[path] = samples
        factor_side = self._factor_side()
        pyramid, factors = np.split(samples, [samples.size - 3 * factor_side**2])
        return Surface(pyramid, self.parameters.spacing_m, factors.reshape(factor_side, factor_side, 3))

    def _build(self, number: int) -> Surface:
        """Synthesise a terrain, with the wind tails of its rocks."""
        surface, rocks = synthesise(self.parameters, self._rng(number)), self.parameters.rocks
        if rocks is None or rocks.tails is None:
            return surface
        field = RockField.draw(surface, rocks, substream(self._rng(number), "rocks"))
        return rocks.tails.apply(surface, field, substream(self._rng(number), "wind tails"))

    def missing_bytes(self, number: int) -> int:
        """Return the bytes that a terrain would add on disk, without the header of the file; 0 if it is stored."""
        return 0 if self._path(number).exists() else 4 * self._size()

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
        return 2 * sum(side**2 for side in level_sides(self.parameters.samples)) + 3 * self._factor_side() ** 2

    def _factor_side(self) -> int:
        """Return the side of the grid of `Surface.factors`."""
        return 1 if self.parameters.units is None else self.parameters.samples // FACTOR_STEP
