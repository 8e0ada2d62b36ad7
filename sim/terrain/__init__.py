"""Terrain: heightfields with albedo and rocks, synthesised from a seed or imported from files; cached on disk."""

from marsyard.sim.terrain.bank import TerrainBank, synthesise
from marsyard.sim.terrain.parameters import TerrainParameters
from marsyard.sim.terrain.rocks import PlacedRock, RockField, RockMesh, RockParameters
from marsyard.sim.terrain.sites import Environment, Site, site, sites
from marsyard.sim.terrain.surface import Surface

__all__ = ["Environment", "PlacedRock", "RockField", "RockMesh", "RockParameters", "Site", "Surface", "TerrainBank"]
__all__ += ["TerrainParameters", "site", "sites", "synthesise"]
