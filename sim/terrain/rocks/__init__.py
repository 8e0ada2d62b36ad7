"""Rocks: shapes, sizes and places, and their triangles for the renderer."""

from marsyard.sim.terrain.rocks.field import RockField, RockMesh
from marsyard.sim.terrain.rocks.population import PlacedRock, RockParameters

__all__ = ["PlacedRock", "RockField", "RockMesh", "RockParameters"]
