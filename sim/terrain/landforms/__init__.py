"""Landforms, each with its own parameters and random substream; all add to one grid of heights and albedos."""

from marsyard.sim.terrain.landforms.basin import Fans, Playa
from marsyard.sim.terrain.landforms.bedrock import Outcrop, Strata
from marsyard.sim.terrain.landforms.ground import TerrainGround
from marsyard.sim.terrain.landforms.lava import Lava
from marsyard.sim.terrain.landforms.relief import Gullies, Ramp, Swell
from marsyard.sim.terrain.landforms.wind import Drifts, Dunes

__all__ = ["Drifts", "Dunes", "Fans", "Gullies", "Lava", "Outcrop", "Playa", "Ramp", "Strata", "Swell"]
__all__ += ["TerrainGround"]
