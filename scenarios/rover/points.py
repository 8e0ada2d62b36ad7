"""Ray casting on the target's rock: points on the visible face, occlusion, shadows of the rock and of the rover."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64

from marsyard.sim.dynamics.rover import RoverParameters, Stance
from marsyard.sim.measurements import MastGeometry
from marsyard.sim.render import Objects, may_cast_shadow
from marsyard.sim.render.rover import rover_objects, rover_sphere
from marsyard.sim.render.triangles import first_hits

Vector = Float64[np.ndarray, "3"]
Triangles = Float64[np.ndarray, "triangles 3 3"]
Rays = Float64[np.ndarray, "rays 3"]
Points = Float64[np.ndarray, "points 3"]

#: Number of rows that sample a rock's outline.
_OUTLINE_ROWS = 96
#: A point is occluded if a surface is at least this far in front of it, m: more than rounding errors, less than relief.
_MIN_GAP_M = 1e-3
#: Number of rays along a side of the patch whose normals are averaged.
_PATCH_RAYS = 5
#: Sample points of a template: number of directions around its centre, and radii in units of half its side.
_RING_POINTS, _RING_RADII = 8, (0.5, 1.0)


def sight_axes(line: Vector) -> Float64[np.ndarray, "3 3"]:
    """Compute forward, right and up unit vectors (rows) of a line of sight that is not vertical."""
    forward = line / np.linalg.norm(line)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([forward, right, np.cross(right, forward)])


def ray_distances(triangles: Triangles, origin: Vector, directions: Rays) -> Float64[np.ndarray, "rays"]:
    """Compute the distance along rays from one origin to the nearest triangle; infinite without an intersection."""
    return np.asarray(first_hits(triangles, origin[None], directions)[0])


def are_hidden(triangles: Triangles, points: Points, direction: Vector) -> Bool[np.ndarray, "points"]:
    """Return for each point whether a ray in a direction, such as that of the sun, hits a triangle."""
    return np.asarray(np.isfinite(first_hits(triangles, points, direction[None])[0]))


def enclosing_spheres(triangles: Triangles) -> Float64[np.ndarray, "triangles 4"]:
    """Return spheres that contain the triangles: centre (three columns) and radius.

    The centre is the centroid, the radius the longer of the two edges from the first corner.
    """
    edges = np.linalg.norm(triangles[:, 1:] - triangles[:, :1], axis=2)
    return np.column_stack([triangles.mean(axis=1), edges.max(axis=1)])


def spheres_near_line(
    spheres: Float64[np.ndarray, "spheres 4"], viewpoint: Vector, point: Vector, half_angle_rad: float
) -> Bool[np.ndarray, "spheres"]:
    """Select all spheres that rays within an angle of the line of sight can hit, and possibly some more."""
    axis = (point - viewpoint) / np.linalg.norm(point - viewpoint)
    centres, radii = spheres[:, :3] - viewpoint, spheres[:, 3]
    depths = centres @ axis
    offsets = np.linalg.norm(centres - depths[:, None] * axis, axis=1)
    return np.asarray(offsets <= np.tan(half_angle_rad) * np.maximum(depths, 0.0) + radii)


def patch_normal(triangles: Triangles, viewpoint: Vector, point: Vector, half_angle_rad: float) -> Vector:
    """Compute the mean unit normal, towards a viewpoint, of the surface around a point over a square grid of rays.

    `half_angle_rad` is half the side of the square. Rays that miss the rock are ignored.
    """
    axes = sight_axes(point - viewpoint)
    steps = np.tan(half_angle_rad) * np.linspace(-1.0, 1.0, _PATCH_RAYS)
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    rays = axes[0] + offsets @ axes[1:]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    spheres = enclosing_spheres(triangles)
    candidates = triangles[spheres_near_line(spheres, viewpoint, point, np.sqrt(2.0) * half_angle_rad)]
    _, indices = first_hits(candidates, viewpoint[None], rays)
    corners = candidates[indices[indices >= 0]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= -np.sign(normals @ axes[0])[:, None]
    mean = normals.sum(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


@dataclass(frozen=True)
class RockOutline:
    """Outline of a rock seen from a viewpoint: tangents of angles to the right of and above the line to its centre."""

    triangles: Triangles
    viewpoint: Vector
    axes: Float64[np.ndarray, "3 3"]  #: rows: forward, right and up of the view, world axes
    rows: Float64[np.ndarray, "rows 3"]  #: columns: vertical tangent, from the foot up; tangents left and right

    @classmethod
    def from_triangles(cls, triangles: Triangles, viewpoint: Vector, ground_m: float) -> RockOutline:
        """Compute the outline of the part of the rock above the height `ground_m`."""
        corners = triangles.reshape(-1, 3)
        corners = corners[corners[:, 2] > ground_m]
        axes = sight_axes(0.5 * (corners.min(axis=0) + corners.max(axis=0)) - viewpoint)
        forward_m, right_m, up_m = ((corners - viewpoint) @ axes.T).T
        across, up = right_m / forward_m, up_m / forward_m
        rows = []
        for low, high in pairwise(np.linspace(up.min(), up.max(), _OUTLINE_ROWS + 1)):
            row_tangents = across[(up >= low) & (up <= high)]
            if row_tangents.size:
                rows.append((0.5 * (low + high), row_tangents.min(), row_tangents.max()))
        return cls(triangles, viewpoint, axes, np.array(rows))

    def point(self, across: float, up: float) -> Vector:
        """Compute the surface point at `across` from left (-1) to right (1), and at `up` from foot (0) to top (1).

        Raises ValueError if the line of sight hits no triangle, for example exactly on the outline.
        """
        heights, left, right = self.rows.T
        tangent_up = heights[0] + up * (heights[-1] - heights[0])
        low, high = np.interp(tangent_up, heights, left), np.interp(tangent_up, heights, right)
        tangent_across = 0.5 * (low + high) + 0.5 * across * (high - low)
        direction = np.array([1.0, tangent_across, tangent_up]) @ self.axes
        direction /= np.linalg.norm(direction)
        distance = ray_distances(self.triangles, self.viewpoint, direction[None])[0]
        if not np.isfinite(distance):
            raise ValueError(f"the line of sight at across {across:g}, up {up:g} misses the target's rock")
        return np.asarray(self.viewpoint + distance * direction)


def find_self_occlusion(triangles: Triangles, points: Points, viewpoint: Vector) -> Bool[np.ndarray, "points"]:
    """Return for each point of a rock whether the rock occludes it, seen from a viewpoint."""
    offsets = points - viewpoint
    distance = np.linalg.norm(offsets, axis=1)
    return np.asarray(ray_distances(triangles, viewpoint, offsets / distance[:, None]) < distance - _MIN_GAP_M)


def find_self_shadow(triangles: Triangles, points: Points, sun_direction: Vector) -> Bool[np.ndarray, "points"]:
    """Return for each point of a rock whether the rock shadows it."""
    # an offset towards the sun avoids intersections with a point's own triangle
    return are_hidden(triangles, points + 2.0 * _MIN_GAP_M * sun_direction, sun_direction)


def sample_template(viewpoint: Vector, point: Vector, half_angle_rad: float) -> Points:
    """Create sample points of a template: a point, and rings around it perpendicular to the line of sight.

    `half_angle_rad` is half the template's angular size, seen from the viewpoint.
    """
    _, right, up = sight_axes(point - viewpoint)
    angles = np.linspace(0.0, 2.0 * np.pi, _RING_POINTS, endpoint=False)
    radius_m = float(np.tan(half_angle_rad) * np.linalg.norm(point - viewpoint))
    ring = radius_m * (np.cos(angles)[:, None] * right + np.sin(angles)[:, None] * up)
    return np.vstack([point, *(point + fraction * ring for fraction in _RING_RADII)])


def build_shadow_caster(
    rover: RoverParameters,
    stance: Stance,
    mast: MastGeometry,
    angles_rad: tuple[float, float],
    centre_m: Vector,
    radius_m: float,
    sun_direction: Vector,
) -> Objects | None:
    """Build the rover's mesh, with its mast at these angles, if its shadow may fall on a sphere, else return None."""
    # the mesh is built only if the rover's bounding sphere may cast a shadow on the sphere
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
    """Return whether the rover, with its mast at these angles, shadows a point of a patch; world axes."""
    centre = patch_m.mean(axis=0)
    radius = float(np.linalg.norm(patch_m - centre, axis=1).max())
    body = build_shadow_caster(rover, stance, mast, angles_rad, centre, radius, sun_direction)
    return body is not None and bool(are_hidden(body.triangles, patch_m, sun_direction).any())
