"""Independent ray casting for checks of the renderer: SciPy's B-splines and bisection, brute force for triangles.

It shares no code with the renderer: heights are from `scipy.ndimage.map_coordinates`, and triangles are intersected by
solving for barycentric coordinates.
"""

import numpy as np
from scipy.ndimage import map_coordinates

from marsyard.sim.render import Objects
from marsyard.sim.terrain import Surface

#: Maximum number of ray points in memory.
BLOCK = 2_000_000


class Ground:
    """Heights of a surface, evaluated by SciPy."""

    def __init__(self, surface: Surface) -> None:
        self._coefficients = surface.levels[0][..., 0].astype(np.float64)
        self._spacing = surface.spacing_m
        self.lowest, self.highest = float(self._coefficients.min()), float(self._coefficients.max())

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Heights at positions, metres."""
        positions = np.stack([np.ravel(y), np.ravel(x)]) / self._spacing
        return map_coordinates(self._coefficients, positions, order=3, mode="grid-wrap", prefilter=False).reshape(
            np.shape(x)
        )

    def gradient(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Slopes by central differences over a hundredth of a sample."""
        delta = 0.01 * self._spacing
        slope_x = (self.height(x + delta, y) - self.height(x - delta, y)) / (2.0 * delta)
        slope_y = (self.height(x, y + delta) - self.height(x, y - delta)) / (2.0 * delta)
        return np.stack([slope_x, slope_y], axis=-1)

    def clearance(self, origins: np.ndarray, directions: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Height above ground of the points at distances `t` along the rays."""
        x, y, z = (origins[:, k] + t * directions[:, k] for k in range(3))
        return z - self.height(x, y)

    def cast(self, origins: np.ndarray, directions: np.ndarray, max_range_m: float, step: float) -> np.ndarray:
        """Distance of each ray to the ground by steps of at most `step` metres and bisection; infinite if none."""
        ranges = np.full(len(directions), np.inf)
        with np.errstate(divide="ignore"):
            above = np.where(directions[:, 2] < 0.0, (self.highest - origins[:, 2]) / directions[:, 2], 0.0)
            below = np.where(directions[:, 2] < 0.0, (self.lowest - origins[:, 2]) / directions[:, 2], np.inf)
        start, stop = np.clip(above, 0.0, max_range_m), np.clip(below, 0.0, max_range_m)
        order = np.argsort(stop - start)
        while order.size:
            longest = float((stop - start)[order].max())
            count = max(int(BLOCK / (longest / step + 2)), 1)
            block, order = order[-count:], order[:-count]
            ranges[block] = self._cast_block(origins[block], directions[block], start[block], stop[block], step)
        return ranges

    def _cast_block(
        self, origins: np.ndarray, directions: np.ndarray, start: np.ndarray, stop: np.ndarray, step: float
    ) -> np.ndarray:
        """Find the first point below ground on each ray between the distances `start` and `stop`, then bisect."""
        steps = int(np.ceil((stop - start).max() / step)) + 2
        t = start[:, None] + (stop - start)[:, None] * np.linspace(0.0, 1.0, steps)
        x, y, z = (origins[:, k, None] + t * directions[:, k, None] for k in range(3))
        is_below = z - self.height(x, y) < 0.0
        first = is_below.argmax(axis=1)
        is_hit = is_below[np.arange(len(t)), first] & (first > 0)
        high = t[np.arange(len(t)), first]
        low = t[np.arange(len(t)), np.maximum(first - 1, 0)]
        for _ in range(45):
            middle = 0.5 * (low + high)
            is_below_ground = self.clearance(origins, directions, middle) < 0.0
            high, low = np.where(is_below_ground, middle, high), np.where(is_below_ground, low, middle)
        return np.where(is_hit, 0.5 * (low + high), np.inf)

    def is_occluded(self, points: np.ndarray, to_light: np.ndarray, step: float) -> np.ndarray:
        """Whether the ground occludes a distant light source in the direction `to_light`, for each point."""
        length = max((self.highest - float(points[:, 2].min())) / max(to_light[2], 1e-3), step)
        t = np.concatenate([[0.05 * step], np.arange(step, length + step, step)])
        is_occluded = np.zeros(len(points), dtype=bool)
        size = max(BLOCK // t.size, 1)
        for first in range(0, len(points), size):
            block = points[first : first + size]
            x, y, z = (block[:, k, None] + t * to_light[k] for k in range(3))
            is_occluded[first : first + size] = (z - self.height(x, y) < 0.0).any(axis=1)
        return is_occluded


def cast_triangles(objects: Objects, origins: np.ndarray, directions: np.ndarray, nearest: float = 0.0) -> np.ndarray:
    """Distance of each ray to the nearest triangle beyond `nearest`; infinite if none."""
    ranges = np.full(len(directions), np.inf)
    for body in range(len(objects)):
        corners = objects.triangles[objects.first_triangle[body] : objects.first_triangle[body + 1]]
        rays = _select_rays(corners, origins, directions)
        if rays.size:
            distance = _intersect_triangles(corners, origins[rays], directions[rays], nearest)
            ranges[rays] = np.minimum(ranges[rays], distance)
    return ranges


def _select_rays(corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Select rays that intersect the bounding sphere of a body."""
    centre = corners.reshape(-1, 3).mean(axis=0)
    radius = np.linalg.norm(corners - centre, axis=-1).max()
    to_centre = centre - origins
    distance = np.sum(to_centre * directions, axis=1)
    return np.flatnonzero((np.sum(to_centre**2, axis=1) - distance**2 <= radius**2) & (distance > -radius))


def _intersect_triangles(
    corners: np.ndarray, origins: np.ndarray, directions: np.ndarray, nearest: float
) -> np.ndarray:
    """Solve ``origin + t direction = a + p (b - a) + q (c - a)`` for each ray and triangle by Cramer's rule."""
    a, b, c = (corners[None, :, k] for k in range(3))
    first, second = b - a, c - a
    normal = np.cross(first, second)
    ranges = np.empty(len(directions))
    size = max(BLOCK // (4 * corners.shape[0]), 1)
    for start in range(0, len(directions), size):
        origin, direction = origins[start : start + size, None], directions[start : start + size, None]
        offset = origin - a
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = -1.0 / np.sum(direction * normal, axis=-1)
            t = np.sum(offset * normal, axis=-1) * scale
            moment = np.cross(offset, direction)
            p = np.sum(second * moment, axis=-1) * scale
            q = -np.sum(first * moment, axis=-1) * scale
            is_hit = (p >= -1e-12) & (q >= -1e-12) & (p + q <= 1.0 + 1e-12) & (t > nearest)
        ranges[start : start + size] = np.where(is_hit, t, np.inf).min(axis=1)
    return ranges
