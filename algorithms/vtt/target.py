"""Where the target is: as it was designated, and after the rover has moved (sections 3 and 4.1, action 1)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform

from sim.camera import CameraModel
from sim.frames import SITE_FROM_WORLD
from sim.measurements import MastCalibration, RoverTarget, SiteTarget


def designated_position_world(
    target: RoverTarget | SiteTarget, world_from_rover: RigidTransform
) -> Float[np.ndarray, "3"]:
    """A target that was given by its position, in the world frame; `world_from_rover` is the pose at designation."""
    if isinstance(target, RoverTarget):
        return np.asarray(world_from_rover.apply(target.position_rover.copy()))
    return np.asarray(SITE_FROM_WORLD.inv().apply(target.position_site.copy()))


def pose_change(old_world_from_rover: RigidTransform, new_world_from_rover: RigidTransform) -> RigidTransform:
    """The transform from the old rover frame into the new one."""
    return new_world_from_rover.inv() * old_world_from_rover


def predicted_position(
    position_rover: Float[np.ndarray, "3"],
    old_world_from_rover: RigidTransform,
    new_world_from_rover: RigidTransform,
) -> Float[np.ndarray, "3"]:
    """The target in the rover frame after a move, from where it was and the estimated poses before and after."""
    return np.asarray(pose_change(old_world_from_rover, new_world_from_rover).apply(position_rover.copy()))


def rover_cameras(mast: MastCalibration, azimuth_rad: float, elevation_rad: float) -> tuple[CameraModel, CameraModel]:
    """The left and right camera in the rover frame at these mast angles."""
    rover_from_head = mast.geometry.rover_from_head(azimuth_rad, elevation_rad)
    return mast.left.moved(rover_from_head), mast.right.moved(rover_from_head)


def bearing_rad(direction_world: Float[np.ndarray, "3"]) -> float:
    """Azimuth of a direction, clockwise from north, radians in (-pi, pi]."""
    return float(np.arctan2(direction_world[0], direction_world[1]))
