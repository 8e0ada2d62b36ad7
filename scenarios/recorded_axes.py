"""Axes of recorded poses, and mounting of the camera in the recorded vehicle."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from marsyard.sim.frames import SITE_FROM_WORLD
from marsyard.sim.parameters import Parameters

#: Rotations from a file's world axes to east, north, up.
_ENU_FROM_AXES = {"enu": Rotation.identity(), "ned": SITE_FROM_WORLD.inv()}
#: OpenCV's camera axes (x right, y down, z forward) in body axes: optical axis along -z, columns along x.
_CAMERA_IN_BODY = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
#: Maximum deviation of the mounting quaternion's length from 1, large enough for three digits.
_QUATERNION_TOLERANCE = 1e-3


class RecordedAxes(Parameters):
    """Axes of recorded poses, and mounting of the camera in the recorded vehicle.

    A file contains attitudes of a vehicle: rotations from the vehicle's axes to the axes of its world. The attitude of
    the body, whose camera looks along -z, is the product
    ``enu_from_body = enu_from_axes * axes_from_vehicle * vehicle_from_mounted * mounted_from_body``:

    - enu_from_axes: from the axes of the file's world (key `axes`)
    - axes_from_vehicle: the file's quaternion
    - vehicle_from_mounted: `mounting`, from the camera or the body (key `attitude_of`) to the vehicle. It is the
      identity by default. The file's attitudes are then those of the camera or the body.
    - mounted_from_body: the identity for the body, else from the body to OpenCV's camera axes
    """

    axes: Annotated[Literal["enu", "ned"], Field(description="world axes: east, north, up; or north, east, down")]
    attitude_of: Annotated[
        Literal["camera", "body"],
        Field(description="frame of the attitude: OpenCV camera frame, or body frame (camera looks along -z)"),
    ] = "camera"
    mounting: Annotated[
        tuple[float, float, float, float],
        Field(description="quaternion x, y, z, w from that frame to the frame of the recorded vehicle"),
    ] = (0.0, 0.0, 0.0, 1.0)
    lever_m: Annotated[
        tuple[float, float, float], Field(description="position of the camera in the frame of the recorded vehicle, m")
    ] = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _check_mounting(self) -> RecordedAxes:
        if abs(float(np.linalg.norm(self.mounting)) - 1.0) > _QUATERNION_TOLERANCE:
            raise ValueError(f"mounting {list(self.mounting)} is not a quaternion of length 1")
        return self

    @property
    def enu_from_axes(self) -> Rotation:
        """Rotation from the file's world axes to east, north, up."""
        return _ENU_FROM_AXES[self.axes]

    def body_attitudes(self, world_from_vehicle: Rotation) -> Rotation:
        """Convert attitudes of the recorded vehicle to those of the body, both relative to east, north, up."""
        attitudes = world_from_vehicle * Rotation.from_quat(np.array(self.mounting))
        return attitudes * _CAMERA_IN_BODY.inv() if self.attitude_of == "camera" else attitudes

    def lever_arms(self, world_from_vehicle: Rotation) -> Float64[np.ndarray, "*batch 3"]:
        """Return the offsets from the recorded vehicle to the camera in east, north, up."""
        return np.asarray(world_from_vehicle.apply(np.array(self.lever_m)))
