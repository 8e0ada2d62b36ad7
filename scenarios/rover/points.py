"""Ray casting on the target's rock: picking points on its visible face, occlusion and shadow, the rover's included."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.vtt import VttOptions
from marsyard.algorithms.vtt.pointing import mast_angles
from marsyard.algorithms.vtt.stereo import triangulated
from marsyard.scenarios.rover import points
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.world import Rig, RunWorld
from marsyard.sim.dynamics import RoverParameters, Stance
from marsyard.sim.frames import SITE_FROM_WORLD
from marsyard.sim.measurements import MastGeometry, PixelTarget, RoverTarget, SiteTarget, TargetDesignation
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


#: Directions about a point in which the rock, or ground just behind it, must be visible: else it is on an edge.
_RING_DIRECTIONS = 12
#: Background further behind the point than this fraction of its distance moves against the rock from step to step:
#: the paper's "large discontinuities at occluding boundaries" (5.2). The ground about a small rock, which its template
#: reaches over, is nearer: 3 % behind a 7 cm rock at 4 m, 8 % behind a 12 cm rock at 10 m.
BEHIND_FRACTION = 0.1


@dataclass(frozen=True)
class DesignatedTarget:
    """The designated point of the rock's surface."""

    point_world: Vector
    designation: TargetDesignation
    on_edge: bool  #: whether its template in either first picture shows background well behind the rock
    lit: bool  #: whether the sun shines on it at the start


@dataclass(frozen=True)
class Visibility:
    """Visibility of a point of the rock along a run.

    A patch narrows with the cosine of its obliquity: a turn of 10 deg takes a sixth of its width about 45 deg, and a
    third about 65 deg, which a template that is only scaled and rolled does not follow. Obliquity is the angle between
    the left camera's line of sight and the normal of the surface in the first template; 0 is face-on.
    """

    in_view: bool  #: whether both cameras see it at every stop, its template never on an occluding edge
    obliquity_start_deg: float
    obliquity_max_deg: float


def choose_target(p: RoverScenarioParameters, world: RunWorld, rig: Rig, stance: Stance) -> DesignatedTarget:
    """Choose the point at the parameters' position on the rock's face, as operators pick it from the start.

    It is designated by its true pixel, or by the position that operators triangulate from the pair of pixels. The
    rover's first pictures are taken from there without moving the mast.
    """
    number = world.target_number
    middle = world.rocks.position_m[number] + np.array([0.0, 0.0, 0.5 * world.rocks.height_m[number]])
    angles = mast_angles(np.asarray(stance.world_from_rover.inv().apply(middle)), rig.calibrated, p.vtt.aim_pair)
    if angles is None:
        raise ValueError("the mast cannot point at the target's rock from the start; start.target_azimuth_deg turns it")
    rig.point(*angles)
    head, readings, calibrated = stance.world_from_rover * rig.rover_from_head, rig.state.readings_rad, rig.calibrated
    target = pick_target(world, rig, head, readings, (p.target.across, p.target.up), p.vtt)
    if p.target.designation == "pixel":
        return target
    in_head = np.asarray(head.inv().apply(target.point_world.copy()))
    left, right = (np.asarray(camera.project(in_head)[0]) for camera in (rig.left, rig.right))
    position = triangulated(calibrated.left, calibrated.right, left, right)
    if position is None:
        raise ValueError("the target cannot be triangulated from the start")
    in_rover = np.asarray(calibrated.geometry.rover_from_head(*readings).apply(position))
    if p.target.designation == "rover":
        return replace(target, designation=RoverTarget(in_rover))
    in_site = np.asarray(SITE_FROM_WORLD.apply(stance.world_from_rover.apply(in_rover)))
    return replace(target, designation=SiteTarget(in_site))


def pick_target(
    world: RunWorld,
    rig: Rig,
    world_from_head: RigidTransform,
    angles_rad: tuple[float, float],
    position: tuple[float, float],
    options: VttOptions,
    picked_from: Vector | None = None,
) -> DesignatedTarget:
    """Pick a point of the rock's face, designated by its true pixel in the left picture.

    `position` is (across, up) as seen from `picked_from`, by default the left camera. The point is on the edge if it is
    on the edge for either camera: point stereo needs it off the edge in the right picture too.
    """
    eyes, triangles = rig.eyes(world_from_head), world.target_triangles
    foot = float(world.rocks.position_m[world.target_number, 2])
    point = points.RockOutline.of(triangles, eyes[0] if picked_from is None else picked_from, foot).point(*position)
    half_rad = 0.5 * options.template_px * rig.pixel_rad
    on_edge = any(_is_on_edge(triangles, foot, eye, point, half_rad) for eye in eyes)
    lit = not bool(points.self_shadowed(triangles, point[None], world.sun.direction(0.0))[0])
    pixel = rig.left.project(np.asarray(world_from_head.inv().apply(point.copy())))[0]
    return DesignatedTarget(point, PixelTarget(np.asarray(pixel), *angles_rad), on_edge, lit)


def evaluate_visibility(
    world: RunWorld, rig: Rig, point: Vector, heads: Sequence[RigidTransform], options: VttOptions
) -> Visibility:
    """Evaluate the visibility of a point of the rock from true poses of the head, world axes."""
    half_rad, triangles = 0.5 * options.template_px * rig.pixel_rad, world.target_triangles
    eyes = [rig.eyes(head) for head in heads]
    normal = points.patch_normal(triangles, eyes[0][0], point, half_rad)
    towards = np.array([left - point for left, _ in eyes])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    obliquity_deg = np.degrees(np.arccos(np.clip(towards @ normal, -1.0, 1.0)))
    foot = float(world.rocks.position_m[world.target_number, 2])

    def is_clear(eye: Vector) -> bool:
        near = points.triangles_near_line(triangles, eye, point, half_rad)
        return not points.self_occluded(near, point[None], eye)[0] and not _is_on_edge(near, foot, eye, point, half_rad)

    in_view = all(is_clear(eye) for pair in eyes for eye in pair)
    return Visibility(in_view, float(obliquity_deg[0]), float(obliquity_deg.max()))


def _is_on_edge(triangles: Triangles, foot_m: float, eye: Vector, point: Vector, half_rad: float) -> bool:
    """Whether some line of sight within an angle of the point misses the rock and meets the ground well behind."""
    distance = float(np.linalg.norm(point - eye))
    ahead, right, up = points.sight_axes(point - eye)
    angles = np.linspace(0.0, 2.0 * np.pi, _RING_DIRECTIONS, endpoint=False)
    ring = ahead + half_rad * (np.cos(angles)[:, None] * right + np.sin(angles)[:, None] * up)
    ring /= np.linalg.norm(ring, axis=1, keepdims=True)
    # the ground about the rock is taken as level with its foot
    falls = np.maximum(-ring[:, 2], 1e-9)
    seen = np.minimum(points.ray_distances(triangles, eye, ring), (eye[2] - foot_m) / falls)
    return bool(np.any(seen > (1.0 + BEHIND_FRACTION) * distance))
