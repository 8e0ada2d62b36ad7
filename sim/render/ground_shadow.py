"""Shadow of the ground by a sweep towards the sun, and bounds of the slope with which there is none."""

from __future__ import annotations

import numpy as np

from marsyard.sim.render.cones import Bounds
from marsyard.sim.render.device import Float64, UInt32
from marsyard.sim.render.kernels.sweep import heights_in_rows, max_rises, sweep_shadow
from marsyard.sim.render.photometry import Sun
from marsyard.sim.render.sunlight import Grid, GroundShadow
from marsyard.sim.terrain import Surface
from marsyard.sim.terrain.surface import empty_aligned

#: Maximum number of samples along a side of the grid on which the ground's shadow is computed.
SHADOW_SIDE = 4096
#: Additional samples at each border of a grid that covers only the visible ground, for interpolation and rounding.
_BORDER_SAMPLES = 4


def slope_bounds(surface: Surface, sun: Sun) -> tuple[float, float]:
    """Compute upper bounds of the slope along x and y; infinite if ground may hide part of the sun."""
    east, north, _ = np.abs(sun.direction)
    rises = max_rises(surface.levels[0], _lower_edge_rise(sun) * surface.spacing_m, float(east), float(north))
    return rises[0] / surface.spacing_m, rises[1] / surface.spacing_m


def is_sun_above_slopes(sun: Sun, max_slopes: tuple[float, float]) -> bool:
    """Return whether the whole disc of the sun is visible from all ground with at most these slopes along x and y.

    No line between two points of the ground is then as steep as the rays to the lower edge of the disc.
    """
    east, north, _ = np.abs(sun.direction)
    return bool(max_slopes[0] * east + max_slopes[1] * north < _lower_edge_rise(sun))


def _lower_edge_rise(sun: Sun) -> float:
    """Rise of a ray to the lower edge of the sun's disc, per unit length of the ray to its centre."""
    horizontal = float(np.hypot(sun.direction[0], sun.direction[1]))
    elevation = np.arctan2(sun.direction[2], horizontal) - sun.angular_radius_rad
    return horizontal * float(np.tan(max(elevation, 0.0)))


def compute_ground_shadow(
    surface: Surface, sun: Sun, height_range_m: tuple[float, float], visible_m: Bounds | None = None
) -> GroundShadow | None:
    """Compute the shadow of the ground by a sweep along the axis nearest to the sun's azimuth; the sun must be up.

    `visible_m` contains minimum and maximum x, then y, of the ground whose shadow is needed; None for all ground. The
    grid of the shadow is that of a terrain level. If it covers a part of the ground only, its period is shorter.
    Returns None for a sun in the zenith.
    """
    level = int(np.argmax([samples.shape[0] <= SHADOW_SIDE for samples in surface.levels]))
    field, spacing = surface.levels[level], surface.spacing_m * 2.0**level
    east, north, up = (float(component) for component in sun.direction)
    along_x = abs(east) > abs(north)
    along, across = (east, north) if along_x else (north, east)
    if along == 0.0:
        return None
    # from one row to the next towards the sun, a ray rises by `drop` metres and moves by `shift` columns
    drop, shift = spacing * up / abs(along), across / abs(along)
    rows = columns = np.arange(len(field))
    max_rows = int(min(np.ceil((height_range_m[1] - height_range_m[0]) / drop) + 1, len(field)))
    if visible_m is not None:
        # rows of the longest path towards the sun, as many rows for shadows that fall on its end, and 10 % of both
        path_rows = 2.2 * max_rows + _BORDER_SAMPLES
        path = spacing * path_rows * np.array([np.sign(along), shift] if along_x else [shift, np.sign(along)])
        bounds = np.reshape(visible_m, (2, 2)) + np.stack([np.minimum(path, 0.0), np.maximum(path, 0.0)], axis=1)
        first = np.floor(bounds[:, 0] / spacing).astype(int) - _BORDER_SAMPLES
        last = np.ceil(bounds[:, 1] / spacing).astype(int) + _BORDER_SAMPLES
        # the period of the grid is a power of two: sample k is entry k modulo the period
        count = 1 << int((last - first).max()).bit_length()
        if count < len(field):
            entries = np.arange(count)
            columns, rows = ((start + ((entries - start) & (count - 1))) & (len(field) - 1) for start in first)
    height = heights_in_rows(field, rows, columns, along_x)
    shadow_height, caster_distance = (empty_aligned(height.shape, kind) for kind in (np.float32, np.uint8))
    sweep_shadow(height, float(np.sign(along)), drop, shift, max_rows, shadow_height, caster_distance)
    return GroundShadow(
        Grid.of(shadow_height, 1.0 / spacing, share=True),
        Grid.of(caster_distance, 1.0 / spacing, share=True),
        along_x,
        Float64(spacing),
        UInt32(level),
        Float64(spacing / abs(along)),
        Float64(np.hypot(east, north)),
        Float64(height_range_m[1]),
    )
