"""The descent camera: as designed, and as it truly is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float32

from scenarios.descent.parameters import CameraParameters
from sim.camera import Cahv, Cahvor
from sim.render import PixelRays
from sim.sensor import natural_fall_off


@dataclass(frozen=True)
class Optics:
    """What depends on the camera's design alone and is shared by all cases of a worker."""

    camera: Cahvor
    rays: PixelRays
    fall_off: Float32[np.ndarray, "rows columns"]


@cache
def camera_optics(parameters: CameraParameters) -> Optics:
    """The descent camera in the body frame: at its origin, looking down, columns to the east at zero attitude."""
    pinhole = Cahv.from_focal_length(
        focal_m=parameters.focal_length_mm * 1e-3,
        pixel_pitch_m=parameters.pixel_pitch_um * 1e-6,
        size=(parameters.columns, parameters.rows),
        centre=np.zeros(3),
        axis=np.array([0.0, 0.0, -1.0]),
        right=np.array([1.0, 0.0, 0.0]),
    )
    camera = Cahvor.from_cahv(pinhole, r=np.array([parameters.radial_0, parameters.radial_1, parameters.radial_2]))
    return Optics(camera, PixelRays.of(camera), natural_fall_off(camera))
