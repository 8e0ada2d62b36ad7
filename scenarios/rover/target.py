"""The designated point: chosen on the target's rock where it is seen from the start, and designated to the rover."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.vtt import VttOptions
from marsyard.algorithms.vtt.pointing import mast_angles
from marsyard.algorithms.vtt.stereo import triangulated
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.points import Sight, about_line, distances, facing, hidden, shaded, sight_axes
from marsyard.scenarios.rover.rig import Rig
from marsyard.scenarios.rover.world import RunWorld
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics.rover import Stance
from marsyard.sim.frames import SITE_FROM_WORLD
from marsyard.sim.measurements import PixelTarget, RoverTarget, SiteTarget, TargetDesignation

#: Directions about a point's own in which the rock, or what lies just behind it, must be seen too, lest the point is on
#: an occluding edge.
_AROUND = 12
#: Background further behind the point than this, as a share of its distance, moves against the rock from step to step:
#: the paper's "large discontinuities at occluding boundaries" (5.2). The ground about a small rock, which its template
#: reaches over, is nearer: 3 % behind a 7 cm rock at 4 m, 8 % behind a 12 cm rock at 10 m.
BEHIND_SHARE = 0.1


@dataclass(frozen=True)
class ChosenTarget:
    """The point that is driven to."""

    point_world: Float64[np.ndarray, "3"]  #: The designated point of the rock's surface, world, metres
    designation: TargetDesignation  #: How it is designated to the rover
    #: Whether the template about it, as either camera sees it from the start, shows what lies well behind the rock
    on_edge: bool
    lit: bool  #: Whether the sun shines on it at the start: no part of the rock is before the sun


@dataclass(frozen=True)
class Sightings:
    """How a point of the rock shows itself along a run.

    A patch narrows with the cosine of its obliquity: a turn of 10 deg takes a sixth of its width about 45 deg, and a
    third about 65 deg, which a template that is only scaled and rolled does not follow.
    """

    in_view: bool  #: Whether both cameras see it at every stop, its template never on an occluding edge
    #: Between the left camera's line of sight and the normal of the surface that the first template shows, at the first
    #: stop and at most; 0 is face-on
    obliquity_start_deg: float
    obliquity_max_deg: float


def choose_target(p: RoverScenarioParameters, world: RunWorld, rig: Rig, stance: Stance) -> ChosenTarget:
    """The point at the place of the rock's face that the parameters ask for.

    The operators pick it in a picture taken from where the rover stands, with the mast as it then stands; the rover's
    first pictures are taken from there without moving the mast.
    """
    number = world.target_number
    middle = world.rocks.position_m[number] + np.array([0.0, 0.0, 0.5 * world.rocks.height_m[number]])
    angles = mast_angles(np.asarray(stance.world_from_rover.inv().apply(middle)), rig.calibrated, p.vtt.aim_pair)
    if angles is None:
        raise ValueError("the mast cannot point at the target's rock from the start; start.target_azimuth_deg turns it")
    rig.point(*angles)
    world_from_head = stance.world_from_rover * rig.rover_from_head
    point, on_edge, lit = point_on(world, rig.eyes(world_from_head), p.target.across, p.target.up, rig.pixel_rad, p.vtt)
    designation = _designate(p, rig, stance.world_from_rover, world_from_head, point)
    return ChosenTarget(point, designation, on_edge, lit)


def point_on(
    world: RunWorld,
    eyes: Sequence[Float64[np.ndarray, "3"]],
    across: float,
    up: float,
    pixel_rad: float,
    options: VttOptions,
    picked_from: Float64[np.ndarray, "3"] | None = None,
) -> tuple[Float64[np.ndarray, "3"], bool, bool]:
    """A point of the rock's face as the first eye sees it; whether it is on the rock's edge for any, and whether lit.

    Eyes are those of the pair: point stereo needs the point off the edge in the right picture too. `across` and `up`
    may be meant as seen from somewhere else.
    """
    foot = float(world.rocks.position_m[world.target_number, 2])
    point = Sight.of(world.target_triangles, eyes[0] if picked_from is None else picked_from, foot).point(across, up)
    reach = 0.5 * options.template_px * pixel_rad
    on_edge = any(_on_edge(world.target_triangles, foot, eye, point, reach) for eye in eyes)
    return point, on_edge, not bool(shaded(world.target_triangles, point[None], world.sun.direction(0.0))[0])


def sightings(
    world: RunWorld,
    point: Float64[np.ndarray, "3"],
    eyes: Sequence[tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]],
    pixel_rad: float,
    options: VttOptions,
) -> Sightings:
    """How a point of the rock shows itself to the pairs of cameras at these places, world, metres."""
    reach = 0.5 * options.template_px * pixel_rad
    normal = facing(world.target_triangles, eyes[0][0], point, reach)
    towards = np.array([left - point for left, _ in eyes])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    obliquity_deg = np.degrees(np.arccos(np.clip(towards @ normal, -1.0, 1.0)))
    clear = all(_clear(world, eye, point, reach) for pair in eyes for eye in pair)
    return Sightings(clear, float(obliquity_deg[0]), float(obliquity_deg.max()))


def _clear(world: RunWorld, eye: Float64[np.ndarray, "3"], point: Float64[np.ndarray, "3"], reach_rad: float) -> bool:
    """Whether a point is seen from a place with its template off any occluding edge."""
    near = about_line(world.target_triangles, eye, point, reach_rad)
    if hidden(near, point[None], eye)[0]:
        return False
    return not _on_edge(near, float(world.rocks.position_m[world.target_number, 2]), eye, point, reach_rad)


def choose_by_pixel(
    world: RunWorld,
    rig: Rig,
    world_from_head: RigidTransform,
    angles_rad: tuple[float, float],
    place: tuple[float, float],
    options: VttOptions,
    picked_from: Float64[np.ndarray, "3"],
) -> ChosenTarget:
    """The point at a place (across, up) of the rock's face as seen from a position, designated by its true pixel."""
    eyes = rig.eyes(world_from_head)
    point, on_edge, lit = point_on(world, eyes, *place, rig.pixel_rad, options, picked_from)
    return ChosenTarget(point, designate_by_pixel(rig.left, world_from_head, point, angles_rad), on_edge, lit)


def designate_by_pixel(
    left: CameraModel,
    world_from_head: RigidTransform,
    point: Float64[np.ndarray, "3"],
    angles_rad: tuple[float, float],
) -> PixelTarget:
    """The designation by the point's true pixel in a picture of the left camera as it is."""
    pixel = left.project(np.asarray(world_from_head.inv().apply(point.copy())))[0]
    return PixelTarget(np.asarray(pixel), *angles_rad)


def _on_edge(
    triangles: Float64[np.ndarray, "triangles 3 3"],
    foot_m: float,
    eye: Float64[np.ndarray, "3"],
    point: Float64[np.ndarray, "3"],
    reach_rad: float,
) -> bool:
    """Whether some line of sight within an angle of the point passes the rock and meets the ground only well behind."""
    distance = float(np.linalg.norm(point - eye))
    ahead, right, up = sight_axes(point - eye)
    turns = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
    around = ahead + reach_rad * (np.cos(turns)[:, None] * right + np.sin(turns)[:, None] * up)
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    # the ground about the rock is taken as level with its foot
    falls = np.maximum(-around[:, 2], 1e-9)
    seen = np.minimum(distances(triangles, eye, around), (eye[2] - foot_m) / falls)
    return bool(np.any(seen > (1.0 + BEHIND_SHARE) * distance))


def _designate(
    p: RoverScenarioParameters,
    rig: Rig,
    world_from_rover: RigidTransform,
    world_from_head: RigidTransform,
    point: Float64[np.ndarray, "3"],
) -> TargetDesignation:
    """The designation: the point's true pixel, or what the ground makes of the pair of pixels by triangulation."""
    angles, known = rig.state.readings_rad, rig.calibrated
    if p.target.designation == "pixel":
        return designate_by_pixel(rig.left, world_from_head, point, angles)
    in_head = np.asarray(world_from_head.inv().apply(point.copy()))
    left, right = (np.asarray(camera.project(in_head)[0]) for camera in (rig.left, rig.right))
    position = triangulated(known.left, known.right, left, right)
    if position is None:
        raise ValueError("the target cannot be triangulated from the start")
    in_rover = np.asarray(known.geometry.rover_from_head(*angles).apply(position))
    if p.target.designation == "rover":
        return RoverTarget(in_rover)
    return SiteTarget(np.asarray(SITE_FROM_WORLD.apply(world_from_rover.apply(in_rover))))
