"""Cameras put where vehicles carry them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera.base import CameraModel


def looking_down(camera: CameraModel) -> CameraModel:
    """A camera put at the origin and turned so that A is -z and the columns grow along +x.

    Raises
    ------
    ValueError
        If the picture is a mirror image, which no rotation brings there.
    """
    if not camera.right_handed:
        raise ValueError("the camera's picture is mirrored: u right, v down and A forward must be right-handed")
    axis = camera.a / np.linalg.norm(camera.a)
    right = camera.right - (camera.right @ axis) * axis
    right /= np.linalg.norm(right)
    turn = Rotation.from_matrix(np.stack([right, np.cross(right, axis), -axis]))
    return camera.moved(RigidTransform.from_components(-turn.apply(camera.c.copy()), turn))
