"""Sites from the files of terrain models, with the light of a preset."""

from functools import lru_cache
from pathlib import Path

from marsyard.scenarios.terrain_files import check_source
from marsyard.sim.terrain import Site, TerrainParameters, site, sites
from marsyard.sim.terrain.imported import choose_grid
from marsyard.sim.terrain.rasters import RealTerrain, TerrainFileError

#: File suffixes of terrain models.
SUFFIXES = (".npz", ".tif", ".tiff", ".img", ".cub")
#: Preset that supplies light, air, scattering and fine texture for imported ground.
LIGHT_PRESET = "gusev"
#: Default maximum fraction of posts without height in a terrain model.
MAX_HOLE_FRACTION = float(RealTerrain.model_fields["max_hole_fraction"].default)


def is_terrain_file(name: str) -> bool:
    """Return whether a name is the file of a terrain model, not a site."""
    return Path(name).suffix.lower() in SUFFIXES


def check_site_name(name: str) -> None:
    """Raise TerrainFileError if a name that is no terrain model is the name of a file, not of a site."""
    path = Path(name)
    if name not in sites() and (path.suffix or len(path.parts) > 1 or path.is_file()):
        raise TerrainFileError(
            f"{name}: is not a terrain model; allowed: {', '.join(SUFFIXES)} (GeoTIFF, PDS3 or ISIS products, "
            f"arrays); convert other rasters with rio convert {path.name} {path.stem}.tif"
        )


def load_site(name: str, max_hole_fraction: float = MAX_HOLE_FRACTION) -> Site:
    """Return a preset by name, or a terrain model's file as a site: one terrain at both scales, no rocks or craters.

    Raises ValueError, or TerrainFileError.
    """
    if not is_terrain_file(name):
        check_site_name(name)
        return site(name)
    path = Path(name)
    source = RealTerrain(dtm=path, max_hole_fraction=max_hole_fraction)
    check_source(source)
    return _import_site(source, path.stat().st_mtime_ns)


@lru_cache(maxsize=4)
def _import_site(source: RealTerrain, _modified_ns: int) -> Site:
    """Create the site of a terrain model; the modification time is a key of the cache."""
    samples, spacing_m = choose_grid(source)
    terrain = TerrainParameters(samples=samples, spacing_m=spacing_m, craters_per_km2=0.0, source=source)
    changes = {
        "name": source.dtm.name,
        "description": f"terrain model {source.dtm} with the light of {LIGHT_PRESET}",
        "descent": terrain,
        "ground": terrain,
        "hills": (),
    }
    return site(LIGHT_PRESET).model_copy(update=changes)
