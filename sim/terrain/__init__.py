"""Terrain: heightfields with albedo, synthesised from a seed, and the bank on disk that keeps them."""

from sim.terrain.bank import TerrainBank
from sim.terrain.surface import Surface
from sim.terrain.synthesis import TerrainParameters, synthesise

__all__ = ["Surface", "TerrainBank", "TerrainParameters", "synthesise"]
