"""The designated point: picked on the target's rock as seen from the start, and designated to the rover."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.vtt import VttOptions
from marsyard.algorithms.vtt.pointing import mast_angles
from marsyard.algorithms.vtt.stereo import triangulated
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.points import (
    RockOutline,
    Triangles,
    Vector,
    patch_normal,
    ray_distances,
    self_occluded,
    self_shadowed,
    sight_axes,
    triangles_near_line,
)
from marsyard.scenarios.rover.vehicle import Rig
from marsyard.scenarios.rover.world import RunWorld
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics.rover import Stance
from marsyard.sim.frames import SITE_FROM_WORLD
from marsyard.sim.measurements import PixelTarget, RoverTarget, SiteTarget, TargetDesignation

#: Directions about a point in which the rock, or ground just behind it, must be visible: else it is on an edge.
_RING_DIRECTIONS = 12
#: Background further behind the point than this fraction of its distance moves against the rock from step to step:
#: the paper's "large discontinuities at occluding boundaries" (5.2). The ground about a small rock, which its template
#: reaches over, is nearer: 3 % behind a 7 cm rock at 4 m, 8 % behind a 12 cm rock at 10 m.
BEHIND_FRACTION = 0.1


@dataclass(frozen=True)
class ChosenTarget:
    """The designated point of the rock's surface."""

    point_world: Vector
    designation: TargetDesignation
    on_edge: bool  #: whether its template in either first picture shows background well behind the rock
    lit: bool  #: whether the sun shines on it at the start


@dataclass(frozen=True)
class Sightings:
    """Visibility of a point of the rock along a run.

    A patch narrows with the cosine of its obliquity: a turn of 10 deg takes a sixth of its width about 45 deg, and a
    third about 65 deg, which a template that is only scaled and rolled does not follow. Obliquity is the angle between
    the left camera's line of sight and the normal of the surface in the first template; 0 is face-on.
    """

    in_view: bool  #: whether both cameras see it at every stop, its template never on an occluding edge
    obliquity_start_deg: float
    obliquity_max_deg: float


def choose_target(p: RoverScenarioParameters, world: RunWorld, rig: Rig, stance: Stance) -> ChosenTarget:
    """The point at the parameters' position on the rock's face, as operators pick it in a picture from the start.

    The rover's first pictures are taken from there without moving the mast.
    """
    number = world.target_number
    middle = world.rocks.position_m[number] + np.array([0.0, 0.0, 0.5 * world.rocks.height_m[number]])
    angles = mast_angles(np.asarray(stance.world_from_rover.inv().apply(middle)), rig.calibrated, p.vtt.aim_pair)
    if angles is None:
        raise ValueError("the mast cannot point at the target's rock from the start; start.target_azimuth_deg turns it")
    rig.point(*angles)
    world_from_head = stance.world_from_rover * rig.rover_from_head
    point, on_edge, lit = pick_point(
        world, rig.eyes(world_from_head), (p.target.across, p.target.up), rig.pixel_rad, p.vtt
    )
    designation = _designate(p, rig, stance.world_from_rover, world_from_head, point)
    return ChosenTarget(point, designation, on_edge, lit)


def pick_point(
    world: RunWorld,
    eyes: Sequence[Vector],
    position: tuple[float, float],
    pixel_rad: float,
    options: VttOptions,
    picked_from: Vector | None = None,
) -> tuple[Vector, bool, bool]:
    """A point of the rock's face; whether it is on the rock's edge for any eye, and whether it is lit.

    `eyes`: those of the pair: point stereo needs the point off the edge in the right picture too. `position` is
    (across, up) as seen from `picked_from`, by default the first eye.
    """
    foot = float(world.rocks.position_m[world.target_number, 2])
    seen_from = eyes[0] if picked_from is None else picked_from
    point = RockOutline.of(world.target_triangles, seen_from, foot).point(*position)
    half_rad = 0.5 * options.template_px * pixel_rad
    on_edge = any(_is_on_edge(world.target_triangles, foot, eye, point, half_rad) for eye in eyes)
    return point, on_edge, not bool(self_shadowed(world.target_triangles, point[None], world.sun.direction(0.0))[0])


def sightings(
    world: RunWorld, point: Vector, eyes: Sequence[tuple[Vector, Vector]], pixel_rad: float, options: VttOptions
) -> Sightings:
    """Visibility of a point of the rock from pairs of camera positions, world axes."""
    half_rad = 0.5 * options.template_px * pixel_rad
    normal = patch_normal(world.target_triangles, eyes[0][0], point, half_rad)
    towards = np.array([left - point for left, _ in eyes])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    obliquity_deg = np.degrees(np.arccos(np.clip(towards @ normal, -1.0, 1.0)))
    clear = all(_is_clear(world, eye, point, half_rad) for pair in eyes for eye in pair)
    return Sightings(clear, float(obliquity_deg[0]), float(obliquity_deg.max()))


def _is_clear(world: RunWorld, eye: Vector, point: Vector, half_rad: float) -> bool:
    """Whether a point is visible from an eye with its template off any occluding edge."""
    near = triangles_near_line(world.target_triangles, eye, point, half_rad)
    foot = float(world.rocks.position_m[world.target_number, 2])
    return not self_occluded(near, point[None], eye)[0] and not _is_on_edge(near, foot, eye, point, half_rad)


def choose_by_pixel(
    world: RunWorld,
    rig: Rig,
    world_from_head: RigidTransform,
    angles_rad: tuple[float, float],
    position: tuple[float, float],
    options: VttOptions,
    picked_from: Vector,
) -> ChosenTarget:
    """The point at a position (across, up) of the rock's face seen from `picked_from`, designated by its true pixel."""
    eyes = rig.eyes(world_from_head)
    point, on_edge, lit = pick_point(world, eyes, position, rig.pixel_rad, options, picked_from)
    return ChosenTarget(point, _designate_by_pixel(rig.left, world_from_head, point, angles_rad), on_edge, lit)


def _is_on_edge(triangles: Triangles, foot_m: float, eye: Vector, point: Vector, half_rad: float) -> bool:
    """Whether some line of sight within an angle of the point misses the rock and meets the ground well behind."""
    distance = float(np.linalg.norm(point - eye))
    ahead, right, up = sight_axes(point - eye)
    turns = np.linspace(0.0, 2.0 * np.pi, _RING_DIRECTIONS, endpoint=False)
    ring = ahead + half_rad * (np.cos(turns)[:, None] * right + np.sin(turns)[:, None] * up)
    ring /= np.linalg.norm(ring, axis=1, keepdims=True)
    # the ground about the rock is taken as level with its foot
    falls = np.maximum(-ring[:, 2], 1e-9)
    seen = np.minimum(ray_distances(triangles, eye, ring), (eye[2] - foot_m) / falls)
    return bool(np.any(seen > (1.0 + BEHIND_FRACTION) * distance))


def _designate_by_pixel(
    left: CameraModel, world_from_head: RigidTransform, point: Vector, angles_rad: tuple[float, float]
) -> PixelTarget:
    """The designation by the point's true pixel in a picture of the true left camera."""
    pixel = left.project(np.asarray(world_from_head.inv().apply(point.copy())))[0]
    return PixelTarget(np.asarray(pixel), *angles_rad)


def _designate(
    p: RoverScenarioParameters,
    rig: Rig,
    world_from_rover: RigidTransform,
    world_from_head: RigidTransform,
    point: Vector,
) -> TargetDesignation:
    """The designation: the point's true pixel, or the position that operators triangulate from the pair of pixels."""
    angles, calibrated = rig.state.readings_rad, rig.calibrated
    if p.target.designation == "pixel":
        return _designate_by_pixel(rig.left, world_from_head, point, angles)
    in_head = np.asarray(world_from_head.inv().apply(point.copy()))
    left, right = (np.asarray(camera.project(in_head)[0]) for camera in (rig.left, rig.right))
    position = triangulated(calibrated.left, calibrated.right, left, right)
    if position is None:
        raise ValueError("the target cannot be triangulated from the start")
    in_rover = np.asarray(calibrated.geometry.rover_from_head(*angles).apply(position))
    if p.target.designation == "rover":
        return RoverTarget(in_rover)
    return SiteTarget(np.asarray(SITE_FROM_WORLD.apply(world_from_rover.apply(in_rover))))
