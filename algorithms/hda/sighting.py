"""What the stages start from: the measurements in the cameras' frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.hda.view import View, camera_pose, view
from marsyard.sim.measurements import LandingMeasurements


@dataclass(frozen=True)
class Sighting:
    """Two views and what was measured with the first.

    Attributes
    ----------
    views
        The first and the second picture.
    range_m
        Depth of the ground on the first camera's optical axis, metres; NaN if unknown.
    up_camera
        Unit vector upwards by the inclinometers, in the first camera's frame.
    apriori_site_world
        Where to land if nothing better is known.
    """

    views: tuple[View, View]
    range_m: float
    up_camera: Float[np.ndarray, "3"]
    apriori_site_world: Float[np.ndarray, "3"]

    @property
    def second_from_first(self) -> RigidTransform:
        """The camera's motion by the on-board poses."""
        return self.views[1].world_from_camera.inv() * self.views[0].world_from_camera


def sighting(measurements: LandingMeasurements) -> Sighting:
    """The measurements in the cameras' frames.

    Raises
    ------
    ValueError
        If a picture's size is not its camera's.
    """
    first, second = (view(image, pose) for image, pose in zip(measurements.images, measurements.poses, strict=True))
    body_from_camera = camera_pose(measurements.images[0].camera)
    up_camera = body_from_camera.rotation.inv().apply(np.array(measurements.up_body))
    return Sighting((first, second), measurements.slant_range_m, up_camera, measurements.apriori_site_world)
