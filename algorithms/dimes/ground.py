"""Between pixels of a view and its ground plane, through the full camera model."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from marsyard.algorithms.dimes.binning import View


def ground_from_pixels(
    view: View, pixels: Float[np.ndarray, "n 2"], max_off_nadir_rad: float
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, "n"]]:
    """Where the rays of pixels (u, v) meet the ground: (east, north) in the view's ground frame, metres.

    A ray further from the nadir than `max_off_nadir_rad`, above the horizon too, is bent down to that angle in its own
    azimuth; the mask is true for rays that were not. So the outline of a picture that sees the horizon stays bounded.
    """
    origins, directions = view.camera.rays(pixels)
    horizontal = np.hypot(directions[:, 0], directions[:, 1])
    steepest = np.tan(max_off_nadir_rad)
    down = -directions[:, 2]
    near = (down > 0.0) & (horizontal <= steepest * down)
    slope = np.where(near, horizontal / np.where(near, down, 1.0), steepest)
    azimuths = directions[:, :2] / np.maximum(horizontal, np.finfo(np.float64).tiny)[:, None]
    return origins[:, :2] + (origins[:, 2] * slope)[:, None] * azimuths, near


def pixels_from_ground(
    view: View, ground: Float[np.ndarray, "*shape 2"]
) -> tuple[Float[np.ndarray, "*shape 2"], Bool[np.ndarray, "*shape"]]:
    """Pixels (u, v) of ground points (east, north), and whether the optics can image them (in frame or out of it)."""
    points = np.zeros((*ground.shape[:-1], 3))
    points[..., :2] = ground
    pixels, visible = view.camera.project(points)
    return pixels, visible


def inside_frame(
    view: View, ground: Float[np.ndarray, "*shape 2"], border_px: float, max_off_nadir_rad: float
) -> Bool[np.ndarray, "*shape"]:
    """Whether ground points are seen at least `border_px` inside the picture, no further from the nadir than allowed.

    False for NaN.
    """
    pixels, visible = pixels_from_ground(view, ground)
    columns, rows = view.size
    u, v = pixels[..., 0], pixels[..., 1]
    in_u = (u >= border_px) & (u <= columns - 1 - border_px)
    in_v = (v >= border_px) & (v <= rows - 1 - border_px)
    off_nadir = np.hypot(ground[..., 0], ground[..., 1]) / view.centre[2]
    return np.asarray(visible & in_u & in_v & (off_nadir <= np.tan(max_off_nadir_rad)))


def pixel_angle_rad(view: View) -> float:
    """Angle that one pixel of the view spans at the middle of the picture: the mean along columns and rows."""
    columns, rows = view.size
    middle = np.array([(columns - 1) / 2.0, (rows - 1) / 2.0])
    around = middle + np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]])
    _, directions = view.camera.rays(around)
    across = np.linalg.norm(directions[[1, 3]] - directions[[0, 2]], axis=1)
    return float(across.mean())


def square(half_m: float, per_side: int) -> Float[np.ndarray, "n 2"]:
    """A lattice of `per_side` x `per_side` points (east, north) over a square of half side `half_m`, metres."""
    steps = np.linspace(-half_m, half_m, per_side)
    east, north = np.meshgrid(steps, steps)
    return np.column_stack([east.ravel(), north.ravel()])


def square_outline(half_m: float, per_side: int) -> Float[np.ndarray, "n 2"]:
    """The points of `square` that lie on its outline."""
    on_edge = np.ones((per_side, per_side), dtype=bool)
    on_edge[1:-1, 1:-1] = False
    return np.asarray(square(half_m, per_side)[on_edge.ravel()])
