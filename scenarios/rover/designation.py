"""Designation of the target: a point on the rock, selected in the view from the start."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.vtt import VttOptions
from marsyard.algorithms.vtt.pointing import mast_angles
from marsyard.algorithms.vtt.stereo import triangulate
from marsyard.scenarios.rover import points
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.points import Triangles, Vector
from marsyard.scenarios.rover.rig import Rig
from marsyard.scenarios.rover.world import RunWorld
from marsyard.sim.dynamics.rover import Stance
from marsyard.sim.frames import SITE_FROM_WORLD
from marsyard.sim.measurements import PixelTarget, RoverTarget, SiteTarget, TargetDesignation

#: Number of directions around a point. The point is on an edge if one direction shows ground far behind the rock.
_RING_DIRECTIONS = 12
#: Minimum distance of background behind the point, divided by the point's distance, at which the background moves
#: visibly relative to the rock between steps: "large discontinuities at occluding boundaries" (paper, 5.2). The ground
#: in the template of a small rock is nearer: 3 % behind a 7 cm rock at 4 m, 8 % behind a 12 cm rock at 10 m.
BEHIND_FRACTION = 0.1
#: Minimum fraction of direct sunlight that clouds transmit to a lit point (assumed).
MIN_TRANSMITTANCE = 0.5


@dataclass(frozen=True)
class DesignatedTarget:
    """The designated point on the rock's surface."""

    point_world: Vector
    designation: TargetDesignation
    on_edge: bool  #: whether the template in one of the first images shows background far behind the rock
    lit: bool  #: whether the point is in direct sunlight when it is designated, see `is_lit`


def designate_from_start(p: RoverScenarioParameters, world: RunWorld, rig: Rig, stance: Stance) -> DesignatedTarget:
    """Designate the point of the parameters `target.across` and `target.up` in the view from the start.

    The point is designated by its true pixel, or by the position triangulated from its true pixels in both images. The
    mast does not move between this designation and the rover's first images.
    """
    number = world.target_number
    centre = world.rocks.position_m[number] + np.array([0.0, 0.0, 0.5 * world.rocks.height_m[number]])
    angles = mast_angles(np.asarray(stance.world_from_rover.inv().apply(centre)), rig.calibrated, p.vtt.aim_pair)
    if angles is None:
        raise ValueError("the mast cannot point at the target's rock from the start; change start.target_azimuth_deg")
    rig.point(*angles)
    head, readings = stance.world_from_rover * rig.rover_from_head, rig.state.readings_rad
    position, time_s = (p.target.across, p.target.up), p.timing.track_s
    target = designate_point(world, rig, head, readings, position, p.vtt, time_s)
    if p.target.designation == "pixel":
        return target
    in_rover = triangulate_point(rig, stance, target.point_world)
    if p.target.designation == "rover":
        return replace(target, designation=RoverTarget(in_rover))
    in_site = np.asarray(SITE_FROM_WORLD.apply(stance.world_from_rover.apply(in_rover)))
    return replace(target, designation=SiteTarget(in_site))


def triangulate_point(rig: Rig, stance: Stance, point_world: Vector) -> Vector:
    """Triangulate a point from its true pixels in both cameras with the calibrated cameras, rover frame.

    Raises ValueError if the lines of sight have no nearest point.
    """
    head, calibrated = stance.world_from_rover * rig.rover_from_head, rig.calibrated
    in_head = np.asarray(head.inv().apply(point_world.copy()))
    left, right = (np.asarray(camera.project(in_head)[0]) for camera in (rig.left, rig.right))
    position = triangulate(calibrated.left, calibrated.right, left, right)
    if position is None:
        raise ValueError("the target cannot be triangulated from the start")
    return np.asarray(calibrated.geometry.rover_from_head(*rig.state.readings_rad).apply(position))


def designate_point(
    world: RunWorld,
    rig: Rig,
    world_from_head: RigidTransform,
    angles_rad: tuple[float, float],
    position: tuple[float, float],
    options: VttOptions,
    time_s: float,
    outline_viewpoint: Vector | None = None,
) -> DesignatedTarget:
    """Designate a point on the rock's face by its true pixel in the left image.

    `position` selects the point in the view from `outline_viewpoint`, by default the left camera: across the outline,
    from -1 (left) to 1 (right), and up, from 0 (foot) to 1 (top). The point is on an edge if it is on an edge for
    either camera, because stereo matching needs it in both images. `time_s` is the time of these images.
    """
    cameras_m, triangles = rig.camera_positions(world_from_head), world.target_triangles
    foot_m = float(world.rocks.position_m[world.target_number, 2])
    outline_viewpoint = cameras_m[0] if outline_viewpoint is None else outline_viewpoint
    outline = points.RockOutline.from_triangles(triangles, outline_viewpoint, foot_m)
    point = outline.point(*position)
    half_rad = 0.5 * options.template_px * rig.pixel_rad
    on_edge = any(is_on_edge(triangles, foot_m, viewpoint, point, half_rad) for viewpoint in cameras_m)
    pixel = rig.left.project(np.asarray(world_from_head.inv().apply(point.copy())))[0]
    return DesignatedTarget(point, PixelTarget(np.asarray(pixel), *angles_rad), on_edge, is_lit(world, point, time_s))


def is_lit(world: RunWorld, point: Vector, time_s: float) -> bool:
    """Whether the target's rock does not shade its point, and clouds transmit at least half of the direct sunlight."""
    scene = world.scene(time_s)
    if points.find_self_shadow(world.target_triangles, point[None], scene.sun.direction)[0]:
        return False
    if scene.clouds is None:
        return True
    return bool(scene.clouds.transmittance(point[None], scene.sun, time_s)[0] >= MIN_TRANSMITTANCE)


def is_on_edge(triangles: Triangles, foot_m: float, viewpoint: Vector, point: Vector, half_rad: float) -> bool:
    """Return whether a line of sight at the angle `half_rad` from the point misses the rock and hits ground far behind.

    `foot_m` is the height of the rock's foot, world z.
    """
    distance = float(np.linalg.norm(point - viewpoint))
    axis, right, up = points.sight_axes(point - viewpoint)
    angles = np.linspace(0.0, 2.0 * np.pi, _RING_DIRECTIONS, endpoint=False)
    ring = axis + half_rad * (np.cos(angles)[:, None] * right + np.sin(angles)[:, None] * up)
    ring /= np.linalg.norm(ring, axis=1, keepdims=True)
    # the ground around the rock is assumed level with its foot; lines of sight above the horizon end very far away
    descent_rates = np.maximum(-ring[:, 2], 1e-9)
    visible_range_m = np.minimum(
        points.ray_distances(triangles, viewpoint, ring), (viewpoint[2] - foot_m) / descent_rates
    )
    return bool(np.any(visible_range_m > (1.0 + BEHIND_FRACTION) * distance))
