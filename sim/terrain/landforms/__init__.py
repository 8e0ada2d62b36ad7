"""Landforms, each with parameters and a random substream of its own, that compose into one height and albedo grid."""

from marsyard.sim.terrain.landforms.aeolian import Dunes
from marsyard.sim.terrain.landforms.basin import Fans, Playa
from marsyard.sim.terrain.landforms.channels import Gullies
from marsyard.sim.terrain.landforms.ground import Ground
from marsyard.sim.terrain.landforms.lava import Lava
from marsyard.sim.terrain.landforms.slopes import Ramp, Swell

__all__ = ["Dunes", "Fans", "Ground", "Gullies", "Lava", "Playa", "Ramp", "Swell"]
