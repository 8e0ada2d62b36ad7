"""The shadow that the ground casts on itself, swept over the whole terrain or over the part that pictures show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from marsyard.sim.render.kernels.ground import greatest_rises
from marsyard.sim.render.kernels.structs import Bounds, GroundShadow
from marsyard.sim.render.kernels.sun import heights_in_rows, sweep_shadow
from marsyard.sim.render.photometry import Sun
from marsyard.sim.render.reach import Cone
from marsyard.sim.terrain import Surface

#: Most posts along a side of the grid on which the shadow is swept.
SHADOW_SIDE = 4096
#: What there is without a shadow.
NO_SHADOW = GroundShadow(
    np.full((1, 1), -np.inf, dtype=np.float32), np.zeros((1, 1), dtype=np.uint8), False, 1.0, 0, 1.0, 1.0, 0.0
)
#: Directions along a cone's rim from which the ground in it is found, and by how much, as a share of it, the ground is
#: wider than their hull. Where they cover more than a period, nothing is gained.
_RIM, _WIDER = 64, 0.01
#: Posts beyond what is needed: those between which is interpolated, and a row or two by rounding.
_SPARE = 4


def slope_bounds(surface: Surface, sun: Sun) -> tuple[float, float]:
    """Bounds of the ground's slope along x and along y; infinite where ground so steep could hide part of the sun."""
    east, north, _ = np.abs(sun.direction)
    rises = greatest_rises(surface.levels[0], _lowest_ray(sun) * surface.spacing_m, float(east), float(north))
    return rises[0] / surface.spacing_m, rises[1] / surface.spacing_m


def sun_over_slopes(sun: Sun, steepest: tuple[float, float]) -> bool:
    """Whether ground of no more than these slopes along x and y leaves the whole disc of the sun in sight everywhere.

    No line between two places of it then rises as steeply as the rays to the disc's lower edge.
    """
    east, north, _ = np.abs(sun.direction)
    return bool(steepest[0] * east + steepest[1] * north < _lowest_ray(sun))


def _lowest_ray(sun: Sun) -> float:
    """How far rays to the lower edge of the sun's disc rise on the way that those to its middle go across."""
    across = float(np.hypot(sun.direction[0], sun.direction[1]))
    elevation = np.arctan2(sun.direction[2], across) - sun.angular_radius_rad
    return across * float(np.tan(max(elevation, 0.0)))


def ground_shadow(
    surface: Surface, sun: Sun, height_range_m: tuple[float, float], shown_m: Bounds | None = None
) -> GroundShadow:
    """Sweeps the shadow along whichever axis the sun's azimuth is nearer to.

    Parameters
    ----------
    surface, height_range_m
        The ground and bounds of its height.
    sun
        Above the horizon.
    shown_m
        Where the shadow may be asked for: least and greatest x, least and greatest y; None for everywhere. A walk from
        there towards the sun until it is above all ground may ask too.

    Returns
    -------
    The shadow on the grid of a level of the surface. A grid that covers a part of the ground only repeats as the whole
    does, after fewer posts.
    """
    level = int(np.argmax([one.shape[0] <= SHADOW_SIDE for one in surface.levels]))
    field, spacing = surface.levels[level], surface.spacing_m * 2.0**level
    east, north, up = (float(part) for part in sun.direction)
    along_x = abs(east) > abs(north)
    main, side = (east, north) if along_x else (north, east)
    if main == 0.0:
        return NO_SHADOW
    drop, slip = spacing * up / abs(main), side / abs(main)
    rows = columns = np.arange(len(field))
    reach = int(min(np.ceil((height_range_m[1] - height_range_m[0]) / drop) + 1, len(field)))
    if shown_m is not None:
        # a walk towards the sun, and the shadows that fall on its end
        walk = 2.2 * reach + _SPARE
        away = spacing * walk * np.array([np.sign(main), slip] if along_x else [slip, np.sign(main)])
        x, y = (
            _posts(np.array(shown_m[2 * axis : 2 * axis + 2]), float(away[axis]), spacing, len(field))
            for axis in range(2)
        )
        count = max(x[1], y[1])
        if count < len(field):
            rows, columns = (_wrapped(first, count) & (len(field) - 1) for first in (y[0], x[0]))
    height = heights_in_rows(field, rows, columns, along_x)
    swept, casters = sweep_shadow(height, float(np.sign(main)), drop, slip, reach)
    row_m, across = spacing / abs(main), float(np.hypot(east, north))
    return GroundShadow(swept, casters, along_x, spacing, level, row_m, across, height_range_m[1])


def _posts(shown_m: Float64[np.ndarray, "2"], away_m: float, spacing_m: float, most: int) -> tuple[int, int]:
    """First post of what is needed along an axis, and how many posts a grid must have: a power of two."""
    low, high = shown_m + np.array([min(away_m, 0.0), max(away_m, 0.0)])
    first, last = int(np.floor(low / spacing_m)) - _SPARE, int(np.ceil(high / spacing_m)) + _SPARE
    return first, min(1 << (last - first).bit_length(), most)


def _wrapped(first: int, count: int) -> Int64[np.ndarray, "count"]:
    """The posts from the first on in the order of a grid that repeats after `count`: post k at place k modulo that."""
    return first + ((np.arange(count) - first) & (count - 1))


def ground_in_cones(cones: Sequence[Cone], lowest_m: float) -> Bounds | None:
    """Bounds in x and y of what lies in any of some cones, nowhere lower than `lowest_m`.

    None where one of them reaches over the horizon, so that there are no bounds.
    """
    turns = np.linspace(0.0, 2.0 * np.pi, _RIM, endpoint=False)
    places = []
    for tip, axis, half_angle_rad in cones:
        across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
        across /= np.linalg.norm(across)
        beside = np.cos(turns)[:, None] * across + np.sin(turns)[:, None] * np.cross(axis, across)
        rim = np.cos(half_angle_rad) * axis + np.sin(half_angle_rad) * beside
        if half_angle_rad >= 0.5 * np.pi or np.any(rim[:, 2] >= -1e-6):
            return None
        ends = tip + ((lowest_m - tip[2]) / rim[:, 2])[:, None] * rim
        places.append(np.vstack([tip, ends])[:, :2])
    hull = np.concatenate(places)
    low, high = hull.min(axis=0), hull.max(axis=0)
    wider = _WIDER * (high - low)
    (west, south), (east, north) = low - wider, high + wider
    return float(west), float(east), float(south), float(north)
