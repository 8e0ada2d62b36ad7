"""Ray casting on the target's rock: picking points on its visible face, occlusion and shadow, the rover's included."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64, Int64

from marsyard.sim.dynamics import RoverParameters, Stance
from marsyard.sim.measurements import MastGeometry
from marsyard.sim.render import Objects, may_cast_shadow, rover_objects, rover_sphere

Vector = Float64[np.ndarray, "3"]
Triangles = Float64[np.ndarray, "triangles 3 3"]
Rays = Float64[np.ndarray, "rays 3"]
Points = Float64[np.ndarray, "points 3"]

#: Rows of lines of sight that sample a rock's outline.
_OUTLINE_ROWS = 96
#: A point is hidden where something lies this far before it, metres: more than rounding, less than any relief.
_CLOSER_M = 1e-3
#: Rays along a side of the patch whose normal is averaged.
_PATCH_RAYS = 5
#: Directions about a point in which its template is sampled for shadow, and radii as fractions of its half side.
_RING_POINTS, _RING_RADII = 8, (0.5, 1.0)


def sight_axes(ahead: Vector) -> Float64[np.ndarray, "3 3"]:
    """Forward, right and up, rows of unit length, of a line of sight that is not vertical."""
    forward = ahead / np.linalg.norm(ahead)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([forward, right, np.cross(right, forward)])


def intersect_rays(
    triangles: Triangles, origin: Vector, directions: Rays
) -> tuple[Float64[np.ndarray, "rays"], Int64[np.ndarray, "rays"]]:
    """Distance to the first triangle on each ray, and its number: infinite and -1 without an intersection.

    Moeller & Trumbore's intersection.
    """
    corner = triangles[:, 0]
    edge_1, edge_2 = triangles[:, 1] - corner, triangles[:, 2] - corner
    from_corner = origin - corner
    q = np.cross(from_corner, edge_1)
    along = np.sum(edge_2 * q, axis=1)
    nearest = np.full(len(directions), np.inf)
    numbers = np.full(len(directions), -1, dtype=np.int64)
    for number, direction in enumerate(directions):
        across = np.cross(direction, edge_2)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1.0 / np.sum(edge_1 * across, axis=1)
            u = scale * np.sum(from_corner * across, axis=1)
            v = scale * (q @ direction)
            t = scale * along
        met = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0)
        if met.any():
            numbers[number] = np.argmin(np.where(met, t, np.inf))
            nearest[number] = t[numbers[number]]
    return nearest, numbers


def ray_distances(triangles: Triangles, origin: Vector, directions: Rays) -> Float64[np.ndarray, "rays"]:
    """Distance along rays from one origin to the nearest triangle, infinite without one."""
    return intersect_rays(triangles, origin, directions)[0]


def triangles_near_line(triangles: Triangles, eye: Vector, point: Vector, half_angle_rad: float) -> Triangles:
    """The triangles that rays from an eye can meet within an angle of the line to a point, and some more."""
    ahead = (point - eye) / np.linalg.norm(point - eye)
    middles = triangles.mean(axis=1) - eye
    along = middles @ ahead
    aside = np.linalg.norm(middles - along[:, None] * ahead, axis=1)
    size = np.linalg.norm(triangles[:, 1:] - triangles[:, :1], axis=2).max(axis=1)
    return np.asarray(triangles[aside <= np.tan(half_angle_rad) * np.maximum(along, 0.0) + size])


def patch_normal(triangles: Triangles, eye: Vector, point: Vector, half_angle_rad: float) -> Vector:
    """Unit normal, towards an eye, of the surface about a point: mean over a square grid of rays.

    `half_angle_rad` is half of the square's side. Rays that miss the rock do not count.
    """
    axes = sight_axes(point - eye)
    steps = np.tan(half_angle_rad) * np.linspace(-1.0, 1.0, _PATCH_RAYS)
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    rays = axes[0] + offsets @ axes[1:]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    near = triangles_near_line(triangles, eye, point, np.sqrt(2.0) * half_angle_rad)
    _, met = intersect_rays(near, eye, rays)
    corners = near[met[met >= 0]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= -np.sign(normals @ axes[0])[:, None]
    mean = normals.sum(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


@dataclass(frozen=True)
class RockOutline:
    """Outline of a rock from one eye, as tangents across (to the right) and up about the line to its middle."""

    triangles: Triangles
    eye: Vector
    axes: Float64[np.ndarray, "3 3"]  #: rows: forward, right and up of the view, world axes
    rows: Float64[np.ndarray, "rows 3"]  #: tangent up, from the foot, and tangents across at the left and right outline

    @classmethod
    def of(cls, triangles: Triangles, eye: Vector, ground_m: float) -> RockOutline:
        """The outline of the part above a height."""
        above = triangles.reshape(-1, 3)
        above = above[above[:, 2] > ground_m]
        axes = sight_axes(0.5 * (above.min(axis=0) + above.max(axis=0)) - eye)
        view = (above - eye) @ axes.T
        across, up = view[:, 1] / view[:, 0], view[:, 2] / view[:, 0]
        rows = []
        for low, high in pairwise(np.linspace(up.min(), up.max(), _OUTLINE_ROWS + 1)):
            inside = across[(up >= low) & (up <= high)]
            if inside.size:
                rows.append((0.5 * (low + high), inside.min(), inside.max()))
        return cls(triangles, eye, axes, np.array(rows))

    def point(self, across: float, up: float) -> Vector:
        """The surface point from the left (-1) to the right (1) outline, and from the foot (0) to the top (1).

        Raises ValueError where the line of sight meets no triangle: at the outline itself.
        """
        heights, left, right = self.rows.T
        tangent_up = heights[0] + up * (heights[-1] - heights[0])
        low, high = np.interp(tangent_up, heights, left), np.interp(tangent_up, heights, right)
        tangent_across = 0.5 * (low + high) + 0.5 * across * (high - low)
        direction = np.array([1.0, tangent_across, tangent_up]) @ self.axes
        direction /= np.linalg.norm(direction)
        distance = ray_distances(self.triangles, self.eye, direction[None])[0]
        if not np.isfinite(distance):
            raise ValueError(f"at across {across:g}, up {up:g} nothing of the target's rock is seen")
        return np.asarray(self.eye + distance * direction)


def self_occluded(triangles: Triangles, points: Points, eye: Vector) -> Bool[np.ndarray, "points"]:
    """Which points of a rock the rock itself hides from an eye."""
    away = points - eye
    distance = np.linalg.norm(away, axis=1)
    return np.asarray(ray_distances(triangles, eye, away / distance[:, None]) < distance - _CLOSER_M)


def self_shadowed(triangles: Triangles, points: Points, sun_direction: Vector) -> Bool[np.ndarray, "points"]:
    """Which points of a rock lie in its own shadow."""
    starts = points + 2.0 * _CLOSER_M * sun_direction
    return np.array([np.isfinite(ray_distances(triangles, one, sun_direction[None])[0]) for one in starts], dtype=bool)


def template_patch(eye: Vector, point: Vector, half_angle_rad: float) -> Points:
    """A point, and points on rings about it up to an angle as seen from an eye, across the line of sight."""
    _, right, up = sight_axes(point - eye)
    turns = np.linspace(0.0, 2.0 * np.pi, _RING_POINTS, endpoint=False)
    radius_m = float(np.tan(half_angle_rad) * np.linalg.norm(point - eye))
    ring = radius_m * (np.cos(turns)[:, None] * right + np.sin(turns)[:, None] * up)
    return np.vstack([point, *(point + fraction * ring for fraction in _RING_RADII)])


def cast_rover_shadow(
    rover: RoverParameters,
    stance: Stance,
    mast: MastGeometry,
    angles_rad: tuple[float, float],
    centre_m: Vector,
    radius_m: float,
    sun_direction: Vector,
) -> Objects | None:
    """The rover's mesh, its mast at these angles, if its shadow may fall into a sphere, world axes; else None."""
    # the mesh is built only where its bounding sphere may cast a shadow there
    if not may_cast_shadow(rover_sphere(rover, stance, mast), sun_direction, centre_m, radius_m):
        return None
    body = rover_objects(rover, stance, mast, *angles_rad)
    return body if may_cast_shadow(body.spheres, sun_direction, centre_m, radius_m) else None


def rover_shades_patch(
    rover: RoverParameters,
    stance: Stance,
    mast: MastGeometry,
    angles_rad: tuple[float, float],
    patch_m: Points,
    sun_direction: Vector,
) -> bool:
    """Whether the rover, its mast at these angles, shades any point of a patch, world axes."""
    middle = patch_m.mean(axis=0)
    radius = float(np.linalg.norm(patch_m - middle, axis=1).max())
    body = cast_rover_shadow(rover, stance, mast, angles_rad, middle, radius, sun_direction)
    if body is None:
        return False
    return any(np.isfinite(ray_distances(body.triangles, point, sun_direction[None])[0]) for point in patch_m)
