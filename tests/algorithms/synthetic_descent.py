"""Synthetic MER descent images for the tests of DIMES: a flat textured plane, and the smear of a frame-transfer CCD.

The ray of each physical pixel is intersected with the ground; DIMES projects from the ground into the image.
"""

from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np
from scipy import fft
from scipy.spatial.transform import Rotation

from marsyard.algorithms.interface import VelocityEstimate
from marsyard.sim.camera import Cahv, Cahvor
from marsyard.sim.frames import direction
from marsyard.sim.measurements import (
    AltitudeMeasurement,
    AttitudeMeasurement,
    DescentMeasurements,
    DetectorCalibration,
    DetectorImage,
)

#: MER descent camera: 14.67 mm, 12 um, 1024 x 1024; distortion of several pixels in the corners, off-centre.
CAMERA = Cahvor.from_cahv(
    Cahv.from_focal_length(
        0.01467, 12e-6, (1024, 1024), axis=(0.0, 0.0, -1.0), right=(0.0, -1.0, 0.0), image_centre=(515.0, 508.5)
    ),
    r=(0.0, -0.05, 0.02),
    o=np.array([0.002, -0.003, -1.0]) / np.linalg.norm([0.002, -0.003, -1.0]),
)
ROWS_SUMMED = 4
FULL_SCALE = 4095
INTERVAL_S = 3.75  #: Time between images, s.


@dataclass(frozen=True)
class Texture:
    """Brightness of the plane, periodic and bilinear; `values[i, j]` is at north = -i step_m, east = j step_m."""

    values: np.ndarray
    step_m: float

    def __call__(self, east: np.ndarray, north: np.ndarray, origin: np.ndarray) -> np.ndarray:
        """Interpolate the brightness at `origin` plus (east, north), metres.

        The positions have errors of 1e-4 texels from float32 and of 1/32 texel from remap.
        """
        size = np.array(self.values.shape, dtype=np.float64)
        row, column = np.mod(np.array([-origin[1], origin[0]]) / self.step_m, size)
        rows = np.float32(row) - east.dtype.type(1.0 / self.step_m) * north
        columns = np.float32(column) + east.dtype.type(1.0 / self.step_m) * east
        return np.asarray(cv2.remap(self.values, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))


@cache
def draw_terrain(
    seed: int = 1, contrast: float = 0.15, slope: float = 1.2, size: int = 2048, step_m: float = 1.5
) -> Texture:
    """Draw a random texture with mean 1, RMS `contrast` and amplitudes proportional to frequency**-slope."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(*np.meshgrid(fft.fftfreq(size), fft.rfftfreq(size), indexing="ij"))
    frequency[0, 0] = np.inf
    amplitude = np.where(frequency > 4.0 / size, frequency**-slope, 0.0) * (frequency < 0.3)
    values = fft.irfft2(amplitude * fft.rfft2(rng.standard_normal((size, size)), workers=1), (size, size))
    return Texture((1.0 + contrast * values / values.std()).astype(np.float32), step_m)


def make_waves(wavelength_m: float, contrast: float = 0.2, size: int = 2048, step_m: float = 1.5) -> Texture:
    """Create a repetitive terrain of two crossed waves, with a whole number of waves per period."""
    phase = 2.0 * np.pi * np.round(size * step_m / wavelength_m) * np.arange(size) / size
    values = 1.0 + contrast * (np.sin(phase)[:, None] + np.sin(phase)[None, :]) / 2.0
    return Texture(values.astype(np.float32), step_m)


@cache
def compute_body_rays() -> np.ndarray:
    """Compute the directions of the rays of all physical pixels in the body frame, shape (3, 1024, 1024)."""
    return np.ascontiguousarray(np.moveaxis(CAMERA.rays(CAMERA.pixel_grid())[1], -1, 0), dtype=np.float32)


@cache
def compute_fall_off() -> np.ndarray:
    """Compute the relative response of the physical pixels, cos^4 of the field angle, shape (1024, 1024)."""
    return np.clip(np.tensordot(CAMERA.a, compute_body_rays(), 1), 0.0, 1.0) ** 4


@cache
def compute_binned_fall_off() -> np.ndarray:
    """Compute the relative response of the delivered rows, shape (256, 1024)."""
    return np.asarray(compute_fall_off().reshape(-1, ROWS_SUMMED, 1024).mean(axis=1))


def make_calibration(transfer_row_s: float = 5e-6, clear_row_s: float = 2e-6) -> DetectorCalibration:
    """Create the calibration of the MER descent camera with these times per row of transfer and clearing."""
    return DetectorCalibration(
        flat_field=compute_binned_fall_off(),
        exposure_s=0.004,
        transfer_row_s=transfer_row_s,
        clear_row_s=clear_row_s,
        rows_summed=ROWS_SUMMED,
        offset_dn=20.0,
        full_scale_dn=FULL_SCALE,
    )


def trace_scene(texture: Texture, world_from_body: Rotation, position: np.ndarray) -> np.ndarray:
    """Compute the radiance of each physical pixel, shape (1024, 1024); the sky is black."""
    rays = np.tensordot(world_from_body.as_matrix().astype(np.float32), compute_body_rays(), 1)
    is_down = rays[2] < -0.05
    slant = np.where(is_down, np.float32(-position[2]) / np.where(is_down, rays[2], np.float32(-1.0)), np.float32(0.0))
    return np.where(is_down, texture(slant * rays[0], slant * rays[1], position), np.float32(0.0))


def expose_scene(
    radiance: np.ndarray, detector: DetectorCalibration, noise: np.random.Generator | None = None, level: float = 1600.0
) -> np.ndarray:
    """Expose a static scene; return counts. `level` is the number of counts of radiance 1 on the axis.

    The noise is 50 electrons, and shot noise at 6.9 (11000 / 1600) electrons per count.
    """
    rate = radiance * compute_fall_off()
    rate_above = np.cumsum(rate, axis=0) - rate  # float64, as the fall-off
    rate_below = rate.sum(axis=0) - rate_above - rate
    charge = rate + (detector.transfer_row_s * rate_above + detector.clear_row_s * rate_below) / detector.exposure_s
    counts = level * charge.reshape(-1, detector.rows_summed, charge.shape[1]).mean(axis=1)
    if noise is not None:
        electrons = noise.poisson(counts * 11000.0 / 1600.0) + 50.0 * noise.standard_normal(counts.shape)
        counts = electrons * 1600.0 / 11000.0
    return np.asarray(np.clip(np.rint(counts + detector.offset_dn), 0, detector.full_scale_dn).astype(np.uint16))


@dataclass(frozen=True)
class Flight:
    """True positions (3, 3) and attitudes at three images, and the direction to the sun."""

    positions: np.ndarray
    attitudes: tuple[Rotation, Rotation, Rotation]
    sun: np.ndarray = field(default_factory=lambda: direction(np.deg2rad(250.0), np.deg2rad(10.0)))

    @property
    def velocities(self) -> np.ndarray:
        """True mean velocities over the two intervals, shape (2, 3)."""
        return np.diff(self.positions, axis=0) / INTERVAL_S


def tilt_body(tilt_deg: float, azimuth_deg: float, roll_deg: float) -> Rotation:
    """Create the attitude of a body that rolls about its vertical and is then tilted towards `azimuth_deg`."""
    tilt = Rotation.from_euler("ZYZ", [azimuth_deg, tilt_deg, -azimuth_deg], degrees=True)
    return tilt * Rotation.from_euler("z", roll_deg, degrees=True)


def draw_flight(rng: np.random.Generator, max_tilt_deg: float = 25.0, max_wind: float = 30.0) -> Flight:
    """Draw random rolls, tilts within 5 deg of a random mean tilt, and a wind that changes between the intervals.

    - max_wind: maximum horizontal velocity, m/s; the lander drifts with the wind
    """
    wind = max_wind * np.sqrt(rng.uniform()) * np.array([*_draw_unit_vector(rng), 0.0])
    wind_change = np.array([*rng.normal(0.0, 1.0, 2), 0.0])
    first = np.array([*rng.uniform(0.0, 3000.0, 2), rng.uniform(1900.0, 2100.0)])
    descent = np.array([0.0, 0.0, -75.0])
    displacements = np.stack([np.zeros(3), wind + descent, 2.0 * (wind + descent) + wind_change])
    mean_tilt_deg = max_tilt_deg * np.sqrt(rng.uniform()) * _draw_unit_vector(rng)
    attitudes = []
    for _ in range(3):
        x, y = mean_tilt_deg + rng.uniform(-5.0, 5.0, 2)
        attitudes.append(tilt_body(np.hypot(x, y), np.degrees(np.arctan2(y, x)), rng.uniform(0.0, 360.0)))
    return Flight(first + INTERVAL_S * displacements, (attitudes[0], attitudes[1], attitudes[2]))


LEVEL_FLIGHT = (Rotation.identity(), Rotation.identity(), Rotation.identity())


def steady_flight(
    velocity: tuple[float, float], attitudes: tuple[Rotation, Rotation, Rotation] = LEVEL_FLIGHT
) -> Flight:
    """Create a descent at 75 m/s with a steady horizontal velocity (east, north), m/s."""
    step = INTERVAL_S * np.array([*velocity, -75.0])
    return Flight(np.array([900.0, 1400.0, 2000.0]) + np.outer(np.arange(3), step), attitudes)


def _draw_unit_vector(rng: np.random.Generator) -> np.ndarray:
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def make_measurements(flight: Flight, counts: list[np.ndarray], detector: DetectorCalibration) -> DescentMeasurements:
    """Create exact measurements of a flight; the inertial velocities have a common error of (40, -25) m/s."""
    camera = CAMERA.bin(1, detector.rows_summed)
    times = [100.0 + INTERVAL_S * i for i in range(3)]
    return DescentMeasurements(
        images=tuple(DetectorImage(image, t, camera, detector) for image, t in zip(counts, times, strict=True)),
        attitudes=tuple(AttitudeMeasurement(a, t) for a, t in zip(flight.attitudes, times, strict=True)),
        altitudes=tuple(AltitudeMeasurement(float(p[2]), t) for p, t in zip(flight.positions, times, strict=True)),
        interval_velocities_m_s=flight.velocities + np.array([40.0, -25.0, 0.0]),
        sun_direction=flight.sun,
    )


def render(
    flight: Flight, texture: Texture | None = None, noise: np.random.Generator | None = None, level: float = 1600.0
) -> DescentMeasurements:
    """Render the images of a flight; return them with exact measurements."""
    detector = make_calibration()
    ground = draw_terrain() if texture is None else texture
    counts = [
        expose_scene(trace_scene(ground, attitude, position), detector, noise, level)
        for attitude, position in zip(flight.attitudes, flight.positions, strict=True)
    ]
    return make_measurements(flight, counts, detector)


def valid_velocity(estimate: VelocityEstimate) -> np.ndarray:
    """Return the velocity of an estimate. Fails without a velocity."""
    assert estimate.velocity_m_s is not None
    return estimate.velocity_m_s


def draw_stripes(counts: np.ndarray) -> np.ndarray:
    """Return counts of 0 in even and of 4095 in odd columns."""
    return np.broadcast_to(4095 * (np.arange(counts.shape[1]) % 2), counts.shape).astype(np.uint16)
