"""Landforms, each with its own parameters and random substream; all add to one grid of heights and albedos."""

from marsyard.sim.terrain.landforms.bedrock import Outcrop, Strata
from marsyard.sim.terrain.landforms.ground import TerrainGround
from marsyard.sim.terrain.landforms.relief import Fans, Gullies, Lava, Playa, Ramp, Swell
from marsyard.sim.terrain.landforms.wind import Drifts, Dunes

__all__ = ["Drifts", "Dunes", "Fans", "Gullies", "Lava", "Outcrop", "Playa", "Ramp", "Strata", "Swell"]
__all__ += ["TerrainGround"]
