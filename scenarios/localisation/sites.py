"""Sites of the localisation scenario, from ``sites.toml``, and required size of a DTM in the middle of their ground."""

import tomllib
from collections.abc import Mapping
from functools import cache, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from marsyard.sim.parameters import merge_parameters
from marsyard.sim.terrain import Site, TerrainParameters
from marsyard.sim.terrain.rasters import RealTerrain, TerrainFileError, read_rasters
from marsyard.sim.terrain.sites import SiteTexture

#: Size of the finest cells of textures, metres.
_FINEST_M = 0.001
#: Minimum period of a terrain with a DTM, m: the size of a map of Mars 2020, 2048 pixels of 6 m, rounded.
MIN_PERIOD_M = 12_000.0


@cache
def localisation_sites() -> Mapping[str, Site]:
    """Return all sites in ``sites.toml`` by name; each has terrain parameters at the scale of a descent."""
    tables = tomllib.loads(Path(__file__).with_name("sites.toml").read_text("utf-8"))
    sites = {}
    for name, entry in tables["sites"].items():
        values = merge_parameters(tables["common"], entry)
        values["descent"] = merge_parameters(tables["terrain"], values["descent"])
        for texture in ("ground_texture", "rock_texture"):
            values[texture] = _create_texture(values[texture])
        sites[name] = Site(name=name, **values)
    return MappingProxyType(sites)


def localisation_site(name: str) -> Site:
    """Return the site with this name. Raises ValueError if there is none; the message lists the sites."""
    sites = localisation_sites()
    if name not in sites:
        raise ValueError(f"no localisation site is called '{name}'; allowed: {', '.join(sites)}")
    return sites[name]


def _create_texture(entry: Mapping[str, Any]) -> SiteTexture:
    """Create a texture with cell sizes halved from `coarsest_m` down to 1 mm, and amplitudes multiplied by `decay`."""
    octaves = np.arange(int(np.log2(entry["coarsest_m"] / _FINEST_M)) + 1)
    amplitudes = entry["amplitude"] * entry["decay"] ** octaves
    return SiteTexture(coarsest_m=entry["coarsest_m"], amplitudes=tuple(np.round(amplitudes, 5).tolist()))


def check_imported_terrain(terrain: TerrainParameters, last_image_m: float) -> None:
    """Check the size of a terrain with a DTM from a file; the file itself is already checked.

    `last_image_m` is the width of the ground in the last image: a smaller DTM is never the only ground in an image.
    Raises ValueError for a terrain that is too small, and TerrainFileError for a DTM that is too small or too large.
    """
    source = terrain.source
    if source is None:
        return
    period_m = terrain.samples * terrain.spacing_m
    if period_m < MIN_PERIOD_M:
        raise ValueError(
            f"the terrain repeats after {period_m:g} m; allowed with terrain.source: at least {MIN_PERIOD_M:g} m: "
            "increase terrain.samples or terrain.spacing_m"
        )
    width_m, length_m = _extent(source, source.dtm.stat().st_mtime_ns)
    low_m, high_m = last_image_m + 2.0 * source.border_m, period_m - 2.0 * terrain.spacing_m
    if min(width_m, length_m) < low_m:
        raise TerrainFileError(
            f"{source.dtm}: covers {width_m:g} m x {length_m:g} m; allowed: at least {low_m:g} m along each side: the "
            f"last image shows {last_image_m:g} m, and the blended border is {source.border_m:g} m wide"
        )
    if max(width_m, length_m) > high_m:
        raise TerrainFileError(
            f"{source.dtm}: covers {width_m:g} m x {length_m:g} m; allowed: at most {high_m:g} m along each side: "
            "extract a part with rio clip --bounds, or increase terrain.samples or terrain.spacing_m"
        )


@lru_cache(maxsize=16)
def _extent(source: RealTerrain, _modified_ns: int) -> tuple[float, float]:
    """Return the extent of the DTM's posts along x and y, m; the modification time is a key of the cache."""
    heights, _ = read_rasters(source.model_copy(update={"ortho": None}))
    rows, columns = heights.values.shape
    return (columns - 1) * heights.posting_m, (rows - 1) * heights.posting_m
