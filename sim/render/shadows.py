"""Shadows: the ground's own, swept over its grid, and bounds of the shadows of objects."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.ndimage import binary_dilation

from marsyard.sim.render.kernels.casters import Casters, list_casters
from marsyard.sim.render.kernels.ground import max_rises
from marsyard.sim.render.kernels.structs import Bounds, Footprint, GroundShadow
from marsyard.sim.render.kernels.sun import heights_in_rows, sweep_shadow
from marsyard.sim.render.objects import Objects, spheres_in_cone
from marsyard.sim.render.photometry import Sun
from marsyard.sim.terrain import Surface

#: A cone: apex, unit vector along its axis, and half angle in radians.
Cone = tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"], float]
#: Centre and radius of a sphere about each body, metres.
Spheres = Float64[np.ndarray, "bodies 4"]
#: Largest number of cells along a side of a footprint.
MAX_CELLS = 512
#: The footprint of objects that may shade any position.
EVERYWHERE = Footprint(np.ones((1, 1), dtype=np.bool_), 0.0, 0.0, 0.0)
#: Largest number of posts along a side of the grid on which the ground's shadow is swept.
SHADOW_SIDE = 4096
#: The shadow of ground that casts none.
NO_SHADOW = GroundShadow(
    np.full((1, 1), -np.inf, dtype=np.float32), np.zeros((1, 1), dtype=np.uint8), False, 1.0, 0, 1.0, 1.0, 0.0
)
#: Directions along a cone's rim whose hull bounds the ground in it, and the fraction by which the hull is widened.
_RIM, _MARGIN = 64, 0.01
#: Additional posts: those for interpolation, and a row or two for rounding.
_SPARE = 4


def shadow_footprint(spheres: Spheres, sun: Float64[np.ndarray, "3"], lowest_m: float) -> Footprint:
    """Mark the cells of a grid where a body may hide the sun from ground that is nowhere lower than `lowest_m`.

    The shadow of a sphere lies along the sun's azimuth between the point below its centre and the point where the ray
    past its top reaches the lowest ground.
    """
    if len(spheres) == 0 or sun[2] <= 0.0:
        return EVERYWHERE
    starts = spheres[:, :2]
    falls = np.maximum(spheres[:, 2] + spheres[:, 3] - lowest_m, 0.0) / sun[2]
    ends = starts - falls[:, None] * sun[:2]
    low, high = np.minimum(starts, ends).min(axis=0), np.maximum(starts, ends).max(axis=0)
    # a body and half a step lie within a cell to each side
    cell = float(max((high - low).max() / MAX_CELLS, 2.0 * spheres[:, 3].max(), 1e-3))
    steps = int(np.ceil(2.0 * float(np.linalg.norm(ends - starts, axis=1).max()) / cell)) + 2
    along = np.linspace(0.0, 1.0, steps)[:, None, None]
    positions = (starts + along * (ends - starts)).reshape(-1, 2)
    corner = low - 2.0 * cell
    columns, rows = (np.floor((high - corner) / cell).astype(int) + 3).tolist()
    cells = np.zeros((rows, columns), dtype=np.bool_)
    column, row = np.floor((positions - corner) / cell).astype(int).T
    cells[row, column] = True
    cells = binary_dilation(cells, np.ones((3, 3), dtype=np.bool_))
    return Footprint(cells, float(corner[0]), float(corner[1]), 1.0 / cell)


def casters_towards(objects: Objects, sun: Sun) -> Casters:
    """List the triangles of objects by their position across the rays to the sun."""
    towards = np.asarray(sun.direction, dtype=np.float64)
    across = np.cross(towards, np.eye(3)[int(np.argmin(np.abs(towards)))])
    across /= np.linalg.norm(across)
    # the kernel's rays run exactly along the sun's direction, as the third axis
    axes = np.stack([across, np.cross(towards, across), towards])
    casters: Casters = list_casters(objects.triangles, objects.first_triangle, axes)
    return casters


def potentially_visible(
    spheres: Spheres, sun: Float64[np.ndarray, "3"], lowest_m: float, cone: Cone
) -> Bool[np.ndarray, "bodies"]:
    """Select the bodies that a picture within a cone may show, or show the shadows of.

    A body's shadow lies within its radius of a line from its centre away from the sun, which ends where all of it is
    below the lowest ground. A sphere about that line and the body is tested against the cone. There are no shadows
    where the sun is not above the horizon.
    """
    tops = np.maximum(spheres[:, 2] + spheres[:, 3] - lowest_m, 0.0)
    half = 0.5 * tops / sun[2] if sun[2] > 0.0 else np.zeros(len(spheres))
    about = np.column_stack([spheres[:, :3] - half[:, None] * sun, spheres[:, 3] + half])
    return spheres_in_cone(about, *cone)


def slope_bounds(surface: Surface, sun: Sun) -> tuple[float, float]:
    """Bounds of the ground's slope along x and y; infinite where ground may be steep enough to hide part of the sun."""
    east, north, _ = np.abs(sun.direction)
    rises = max_rises(surface.levels[0], _lowest_ray(sun) * surface.spacing_m, float(east), float(north))
    return rises[0] / surface.spacing_m, rises[1] / surface.spacing_m


def sun_over_slopes(sun: Sun, max_slopes: tuple[float, float]) -> bool:
    """Whether ground of at most these slopes along x and y leaves the sun's whole disc visible everywhere.

    No line between two of its points then rises as steeply as the rays to the disc's lower edge.
    """
    east, north, _ = np.abs(sun.direction)
    return bool(max_slopes[0] * east + max_slopes[1] * north < _lowest_ray(sun))


def _lowest_ray(sun: Sun) -> float:
    """Rise of rays to the lower edge of the sun's disc over the horizontal length of those to its centre."""
    across = float(np.hypot(sun.direction[0], sun.direction[1]))
    elevation = np.arctan2(sun.direction[2], across) - sun.angular_radius_rad
    return across * float(np.tan(max(elevation, 0.0)))


def ground_shadow(
    surface: Surface, sun: Sun, height_range_m: tuple[float, float], shown_m: Bounds | None = None
) -> GroundShadow:
    """Sweep the ground's shadow along the axis nearest to the azimuth of the sun, which is above the horizon.

    `shown_m` bounds x, then y, of the positions whose shadow is needed, and from which paths towards the sun start;
    None for everywhere. The shadow's grid is that of a level of the surface; where it covers a part of the ground only
    it repeats after fewer posts.
    """
    level = int(np.argmax([one.shape[0] <= SHADOW_SIDE for one in surface.levels]))
    field, spacing = surface.levels[level], surface.spacing_m * 2.0**level
    east, north, up = (float(part) for part in sun.direction)
    along_x = abs(east) > abs(north)
    main, side = (east, north) if along_x else (north, east)
    if main == 0.0:
        return NO_SHADOW
    drop, shift = spacing * up / abs(main), side / abs(main)
    rows = columns = np.arange(len(field))
    reach = int(min(np.ceil((height_range_m[1] - height_range_m[0]) / drop) + 1, len(field)))
    if shown_m is not None:
        # a path towards the sun, and the shadows that fall on its end
        path = 2.2 * reach + _SPARE
        away = spacing * path * np.array([np.sign(main), shift] if along_x else [shift, np.sign(main)])
        x, y = (
            _posts(np.array(shown_m[2 * axis : 2 * axis + 2]), float(away[axis]), spacing, len(field))
            for axis in range(2)
        )
        count = max(x[1], y[1])
        if count < len(field):
            rows, columns = (_periodic_posts(first, count) & (len(field) - 1) for first in (y[0], x[0]))
    height = heights_in_rows(field, rows, columns, along_x)
    swept, casters = sweep_shadow(height, float(np.sign(main)), drop, shift, reach)
    row_m, across = spacing / abs(main), float(np.hypot(east, north))
    return GroundShadow(swept, casters, along_x, spacing, level, row_m, across, height_range_m[1])


def _posts(shown_m: Float64[np.ndarray, "2"], away_m: float, spacing_m: float, max_count: int) -> tuple[int, int]:
    """First post that is needed along an axis, and the number of posts of the grid: a power of two."""
    low, high = shown_m + np.array([min(away_m, 0.0), max(away_m, 0.0)])
    first, last = int(np.floor(low / spacing_m)) - _SPARE, int(np.ceil(high / spacing_m)) + _SPARE
    return first, min(1 << (last - first).bit_length(), max_count)


def _periodic_posts(first: int, count: int) -> Int64[np.ndarray, "count"]:
    """Posts from the first on in the order of a grid that repeats after `count`: post k is entry k modulo that."""
    return first + ((np.arange(count) - first) & (count - 1))


def ground_in_cones(cones: Sequence[Cone], lowest_m: float) -> Bounds | None:
    """Bounds in x and y of all points in any of the cones that are not below `lowest_m`; None if they are unbounded."""
    azimuths = np.linspace(0.0, 2.0 * np.pi, _RIM, endpoint=False)
    points = []
    for apex, axis, half_angle_rad in cones:
        across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
        across /= np.linalg.norm(across)
        perpendicular = np.cos(azimuths)[:, None] * across + np.sin(azimuths)[:, None] * np.cross(axis, across)
        rim = np.cos(half_angle_rad) * axis + np.sin(half_angle_rad) * perpendicular
        if half_angle_rad >= 0.5 * np.pi or np.any(rim[:, 2] >= -1e-6):
            return None
        ends = apex + ((lowest_m - apex[2]) / rim[:, 2])[:, None] * rim
        points.append(np.vstack([apex, ends])[:, :2])
    hull = np.concatenate(points)
    low, high = hull.min(axis=0), hull.max(axis=0)
    margin = _MARGIN * (high - low)
    (west, south), (east, north) = low - margin, high + margin
    return float(west), float(east), float(south), float(north)
