"""Landforms, each with parameters and a random substream of its own, that compose into one height and albedo grid."""

from marsyard.sim.terrain.landforms.ground import Ground
from marsyard.sim.terrain.landforms.relief import Dunes, Fans, Gullies, Lava, Playa, Ramp, Swell

__all__ = ["Dunes", "Fans", "Ground", "Gullies", "Lava", "Playa", "Ramp", "Swell"]
