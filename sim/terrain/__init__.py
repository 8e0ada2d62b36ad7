"""Terrain: heightfields with albedo and rocks, synthesised from a seed or imported, and the bank that keeps them."""

from sim.terrain.bank import TerrainBank
from sim.terrain.environment import Environment
from sim.terrain.parameters import TerrainParameters
from sim.terrain.rocks import PlacedRock, RockField, RockMesh, RockParameters
from sim.terrain.sites import Site, site, sites
from sim.terrain.surface import Surface
from sim.terrain.synthesis import synthesise

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
