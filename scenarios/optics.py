"""A camera with what follows from its design alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from sim.camera import CameraModel
from sim.render import PixelRays
from sim.sensor import natural_fall_off


@dataclass(frozen=True)
class Optics:
    """A camera in the body frame, the rays of its pixels and the fall-off of its lens: shared by a worker's cases."""

    camera: CameraModel
    rays: PixelRays
    fall_off: Float32[np.ndarray, "rows columns"]

    @classmethod
    def of(cls, camera: CameraModel) -> Optics:
        """The optics of a camera."""
        return cls(camera, PixelRays.of(camera), natural_fall_off(camera))
