"""True errors of a map: the map position of each surface point."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from marsyard.scenarios.localisation.fields import SmoothField

#: Maximum number of fixed-point iterations of `MapTruth.map_position`, and the change after which they end, m.
_INVERSE_STEPS, _INVERSE_CHANGE_M = 12, 1e-9


@dataclass(frozen=True)
class MapTruth:
    """True errors of a map.

    - shift_m: map position minus world position, of the whole map
    - distortion_x, distortion_y: additional displacement along each axis, m, at a map position
    - elevation_error: error of the elevation, m, at a map position, without the effect of the posts' distance
    - counts_per_radiance: appearance divided by the radiance factor at the orbiter
    """

    shift_m: Float64[np.ndarray, "2"]
    distortion_x: SmoothField
    distortion_y: SmoothField
    elevation_error: SmoothField
    counts_per_radiance: float

    def distortion(self, map_m: Float[np.ndarray, "*batch 2"]) -> Float64[np.ndarray, "*batch 2"]:
        """Return the displacement of map positions relative to the whole map, m."""
        x, y = np.atleast_1d(map_m[..., 0]), np.atleast_1d(map_m[..., 1])
        return np.stack([self.distortion_x.at(x, y), self.distortion_y.at(x, y)], axis=-1).reshape(np.shape(map_m))

    def world_position(self, map_m: Float[np.ndarray, "*batch 2"]) -> Float64[np.ndarray, "*batch 2"]:
        """Return the world x, y of the surface point that appears at a map position.

        The position error of the map is ``map_m - world_position(map_m)``.
        """
        return np.asarray(map_m - self.shift_m - self.distortion(map_m))

    def map_position(self, world_m: Float[np.ndarray, "*batch 2"]) -> Float64[np.ndarray, "*batch 2"]:
        """Return the map position at which a world position appears, by fixed-point iteration.

        It converges, because the distortion changes much less over a metre than a metre.
        """
        map_m = world_m + self.shift_m
        for _ in range(_INVERSE_STEPS):
            previous_m, map_m = map_m, world_m + self.shift_m + self.distortion(map_m)
            if np.abs(map_m - previous_m).max(initial=0.0) < _INVERSE_CHANGE_M:
                break
        return np.asarray(map_m)
