"""Points of the target's rock: picked where it is seen, on the triangles that are drawn."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64, Int64

#: Lines of sight with which a rock's outline is found, across and up.
_OUTLINE = 96
#: A point is hidden where something lies this far before it, metres: more than rounding, less than any relief.
_CLOSER_M = 1e-3
#: Rays along a side of the patch whose normal is wanted.
_ACROSS_PATCH = 5


def sight_axes(ahead: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Forward, right and up, rows of unit length, of a line of sight that is not vertical."""
    forward = ahead / np.linalg.norm(ahead)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([forward, right, np.cross(right, forward)])


def distances(
    triangles: Float64[np.ndarray, "triangles 3 3"],
    origin: Float64[np.ndarray, "3"],
    directions: Float64[np.ndarray, "rays 3"],
) -> Float64[np.ndarray, "rays"]:
    """Distance along rays from one place to the nearest triangle, infinite where none is met."""
    return first_met(triangles, origin, directions)[0]


def first_met(
    triangles: Float64[np.ndarray, "triangles 3 3"],
    origin: Float64[np.ndarray, "3"],
    directions: Float64[np.ndarray, "rays 3"],
) -> tuple[Float64[np.ndarray, "rays"], Int64[np.ndarray, "rays"]]:
    """Distance to the triangle that each ray meets first, and its number: infinite and -1 where none is met.

    Moeller & Trumbore's intersection.
    """
    corner = triangles[:, 0]
    first, second = triangles[:, 1] - corner, triangles[:, 2] - corner
    beside = origin - corner
    turned = np.cross(beside, first)
    along = np.sum(second * turned, axis=1)
    nearest = np.full(len(directions), np.inf)
    numbers = np.full(len(directions), -1, dtype=np.int64)
    for number, direction in enumerate(directions):
        across = np.cross(direction, second)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1.0 / np.sum(first * across, axis=1)
            u = scale * np.sum(beside * across, axis=1)
            v = scale * (turned @ direction)
            t = scale * along
        met = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0)
        if met.any():
            numbers[number] = np.argmin(np.where(met, t, np.inf))
            nearest[number] = t[numbers[number]]
    return nearest, numbers


def about_line(
    triangles: Float64[np.ndarray, "triangles 3 3"],
    eye: Float64[np.ndarray, "3"],
    point: Float64[np.ndarray, "3"],
    reach_rad: float,
) -> Float64[np.ndarray, "near 3 3"]:
    """The triangles that lines of sight from a place can meet within an angle of the line to a point, and some more."""
    ahead = (point - eye) / np.linalg.norm(point - eye)
    middles = triangles.mean(axis=1) - eye
    along = middles @ ahead
    aside = np.linalg.norm(middles - along[:, None] * ahead, axis=1)
    size = np.linalg.norm(triangles[:, 1:] - triangles[:, :1], axis=2).max(axis=1)
    near: Float64[np.ndarray, "near 3 3"] = triangles[aside <= np.tan(reach_rad) * np.maximum(along, 0.0) + size]
    return near


def facing(
    triangles: Float64[np.ndarray, "triangles 3 3"],
    eye: Float64[np.ndarray, "3"],
    point: Float64[np.ndarray, "3"],
    reach_rad: float,
) -> Float64[np.ndarray, "3"]:
    """Unit normal, towards a place, of the surface that is seen from it about a point: mean of a square of rays.

    `reach_rad`: Half of the square's side, as an angle. Rays that pass the rock do not count.
    """
    axes = sight_axes(point - eye)
    steps = np.tan(reach_rad) * np.linspace(-1.0, 1.0, _ACROSS_PATCH)
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    rays = axes[0] + offsets @ axes[1:]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    near = about_line(triangles, eye, point, np.sqrt(2.0) * reach_rad)
    _, met = first_met(near, eye, rays)
    corners = near[met[met >= 0]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= -np.sign(normals @ axes[0])[:, None]
    mean = normals.sum(axis=0)
    normal: Float64[np.ndarray, "3"] = mean / np.linalg.norm(mean)
    return normal


@dataclass(frozen=True)
class Sight:
    """A rock seen from a place: directions as tangents across (to the right) and up about the line to its middle."""

    triangles: Float64[np.ndarray, "triangles 3 3"]  #: The rock, world axes, metres
    eye: Float64[np.ndarray, "3"]  #: World place that it is seen from
    axes: Float64[np.ndarray, "3 3"]  #: Rows: forward, right and up of the view, world axes
    #: Rows of lines of sight, from the rock's foot up, with the tangents across at its left and right outline
    seen: Float64[np.ndarray, "rows 3"]

    @classmethod
    def of(
        cls, triangles: Float64[np.ndarray, "triangles 3 3"], eye: Float64[np.ndarray, "3"], ground_m: float
    ) -> Sight:
        """The rock above a height as it is seen from a place."""
        above = triangles.reshape(-1, 3)
        above = above[above[:, 2] > ground_m]
        axes = sight_axes(0.5 * (above.min(axis=0) + above.max(axis=0)) - eye)
        view = (above - eye) @ axes.T
        across, up = view[:, 1] / view[:, 0], view[:, 2] / view[:, 0]
        rows = []
        edges = np.linspace(up.min(), up.max(), _OUTLINE + 1)
        for low, high in pairwise(edges):
            inside = across[(up >= low) & (up <= high)]
            if inside.size:
                rows.append((0.5 * (low + high), inside.min(), inside.max()))
        return cls(triangles, eye, axes, np.array(rows))

    def point(self, across: float, up: float) -> Float64[np.ndarray, "3"]:
        """The surface point seen at a place of the rock's face, world axes, metres.

        `across`: From the left (-1) to the right (1) outline.
        `up`: From the foot (0) to the top (1).
        Raises ValueError where the line of sight meets no triangle: at the outline itself.
        """
        heights, left, right = self.seen.T
        tangent_up = heights[0] + up * (heights[-1] - heights[0])
        low, high = np.interp(tangent_up, heights, left), np.interp(tangent_up, heights, right)
        tangent_across = 0.5 * (low + high) + 0.5 * across * (high - low)
        direction = np.array([1.0, tangent_across, tangent_up]) @ self.axes
        direction /= np.linalg.norm(direction)
        distance = distances(self.triangles, self.eye, direction[None])[0]
        if not np.isfinite(distance):
            raise ValueError(f"at across {across:g}, up {up:g} nothing of the target's rock is seen")
        point: Float64[np.ndarray, "3"] = self.eye + distance * direction
        return point


def hidden(
    triangles: Float64[np.ndarray, "triangles 3 3"],
    points: Float64[np.ndarray, "points 3"],
    eye: Float64[np.ndarray, "3"],
) -> Bool[np.ndarray, "points"]:
    """Which points of a rock the rock itself hides from a place."""
    away = points - eye
    reach = np.linalg.norm(away, axis=1)
    blocked: Bool[np.ndarray, "points"] = distances(triangles, eye, away / reach[:, None]) < reach - _CLOSER_M
    return blocked


def shaded(
    triangles: Float64[np.ndarray, "triangles 3 3"],
    points: Float64[np.ndarray, "points 3"],
    towards_sun: Float64[np.ndarray, "3"],
) -> Bool[np.ndarray, "points"]:
    """Which points of a rock lie in its own shadow."""
    starts = points + 2.0 * _CLOSER_M * towards_sun
    return np.array([np.isfinite(distances(triangles, start, towards_sun[None])[0]) for start in starts], dtype=bool)
