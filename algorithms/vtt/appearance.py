"""How the target's picture changes from one stop to the next: magnification and roll (section 4.3.1)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform

from sim.camera import CameraModel


def magnification(
    old_position: Float[np.ndarray, "3"],
    old_centre: Float[np.ndarray, "3"],
    new_position: Float[np.ndarray, "3"],
    new_centre: Float[np.ndarray, "3"],
) -> float:
    """Scale factor, Eq. 6: the target's old distance from the camera's centre over its new one.

    Positions and centres are each in the rover frame of their own stop.
    """
    return float(np.linalg.norm(old_position - old_centre) / np.linalg.norm(new_position - new_centre))


def horizontal_axis(camera: CameraModel) -> Float[np.ndarray, "3"]:
    """Unit vector Hx along the picture's x axis, Eqs. 7 to 9; A and H need not be perpendicular."""
    hs = np.linalg.norm(np.cross(camera.a, camera.h))
    hc = camera.a @ camera.h
    return np.asarray((camera.h - hc * camera.a) / hs)


def roll_angle(
    old_position: Float[np.ndarray, "3"],
    old_camera: CameraModel,
    new_camera: CameraModel,
    new_from_old: RigidTransform,
    lever_m: float,
) -> float | None:
    """How far the target's picture turned, clockwise as seen, radians: Eq. 10 and the text after it.

    The target and a point beside it along the old picture's x axis, `lever_m` away, are projected by the new camera.
    The angle of what was horizontal is the roll. The old camera is in the old rover frame, the new one in the new;
    None where the new camera sees one of the points not at all.
    """
    points = np.stack([old_position, old_position + lever_m * horizontal_axis(old_camera)])
    pixels, visible = new_camera.project(np.asarray(new_from_old.apply(points)))
    if not np.all(visible):
        return None
    across, down = pixels[1] - pixels[0]
    return float(np.arctan2(down, across))
