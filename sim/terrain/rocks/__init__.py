"""Rocks: shapes, sizes and places, and their triangles for the renderer."""

from sim.terrain.rocks.field import RockField, RockMesh
from sim.terrain.rocks.population import PlacedRock, RockParameters

__all__ = ["PlacedRock", "RockField", "RockMesh", "RockParameters"]
