"""Prediction of the target's position (sections 3 and 4.1, action 1), magnification and roll (section 4.3.1)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform

from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import SITE_FROM_WORLD, compose
from marsyard.sim.measurements import RoverTarget, SiteTarget


def designated_position_world(
    target: RoverTarget | SiteTarget, world_from_rover: RigidTransform
) -> Float[np.ndarray, "3"]:
    """World position of a target designated by position; `world_from_rover` is the pose at designation."""
    if isinstance(target, RoverTarget):
        return np.asarray(world_from_rover.apply(target.position_rover.copy()))
    return np.asarray(SITE_FROM_WORLD.inv().apply(target.position_site.copy()))


def pose_change(old_world_from_frame: RigidTransform, new_world_from_frame: RigidTransform) -> RigidTransform:
    """The transform from the old frame into the new frame."""
    return compose(new_world_from_frame.inv(), old_world_from_frame)


def predicted_position(
    position: Float[np.ndarray, "3"], old_world_from_frame: RigidTransform, new_world_from_frame: RigidTransform
) -> Float[np.ndarray, "3"]:
    """Position of a static point in a frame that moved (rover or mast head), from its old position there."""
    return np.asarray(pose_change(old_world_from_frame, new_world_from_frame).apply(position.copy()))


def bearing_rad(direction_world: Float[np.ndarray, "3"]) -> float:
    """Azimuth of a direction, clockwise from north, radians in (-pi, pi]."""
    return float(np.arctan2(direction_world[0], direction_world[1]))


def magnification(
    old_position: Float[np.ndarray, "3"],
    old_centre: Float[np.ndarray, "3"],
    new_position: Float[np.ndarray, "3"],
    new_centre: Float[np.ndarray, "3"],
) -> float:
    """Scale factor, Eq. 6: the target's old distance from the camera over its new one.

    Positions and camera centres are each in the rover frame of their own stop.
    """
    return float(np.linalg.norm(old_position - old_centre) / np.linalg.norm(new_position - new_centre))


def horizontal_axis(camera: CameraModel) -> Float[np.ndarray, "3"]:
    """Unit vector Hx along the image's x axis, Eqs. 7 to 9; A and H need not be perpendicular."""
    hs = np.linalg.norm(np.cross(camera.a, camera.h))
    hc = camera.a @ camera.h
    return np.asarray((camera.h - hc * camera.a) / hs)


def lever_pixels(
    old_position: Float[np.ndarray, "3"],
    old_camera: CameraModel,
    new_camera: CameraModel,
    new_from_old: RigidTransform,
    lever_m: float,
) -> Float[np.ndarray, "2 2"] | None:
    """Pixels (u, v) in the new image of the target and of a point `lever_m` along the old image's x axis (before Eq.
    10).

    Each camera is in the frame of its own stop. None if the new camera cannot image one of the points.
    """
    points = np.stack([old_position, old_position + lever_m * horizontal_axis(old_camera)])
    pixels, visible = new_camera.project(np.asarray(new_from_old.apply(points)))
    return pixels if np.all(visible) else None


def roll_angle(lever_px: Float[np.ndarray, "2 2"]) -> float:
    """Clockwise roll of the target's image, radians, from `lever_pixels`: Eq. 10 and the text after it."""
    across, down = lever_px[1] - lever_px[0]
    return float(np.arctan2(down, across))
