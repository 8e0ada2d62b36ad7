"""Terrain: heightfields with albedo and rocks, synthesised from a seed or imported from files; cached on disk."""

from marsyard.sim.terrain.bank import MAX_TERRAINS, TerrainBank
from marsyard.sim.terrain.environment import Environment
from marsyard.sim.terrain.parameters import TerrainParameters
from marsyard.sim.terrain.rocks import PlacedRock, RockField, RockMesh, RockParameters
from marsyard.sim.terrain.sites import PhotometryChanges, Site, site, sites
from marsyard.sim.terrain.surface import Surface
from marsyard.sim.terrain.synthesis import synthesise

__all__ = ["MAX_TERRAINS", "Environment", "PlacedRock", "RockField", "RockMesh", "RockParameters", "Site", "Surface"]
__all__ += ["PhotometryChanges", "TerrainBank", "TerrainParameters", "site", "sites", "synthesise"]
