"""Ground points in a binned image: projection, frame, lattices of ground points, and the zero-phase spot.

The zero-phase spot is the ground around the anti-solar point, which the opposition surge brightens. It moves with the
lander. Templates of DIMES must not contain it.
"""

import numpy as np
from jaxtyping import Bool, Float

from marsyard.algorithms.arrays import Flags, Points2, Vector2, Vector3
from marsyard.algorithms.dimes.views import BinnedView


def ground_from_pixels(view: BinnedView, pixels: Points2, max_off_nadir_rad: float) -> tuple[Points2, Flags]:
    """Intersect the rays of pixels (u, v) with the ground: (east, north) in the ground frame, metres.

    A ray farther from the nadir than `max_off_nadir_rad` is replaced by the ray at that angle with the same azimuth.
    This bounds the outline of an image with a horizon. The mask is true for unchanged rays.
    """
    origins, directions = view.camera.rays(pixels)
    horizontal = np.hypot(directions[:, 0], directions[:, 1])
    max_slope = np.tan(max_off_nadir_rad)
    down = -directions[:, 2]
    within_limit = (down > 0.0) & (horizontal <= max_slope * down)
    slope = np.where(within_limit, horizontal / np.where(within_limit, down, 1.0), max_slope)
    azimuths = directions[:, :2] / np.maximum(horizontal, np.finfo(np.float64).tiny)[:, None]
    return origins[:, :2] + (origins[:, 2] * slope)[:, None] * azimuths, within_limit


def pixels_from_ground(
    view: BinnedView, ground: Float[np.ndarray, "*shape 2"]
) -> tuple[Float[np.ndarray, "*shape 2"], Bool[np.ndarray, "*shape"]]:
    """Project ground points (east, north) to pixels (u, v), also outside the frame; False where projection fails."""
    points = np.zeros((*ground.shape[:-1], 3))
    points[..., :2] = ground
    pixels, visible = view.camera.project(points)
    return pixels, visible


def inside_frame(
    view: BinnedView, ground: Float[np.ndarray, "*shape 2"], border_px: float, max_off_nadir_rad: float
) -> Bool[np.ndarray, "*shape"]:
    """Whether ground points lie at least `border_px` inside the image and within the off-nadir limit; False for NaN."""
    pixels, visible = pixels_from_ground(view, ground)
    in_frame = ((pixels >= border_px) & (pixels <= np.array(view.size) - 1 - border_px)).all(axis=-1)
    off_nadir = np.hypot(ground[..., 0], ground[..., 1]) / view.centre[2]
    return np.asarray(visible & in_frame & (off_nadir <= np.tan(max_off_nadir_rad)))


def square_lattice(half_m: float, per_side: int) -> Points2:
    """Lattice of `per_side` x `per_side` points (east, north) over a square of half side `half_m`."""
    steps = np.linspace(-half_m, half_m, per_side)
    east, north = np.meshgrid(steps, steps)
    return np.column_stack([east.ravel(), north.ravel()])


def square_outline(half_m: float, per_side: int) -> Points2:
    """Points of `square_lattice` on the outline of the square."""
    points = square_lattice(half_m, per_side)
    return np.asarray(points[np.abs(points).max(axis=1) == half_m])


def anti_solar_direction(sun_direction: Vector3) -> Vector3:
    """Unit vector from the lander to the centre of the zero-phase spot, world axes."""
    length = float(np.linalg.norm(sun_direction))
    return -np.asarray(sun_direction, dtype=np.float64) / (length if length > 0.0 else 1.0)


def zero_phase_pixel(view: BinnedView) -> Vector2:
    """Pixel (u, v) of the centre of the zero-phase spot, in or out of frame; NaN if the camera cannot image it."""
    # a point at 10 000 km represents infinity
    pixels, visible = view.camera.project((view.centre + 1e7 * anti_solar_direction(view.sun_direction))[None, :])
    return np.asarray(pixels[0]) if visible[0] else np.full(2, np.nan)


def outside_zero_phase(
    view: BinnedView, ground: Float[np.ndarray, "*shape 2"], radius_rad: float
) -> Bool[np.ndarray, "*shape"]:
    """Whether ground points (east, north) are farther than `radius_rad` from the anti-solar direction."""
    spot = anti_solar_direction(view.sun_direction)
    east, north, height = ground[..., 0], ground[..., 1], view.centre[2]
    ranges = np.sqrt(east**2 + north**2 + height**2)
    dot_products = east * spot[0] + north * spot[1] - height * spot[2]
    return np.asarray(dot_products < np.cos(radius_rad) * ranges)
