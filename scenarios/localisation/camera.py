"""The lander's camera: a fisheye, the errors of its calibration, and its detector.

The camera is at the origin of the body frame; it looks along -z and its columns increase along x. Sources of the
values: Maki et al. 2020 (Space Science Reviews), Johnson et al. 2017 and 2022. Other values are marked as assumed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.scenarios.cameras import CalibrationParameters
from marsyard.sim.camera import Cahv, Cahvore, CameraModel
from marsyard.sim.error_sources import CALIBRATION
from marsyard.sim.parameters import Parameters, bounded_field
from marsyard.sim.sensor import DetectorParameters
from marsyard.sim.sensor.optics import OpticsParameters
from marsyard.sim.sensor.presets import FLIGHT_RESIDUAL
from marsyard.sim.sensor.radiometry import BRIGHT_FILL, BRIGHT_RADIANCE_FACTOR, LightPath

#: Distance of Mars from the sun at the landing on 2021-02-18: heliocentric longitude Ls = 5 deg on the orbit of Mars.
LANDING_AU = 1.57
#: Signal-to-noise ratio of a pixel of `LANDER_DETECTOR` at half of its full well.
HALF_WELL_SNR = 80.0
#: Noise of reading a summed pixel, electrons (assumed).
_READ_NOISE_E = 10.0
_EXPOSURE_S = 150e-6
_BITS = 8
#: Tolerance of the angle at the image's edge, radians: rounding errors of inverting the lens.
_EDGE_TOLERANCE_RAD = 1e-4


class LanderCameraParameters(Parameters):
    """The lander's camera: a fisheye (CAHVORE type 2) of 1024 x 1024 pixels, 90 x 90 deg, and 1.67 mrad on the axis.

    With the angle theta from the axis, the focal length f in pixels (1 / 1.67 mrad) and half the field theta_h, the
    radius in the image is f (theta + rho1 theta^3). rho1 is such that theta_h is at the edge: pixels of 1.67 mrad over
    the whole field would cover 98 deg.
    """

    pixels: Annotated[int, Field(ge=64, le=4096, description="columns and rows of the image")] = 1024
    pixel_mrad: Annotated[float, Field(gt=0.1, le=40.0, description="angle of a pixel on the axis, mrad")] = 1.67
    field_deg: Annotated[float, Field(gt=10.0, le=120.0, description="field of view from edge to edge")] = 90.0
    focal_length_mm: Annotated[float, Field(gt=1.0, le=100.0, description="focal length; sets the pixel pitch")] = 5.8
    alignment_error_deg: Annotated[
        float, CALIBRATION, bounded_field(0.0, 10.0, "RMS error of the calibrated mounting per axis (assumed)")
    ] = 0.02
    calibration: Annotated[CalibrationParameters, Field(description="errors of the calibrated lens (assumed)")] = (
        CalibrationParameters()
    )

    @model_validator(mode="after")
    def _check_field(self) -> LanderCameraParameters:
        camera = true_camera(self)
        edge = np.array([[-0.5, 0.5 * (self.pixels - 1)]])
        _, ((_, _, z),) = camera.rays(edge)
        angle = np.arccos(-z)  # from the optical axis, -z
        # a distortion that is not monotonic has the angle of another point at the edge
        is_exact = abs(angle - 0.5 * np.radians(self.field_deg)) < _EDGE_TOLERANCE_RAD
        if not (is_exact and np.all(np.isfinite(camera.corner_rays()[1]))):
            raise ValueError(
                f"field_deg of {self.field_deg:.6g} with {self.pixels} pixels of {self.pixel_mrad:.6g} mrad is not a "
                f"one-to-one image; allowed: a field close to pixels x pixel_mrad"
            )
        return self

    @property
    def pixel_pitch_um(self) -> float:
        """Pitch of the delivered pixels, micrometres."""
        return self.focal_length_mm * self.pixel_mrad


def true_camera(p: LanderCameraParameters) -> Cahvore:
    """Create the true camera in the body frame."""
    focal_px, half_field = 1e3 / p.pixel_mrad, 0.5 * np.radians(p.field_deg)
    pinhole = Cahv.from_axes(
        (focal_px, focal_px), (p.pixels, p.pixels), axis=np.array([0.0, 0.0, -1.0]), right=np.array([1.0, 0.0, 0.0])
    )
    cubic = (0.5 * p.pixels / focal_px - half_field) / half_field**3
    return Cahvore.from_cahv(pinhole, r=np.array([0.0, cubic, 0.0]), linearity=0.0)


def draw_calibrated_camera(p: LanderCameraParameters, rng: np.random.Generator) -> CameraModel:
    """Return the calibrated camera: the true one with normally distributed errors of lens and mounting.

    The error of the distortion moves a pixel at the angle theta outwards in proportion to theta^3.
    """
    focal, column, row, distortion = rng.standard_normal(4)
    tilt = Rotation.from_rotvec(np.radians(p.alignment_error_deg) * rng.standard_normal(3))
    camera, errors = true_camera(p), p.calibration
    corner_ray = camera.corner_rays()[1][0]
    corner = float(np.arccos(corner_ray @ camera.o / np.linalg.norm(corner_ray)))
    cubic = errors.distortion_error_px * float(distortion) * 1e-3 * p.pixel_mrad / corner**3
    camera = replace(camera, r=camera.r + np.array([0.0, cubic, 0.0]))
    camera = camera.magnify(1.0 + errors.focal_error * float(focal))
    camera = camera.recentre(errors.centre_error_px * float(column), errors.centre_error_px * float(row))
    return camera.transform(RigidTransform.from_rotation(tilt))


def _full_well_e() -> float:
    """Solve S / sqrt(S + r^2 + q^2) = SNR for the full well 2 S; q is the error of rounding to counts of 2 S / 2^b.

    With q^2 = c S^2, c = (2 / 2^b)^2 / 12, this is (1 - c SNR^2) S^2 - SNR^2 S - SNR^2 r^2 = 0.
    """
    square = HALF_WELL_SNR**2
    quadratic = 1.0 - square * (2.0 / 2**_BITS) ** 2 / 12.0
    half = (square + np.sqrt(square**2 + 4.0 * quadratic * square * _READ_NOISE_E**2)) / (2.0 * quadratic)
    return float(2.0 * half)


def _create_detector() -> DetectorParameters:
    """Create the detector of the lander's camera (see `LANDER_DETECTOR`)."""
    full_well = _full_well_e()
    pitch_um = LanderCameraParameters().pixel_pitch_um
    light = LightPath(f_number=2.7, pixel_pitch_um=pitch_um, band_nm=(400.0, 900.0))
    return DetectorParameters(
        exposure_s=_EXPOSURE_S,
        responsivity_e_s=BRIGHT_FILL * full_well / (BRIGHT_RADIANCE_FACTOR * _EXPOSURE_S),
        sun_au=LANDING_AU,
        rows_summed=1,  # of the delivered pixels, which all parameters describe
        transfer_row_s=0.0,
        clear_row_s=0.0,
        readout_row_s=1e-4,
        full_well_e=full_well,
        gain_e_dn=full_well / 2**_BITS,
        read_noise_e=_READ_NOISE_E,
        offset_dn=2.0,
        bits=_BITS,
        temperature_c=0.0,
        dark_e_s=2000.0,
        residual_spread=FLIGHT_RESIDUAL,
        optics=OpticsParameters(diffraction_px=light.diffraction_px(), diffusion_px=0.25),
    )


#: Detector of the lander's camera: global shutter, 8 bits, 150 us, SNR 80 at half full well, f/2.7. Its pixels are the
#: delivered ones, each the sum of 2 x 2 pixels of the chip; the summation itself is not simulated. Assumed: read noise,
#: offset, dark current (0.3 electrons in an exposure), readout, passband, blur; and the responsivity, which fills 60 %
#: of the full well at the radiance factor 0.3 (the other presets' exposure). It is 35 % of that of an f/2.7 lens on a
#: CCD of the same pitch: the rest is lost in the fill factor of a global shutter. The pattern that the calibration
#: lacks is that of Spirit's descent camera (assumed for this camera).
LANDER_DETECTOR = _create_detector()
