"""Rocks: shapes, sizes and positions, and their triangles for the renderer."""

from marsyard.sim.terrain.rocks.field import PlacedRock, RockField, RockMesh, RockParameters

__all__ = ["PlacedRock", "RockField", "RockMesh", "RockParameters"]
