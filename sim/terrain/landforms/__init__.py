"""Landforms, each with parameters and a random substream of its own, that compose into one height and albedo grid."""

from sim.terrain.landforms.aeolian import Dunes
from sim.terrain.landforms.basin import Fans, Playa
from sim.terrain.landforms.channels import Gullies
from sim.terrain.landforms.ground import Ground
from sim.terrain.landforms.lava import Lava
from sim.terrain.landforms.slopes import Ramp, Swell

__all__ = ["Dunes", "Fans", "Ground", "Gullies", "Lava", "Playa", "Ramp", "Swell"]
