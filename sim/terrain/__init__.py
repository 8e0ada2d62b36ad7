"""Terrain: heightfields with albedo and rocks, synthesised from a seed or imported, and the bank that keeps them."""

from marsyard.sim.terrain.bank import TerrainBank
from marsyard.sim.terrain.environment import Environment
from marsyard.sim.terrain.parameters import TerrainParameters
from marsyard.sim.terrain.rocks import PlacedRock, RockField, RockMesh, RockParameters
from marsyard.sim.terrain.sites import Site, site, sites
from marsyard.sim.terrain.surface import Surface
from marsyard.sim.terrain.synthesis import synthesise

__all__ = [
    "Environment",
    "PlacedRock",
    "RockField",
    "RockMesh",
    "RockParameters",
    "Site",
    "Surface",
    "TerrainBank",
    "TerrainParameters",
    "site",
    "sites",
    "synthesise",
]
