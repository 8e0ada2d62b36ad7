"""Sites of the localisation scenario, from ``sites.toml``: ground of kilometres for maps and descents to them."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from marsyard.sim.parameters import merge_parameters
from marsyard.sim.terrain import Site
from marsyard.sim.terrain.sites import SiteTexture

#: Size of the finest cells of textures, metres.
_FINEST_M = 0.001


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
