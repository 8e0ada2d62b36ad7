"""Prediction of the target's position, magnification and roll in the next image (sections 4.1, 4.3.1).

Sections and equations are those of Kim et al., "Targeted Driving Using Visual Tracking".
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.arrays import Vector3
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import SITE_FROM_WORLD, compose
from marsyard.sim.measurements import RoverTarget, SiteTarget


@dataclass(frozen=True)
class ViewChange:
    """Change of the target's image since the last match: magnification (Eq. 6), and clockwise roll (Eq. 10)."""

    magnification: float = 1.0
    roll_rad: float = 0.0


def designated_position_world(target: RoverTarget | SiteTarget, world_from_rover: RigidTransform) -> Vector3:
    """Convert a target designated by position to world coordinates; `world_from_rover` is the pose at designation."""
    if isinstance(target, RoverTarget):
        return np.asarray(world_from_rover.apply(target.position_rover.copy()))
    return np.asarray(SITE_FROM_WORLD.inv().apply(target.position_site.copy()))


def pose_change(old_world_from_frame: RigidTransform, new_world_from_frame: RigidTransform) -> RigidTransform:
    """Transform from a moving frame at its old pose to the same frame at its new pose."""
    return compose(new_world_from_frame.inv(), old_world_from_frame)


def predicted_position(
    position: Vector3, old_world_from_frame: RigidTransform, new_world_from_frame: RigidTransform
) -> Vector3:
    """Predict the position of a static point in a moving frame (rover or mast head) from its old position."""
    return np.asarray(pose_change(old_world_from_frame, new_world_from_frame).apply(position.copy()))


def bearing_rad(direction_world: Vector3) -> float:
    """Azimuth of a direction, clockwise from north, radians in (-pi, pi]."""
    return float(np.arctan2(direction_world[0], direction_world[1]))


def magnification(old_position: Vector3, old_centre: Vector3, new_position: Vector3, new_centre: Vector3) -> float:
    """Scale factor, Eq. 6: the target's old distance from the camera divided by the new one.

    Each position and camera centre is in the rover frame of its stop.
    """
    return float(np.linalg.norm(old_position - old_centre) / np.linalg.norm(new_position - new_centre))


def horizontal_axis(camera: CameraModel) -> Vector3:
    """Unit vector Hx along the image's x axis, Eqs. 7 to 9; A and H of the camera model may not be perpendicular."""
    # horizontal focal length and image centre of the CAHV model, pixels
    h_s = np.linalg.norm(np.cross(camera.a, camera.h))
    h_c = camera.a @ camera.h
    return np.asarray((camera.h - h_c * camera.a) / h_s)


def roll_points(
    old_position: Vector3,
    old_camera: CameraModel,
    new_camera: CameraModel,
    new_from_old: RigidTransform,
    offset_m: float,
) -> Float[np.ndarray, "2 2"] | None:
    """Project the target and an auxiliary point to pixels (u, v) of the new image; their direction defines the roll.

    The auxiliary point has a distance of `offset_m` (k in the paper, before Eq. 10) from the target along the old
    image's x axis. Each camera is in the frame of its stop. None if the new camera cannot image one of the points.
    """
    points = np.stack([old_position, old_position + offset_m * horizontal_axis(old_camera)])
    pixels, visible = new_camera.project(np.asarray(new_from_old.apply(points)))
    return pixels if np.all(visible) else None


def roll_angle(reference_px: Float[np.ndarray, "2 2"]) -> float:
    """Clockwise roll of the target's image, radians, from the pixels of `roll_points` (Eq. 10 and following text)."""
    delta_u, delta_v = reference_px[1] - reference_px[0]
    return float(np.arctan2(delta_v, delta_u))
