"""A descent image with the estimated pose of the lander: corrected signal, binning, camera in the world frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float32
from scipy.spatial.transform import Rotation

from marsyard.algorithms.arrays import Vector3
from marsyard.algorithms.image.frame_transfer import remove_frame_transfer
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DetectorImage

#: Lower limit of the flat field before division.
MIN_RESPONSE = 0.02


@dataclass(frozen=True)
class PosedImage:
    """An image and the estimated pose of the body frame at its exposure.

    - radiance: counts above the offset divided by the flat field
    - camera: calibrated camera model, in the body frame
    - position_m: estimated position of the body frame's origin, world frame
    - world_from_body: estimated attitude
    - time_s: time tag of the middle of the exposure
    """

    radiance: Float32[np.ndarray, "rows columns"]
    camera: CameraModel
    position_m: Vector3
    world_from_body: Rotation
    time_s: float

    @classmethod
    def from_detector(cls, image: DetectorImage, position_m: Vector3, world_from_body: Rotation) -> PosedImage:
        """Correct a detector image for offset, frame transfer (if any) and flat field."""
        detector = image.calibration
        signal = image.counts.astype(np.float32) - np.float32(detector.offset_dn)
        exposed = remove_frame_transfer(signal, detector, detector.rows_summed)
        radiance = (exposed / np.maximum(detector.flat_field, MIN_RESPONSE)).astype(np.float32)
        return cls(radiance, image.camera, position_m, world_from_body, image.time_s)

    @property
    def world_camera(self) -> CameraModel:
        """Camera model in the world frame at the estimated pose."""
        return self.camera.transform(rigid(self.world_from_body, self.position_m))

    def bin(self, factor: int) -> PosedImage:
        """Average blocks of `factor` x `factor` pixels; raises ValueError if the factor does not divide the size."""
        if factor == 1:
            return self
        camera = self.camera.bin(factor, factor)
        binned = np.asarray(cv2.resize(self.radiance, camera.size, interpolation=cv2.INTER_AREA))
        return replace(self, radiance=binned, camera=camera)

    def correct(self, translation_m: Vector3, rotation_rad: Vector3) -> PosedImage:
        """Return the image with its position shifted and its attitude rotated by a rotation vector in world axes."""
        attitude = Rotation.from_rotvec(rotation_rad) * self.world_from_body
        return replace(self, position_m=self.position_m + translation_m, world_from_body=attitude)


def binning_factor(image: PosedImage, height_m: float, ground_pixel_m: float) -> int:
    """Power of two for which a binned pixel at the nadir is closest (in ratio) to `ground_pixel_m`; divides the size.

    - height_m: height of the camera above the ground
    """
    ratio = ground_pixel_m / (height_m * image.camera.pixel_angle_rad)
    exponent = max(round(float(np.log2(ratio))), 0)
    while exponent and (image.camera.size[0] % 2**exponent or image.camera.size[1] % 2**exponent):
        exponent -= 1
    return int(2**exponent)
