"""The designated point: picked on the target's rock as seen from the start, and designated to the rover."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.vtt import VttOptions
from marsyard.algorithms.vtt.pointing import mast_angles
from marsyard.algorithms.vtt.stereo import triangulated
from marsyard.scenarios.rover import points
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.points import Triangles, Vector
from marsyard.scenarios.rover.world import Rig, RunWorld
from marsyard.sim.dynamics import Stance
from marsyard.sim.frames import SITE_FROM_WORLD
from marsyard.sim.measurements import PixelTarget, RoverTarget, SiteTarget, TargetDesignation

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
