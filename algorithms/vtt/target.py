"""Where the target is: as it was designated, and after the rover has moved (sections 3 and 4.1, action 1)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform

from marsyard.sim.frames import SITE_FROM_WORLD, composed
from marsyard.sim.measurements import RoverTarget, SiteTarget


def designated_position_world(
    target: RoverTarget | SiteTarget, world_from_rover: RigidTransform
) -> Float[np.ndarray, "3"]:
    """A target that was given by its position, in the world frame; `world_from_rover` is the pose at designation."""
    if isinstance(target, RoverTarget):
        return np.asarray(world_from_rover.apply(target.position_rover.copy()))
    return np.asarray(SITE_FROM_WORLD.inv().apply(target.position_site.copy()))


def pose_change(old_world_from_frame: RigidTransform, new_world_from_frame: RigidTransform) -> RigidTransform:
    """The transform from the frame as it lay into the frame as it lies."""
    return composed(new_world_from_frame.inv(), old_world_from_frame)


def predicted_position(
    position: Float[np.ndarray, "3"], old_world_from_frame: RigidTransform, new_world_from_frame: RigidTransform
) -> Float[np.ndarray, "3"]:
    """A point fixed in the world, in a frame that moved (the rover's, or the mast head's), from where it was there."""
    return np.asarray(pose_change(old_world_from_frame, new_world_from_frame).apply(position.copy()))


def bearing_rad(direction_world: Float[np.ndarray, "3"]) -> float:
    """Azimuth of a direction, clockwise from north, radians in (-pi, pi]."""
    return float(np.arctan2(direction_world[0], direction_world[1]))
