"""Synthetic measurements for conformance checks: a textured plane, imaged exactly by any camera, and blank images.

Each pixel's ray is intersected with the plane, without a renderer.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float32, Float64
from scipy import fft
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation, Slerp

from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import direction, rigid
from marsyard.sim.measurements import (
    AltitudeMeasurement,
    AttitudeMeasurement,
    DescentMeasurements,
    DetectorCalibration,
    DetectorImage,
    ImuIncrements,
    LandingMeasurements,
    PoseMeasurement,
)
from marsyard.sim.sensor import Detector, natural_fall_off, preset
from marsyard.sim.sensor.presets import Preset

#: Measurements with the field `images`.
Measurements = TypeVar("Measurements", bound=Any)

#: Mean radiance factor of the plane, and radiance factor outside the plane.
MEAN_RADIANCE, BACKGROUND_RADIANCE = 0.2, 0.1
#: Side of the periodic texture in samples, and standard deviation of its values relative to their mean.
_TEXTURE_SIZE, _TEXTURE_CONTRAST = 1024, 0.2
#: Mean velocity of the descent, east, north, up, m/s.
DESCENT_VELOCITY_M_S = np.array([12.0, -7.0, -75.0])
#: Maximum time between images, and from the first to the last image, s.
_INTERVAL_S, _DURATION_S = 3.75, 7.5
#: Rate of the inertial unit, Hz, and gravity of Mars, m/s^2.
_IMU_HZ, GRAVITY_M_S2 = 100.0, 3.72
#: Attitudes of the images about z, y and x, degrees; further images repeat them.
_ATTITUDES_DEG = ((40, 4, -3), (44, 2, 3), (41, -3, 5))
_START_POSITION_M = np.array([0.0, 0.0, 1900.0])
#: Positions of the two landing images, metres.
_LANDING_POSITIONS_M = np.array([[0.0, 0.0, 30.0], [1.2, 0.2, 29.8]])

#: Function of the detector's calibration that returns the count of all pixels of a blank image.
Blank = Callable[[DetectorCalibration], int]
BLANKS: dict[str, Blank] = {
    "featureless": lambda calibration: round(0.4 * calibration.full_scale_dn),
    "dark": lambda calibration: round(calibration.offset_dn),
    "saturated": lambda calibration: calibration.full_scale_dn,
}


@dataclass(frozen=True)
class TexturedPlane:
    """A plane through `origin` in the world, with a periodic texture of spacing `step_m`.

    The orthogonal unit vectors `axes` point along the texture's columns and rows.
    """

    origin: Float64[np.ndarray, "3"]
    axes: Float64[np.ndarray, "2 3"]
    step_m: float

    def radiance(self, camera: CameraModel) -> Float32[np.ndarray, "rows columns"]:
        """Compute the radiance factor in each pixel of a camera in the world."""
        origins, directions = camera.rays(camera.pixel_grid())
        normal = np.cross(*self.axes)
        offset = (self.origin - origins) @ normal
        normal_component = directions @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            ranges = offset / normal_component
        visible = np.isfinite(ranges) & (ranges > 0.0)
        points = origins + np.where(visible, ranges, 1.0)[..., None] * directions - self.origin
        columns, rows = np.moveaxis(points @ self.axes.T, -1, 0) / self.step_m
        values = map_coordinates(texture(), [rows, columns], order=1, mode="grid-wrap")
        return np.where(visible, MEAN_RADIANCE * values, BACKGROUND_RADIANCE).astype(np.float32)


@cache
def texture() -> Float32[np.ndarray, "rows columns"]:
    """Create periodic noise with the mean 1; its amplitudes decrease with frequency, as on natural surfaces."""
    rng = np.random.default_rng(20040103)
    frequency = np.hypot(*np.meshgrid(fft.fftfreq(_TEXTURE_SIZE), fft.rfftfreq(_TEXTURE_SIZE), indexing="ij"))
    frequency[0, 0] = np.inf
    # amplitudes from 4 cycles per side of the texture to 0.3 cycles per sample
    amplitude = np.where(frequency < 0.3, frequency**-1.2, 0.0) * (frequency > 4.0 / _TEXTURE_SIZE)
    shape = (_TEXTURE_SIZE, _TEXTURE_SIZE)
    values = fft.irfft2(amplitude * fft.rfft2(rng.standard_normal(shape)), shape)
    return np.asarray(1.0 + _TEXTURE_CONTRAST * values / values.std(), dtype=np.float32)


@cache
def descent(image_count: int = 3) -> DescentMeasurements:
    """Create the measurements of a descent over level, textured ground; only the inertial velocity has an error."""
    interval_s = min(_INTERVAL_S, _DURATION_S / (image_count - 1))
    positions = _START_POSITION_M + interval_s * np.arange(image_count)[:, None] * DESCENT_VELOCITY_M_S
    angles = [_ATTITUDES_DEG[number % len(_ATTITUDES_DEG)] for number in range(image_count)]
    attitudes = [Rotation.from_euler("ZYX", values, degrees=True) for values in angles]
    times = [100.0 + interval_s * number for number in range(image_count)]
    # constant horizontal error of the inertial velocity, m/s
    inertial = DESCENT_VELOCITY_M_S + np.array([9.0, -4.0, 0.0])
    return DescentMeasurements(
        images=tuple(_take_images(preset("mer-descent-flown"), positions, attitudes, times, step_m=2.0)),
        attitudes=tuple(AttitudeMeasurement(attitude, time) for attitude, time in zip(attitudes, times, strict=True)),
        altitudes=tuple(AltitudeMeasurement(float(z), time) for z, time in zip(positions[:, 2], times, strict=True)),
        interval_velocities_m_s=np.tile(inertial, (image_count - 1, 1)),
        sun_direction=direction(np.radians(250.0), np.radians(35.0)),
        inertial_velocities_m_s=np.tile(inertial, (image_count, 1)),
    )


@cache
def inertial_descent(image_count: int) -> DescentMeasurements:
    """Create the measurements of `descent` with exact inertial increments.

    They start 1 s before the first image and end 0.5 s after the last. The velocity is constant, so that the specific
    force is the reaction to gravity.
    """
    measurements = descent(image_count)
    tags = np.array(measurements.tags_s)
    count = round((tags[-1] - tags[0] + 1.5) * _IMU_HZ)
    times = tags[0] - 1.0 + np.arange(count + 1) / _IMU_HZ
    # constant angular rate between images, none before the first and after the last image
    rotations = Rotation.concatenate([attitude.world_from_body for attitude in measurements.attitudes])
    attitudes = Slerp(tags, rotations)(np.clip(times, tags[0], tags[-1]))
    increments = ImuIncrements(
        times_s=times,
        period_s=1.0 / _IMU_HZ,
        delta_angles_rad=(attitudes[:-1].inv() * attitudes[1:]).as_rotvec(),
        delta_velocities_m_s=attitudes[:-1].inv().apply([0.0, 0.0, GRAVITY_M_S2 / _IMU_HZ]),
    )
    return replace(measurements, increments=increments, gravity_m_s2=GRAVITY_M_S2)


@cache
def landing() -> LandingMeasurements:
    """Create the measurements of two helicopter images of level, textured ground; all instruments are exact."""
    attitudes = [Rotation.from_euler("ZYX", angles, degrees=True) for angles in ((10, 3, -2), (10.2, 2.8, -1.9))]
    times = [0.0, 2.0]
    first, second = _take_images(preset("xc-55"), _LANDING_POSITIONS_M, attitudes, times, step_m=0.03)
    poses = [PoseMeasurement(rigid(attitudes[index], _LANDING_POSITIONS_M[index]), times[index]) for index in (0, 1)]
    axis = attitudes[0].apply(first.camera.a.copy())
    slant_range_m = -_LANDING_POSITIONS_M[0, 2] / axis[2]
    return LandingMeasurements(
        images=(first, second),
        poses=(poses[0], poses[1]),
        slant_range_m=float(slant_range_m),
        up_body=np.asarray(attitudes[0].inv().apply([0.0, 0.0, 1.0])),
        apriori_site_world=np.asarray(_LANDING_POSITIONS_M[0] + slant_range_m * axis),
    )


def _take_images(
    detector_preset: Preset, positions: np.ndarray, attitudes: Sequence[Rotation], times: Sequence[float], step_m: float
) -> list[DetectorImage]:
    """Take images of level, textured ground; `step_m` is the spacing of the texture's samples."""
    (camera,) = detector_preset.cameras()
    ground = TexturedPlane(np.zeros(3), np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), step_m)
    rng = np.random.default_rng(1)
    detector = Detector.draw(natural_fall_off(camera), detector_preset.detector, rng)
    binned_camera = detector_preset.detector.delivered_camera(camera)
    images = []
    for position, attitude, time in zip(positions, attitudes, times, strict=True):
        radiance = ground.radiance(camera.transform(rigid(attitude, position)))
        images.append(DetectorImage(detector.expose(radiance, rng), time, binned_camera, detector.calibration))
    return images


def make_blank(measurements: Measurements, blank: Blank) -> Measurements:
    """Return the measurements with blank images."""
    return _replace_counts(measurements, lambda item: np.full(item.counts.shape, blank(item.calibration), np.uint16))


def make_noisy(measurements: Measurements) -> Measurements:
    """Return the measurements with images of pure noise."""
    rng = np.random.default_rng(2)

    def draw_noise(image: DetectorImage) -> np.ndarray:
        return rng.integers(0, image.calibration.full_scale_dn, image.counts.shape, np.uint16, endpoint=True)

    return _replace_counts(measurements, draw_noise)


def _replace_counts(measurements: Measurements, counts: Callable[[DetectorImage], np.ndarray]) -> Measurements:
    changed: Measurements = replace(
        measurements, images=tuple(replace(image, counts=counts(image)) for image in measurements.images)
    )
    return changed
