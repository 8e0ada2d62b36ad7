"""Camera models of the CAHV family, their files and their conversions."""

from sim.camera.base import CameraModel
from sim.camera.cahv import Cahv
from sim.camera.cahvor import Cahvor
from sim.camera.cahvore import Cahvore

__all__ = ["Cahv", "Cahvor", "Cahvore", "CameraModel"]
