"""Landforms, each with its own parameters and random substream; all add to one grid of heights and albedos."""

from marsyard.sim.terrain.landforms.deposits import Drifts, Strata
from marsyard.sim.terrain.landforms.ground import TerrainGround
from marsyard.sim.terrain.landforms.outcrop import Outcrop
from marsyard.sim.terrain.landforms.relief import Dunes, Fans, Gullies, Lava, Playa, Ramp, Swell

__all__ = ["Drifts", "Dunes", "Fans", "Gullies", "Lava", "Outcrop", "Playa", "Ramp", "Strata", "Swell"]
__all__ += ["TerrainGround"]
