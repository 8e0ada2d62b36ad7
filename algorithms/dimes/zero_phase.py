"""The zero-phase spot: ground around the anti-solar point, which the opposition surge brightens.

The spot moves with the lander. Templates of DIMES must not contain it.
"""

import numpy as np
from jaxtyping import Bool, Float

from marsyard.algorithms.arrays import Vector2, Vector3
from marsyard.algorithms.dimes.views import BinnedView


def anti_solar_direction(sun_direction: Vector3) -> Vector3:
    """Unit vector from the lander to the centre of the zero-phase spot, world axes."""
    length = float(np.linalg.norm(sun_direction))
    return -np.asarray(sun_direction, dtype=np.float64) / (length if length > 0.0 else 1.0)


def zero_phase_pixel(view: BinnedView, sun_direction: Vector3) -> Vector2:
    """Pixel (u, v) of the centre of the zero-phase spot, in or out of frame; NaN if the camera cannot image it."""
    # a point at 10 000 km represents infinity
    pixels, visible = view.camera.project((view.centre + 1e7 * anti_solar_direction(sun_direction))[None, :])
    return np.asarray(pixels[0]) if visible[0] else np.full(2, np.nan)


def outside_zero_phase(
    view: BinnedView, ground: Float[np.ndarray, "*shape 2"], sun_direction: Vector3, radius_rad: float
) -> Bool[np.ndarray, "*shape"]:
    """Whether ground points (east, north) are farther than `radius_rad` from the anti-solar direction."""
    spot = anti_solar_direction(sun_direction)
    east, north, height = ground[..., 0], ground[..., 1], view.centre[2]
    ranges = np.sqrt(east**2 + north**2 + height**2)
    dot_products = east * spot[0] + north * spot[1] - height * spot[2]
    return np.asarray(dot_products < np.cos(radius_rad) * ranges)
