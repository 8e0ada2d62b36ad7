"""Terrain models of a user as sites: measured ground in a synthetic surround, with the light of a preset."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from marsyard.scenarios.terrain_files import check_source
from marsyard.sim.terrain import Site, TerrainParameters, site
from marsyard.sim.terrain.imported import RealTerrain, choose_grid

#: Suffixes of terrain models.
ENDINGS = (".npz", ".tif", ".tiff")
#: Preset of the light, air, scattering and fine texture of imported ground.
LIGHT_OF = "gusev"
#: Fraction of posts without height up to which a terrain model is used, unless stated.
MAX_HOLE_FRACTION = float(RealTerrain.model_fields["max_hole_fraction"].default)


def is_terrain_file(name: str) -> bool:
    """Return whether a name is that of a terrain model's file, not of a site."""
    return Path(name).suffix.lower() in ENDINGS


def site_or_file(name: str, max_hole_fraction: float = MAX_HOLE_FRACTION) -> Site:
    """Return a preset by name, or the site of a terrain model's file. Raises ValueError."""
    return imported_site(Path(name), max_hole_fraction) if is_terrain_file(name) else site(name)


def imported_site(path: Path, max_hole_fraction: float = MAX_HOLE_FRACTION) -> Site:
    """Return a terrain model's file as a site: one terrain at both scales, without rocks or craters.

    Raises TerrainFileError.
    """
    source = RealTerrain(dtm=path, max_hole_fraction=max_hole_fraction)
    check_source(source)
    return _imported(source, path.stat().st_mtime_ns)


@lru_cache(maxsize=4)
def _imported(source: RealTerrain, _changed_ns: int) -> Site:
    samples, spacing_m = choose_grid(source)
    terrain = TerrainParameters(samples=samples, spacing_m=spacing_m, craters_per_km2=0.0, source=source)
    changes = {
        "name": source.dtm.name,
        "description": f"terrain model {source.dtm} in the light of {LIGHT_OF}",
        "descent": terrain,
        "ground": terrain,
    }
    return site(LIGHT_OF).model_copy(update=changes)
