"""Textured planes, seen exactly through any camera: each pixel's ray is cast to the plane, no renderer."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float32, Float64
from scipy import fft
from scipy.ndimage import map_coordinates

from marsyard.sim.camera import CameraModel

#: Radiance factor of the plane's mean, and of what lies beyond it.
MEAN, BEYOND = 0.2, 0.1
_SIZE, _CONTRAST = 1024, 0.2


@dataclass(frozen=True)
class TexturedPlane:
    """A plane with a periodic texture.

    Attributes
    ----------
    origin
        A point of it in the world, metres.
    along
        Two unit vectors in it, at right angles, shape (2, 3): columns and rows of the texture.
    step_m
        Distance between two samples of the texture.
    """

    origin: Float64[np.ndarray, "3"]
    along: Float64[np.ndarray, "2 3"]
    step_m: float

    def radiance(self, camera: CameraModel) -> Float32[np.ndarray, "rows columns"]:
        """Radiance factor that each pixel of a camera in the world sees."""
        origins, directions = camera.rays(camera.pixel_grid())
        normal = np.cross(*self.along)
        offset = (self.origin - origins) @ normal
        slope = directions @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            ranges = offset / slope
        seen = np.isfinite(ranges) & (ranges > 0.0)
        points = origins + np.where(seen, ranges, 1.0)[..., None] * directions - self.origin
        columns, rows = np.moveaxis(points @ self.along.T, -1, 0) / self.step_m
        values = map_coordinates(texture(), [rows, columns], order=1, mode="grid-wrap")
        return np.where(seen, MEAN * values, BEYOND).astype(np.float32)


@cache
def texture() -> Float32[np.ndarray, "rows columns"]:
    """Noise of mean 1 whose amplitudes fall with frequency, as natural surfaces have it; periodic."""
    rng = np.random.default_rng(20040103)
    frequency = np.hypot(*np.meshgrid(fft.fftfreq(_SIZE), fft.rfftfreq(_SIZE), indexing="ij"))
    frequency[0, 0] = np.inf
    shape = np.where(frequency < 0.3, frequency**-1.2, 0.0) * (frequency > 4.0 / _SIZE)
    values = fft.irfft2(shape * fft.rfft2(rng.standard_normal((_SIZE, _SIZE))), (_SIZE, _SIZE))
    return np.asarray(1.0 + _CONTRAST * values / values.std(), dtype=np.float32)
