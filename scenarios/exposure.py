"""Functions common to all imaging scenarios: optics, calibration, rendering, haze, heat shield, samples with truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Any, Protocol, cast, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, UInt8, UInt16
from pydantic import BaseModel
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import Cahv, Cahvor, Cahvore, CameraModel
from marsyard.sim.dynamics import State
from marsyard.sim.error_sources import CALIBRATION
from marsyard.sim.parameters import Parameters, bounded_field
from marsyard.sim.render import Frame, PixelRays, Scene, Sun, process_renderer
from marsyard.sim.render.backend import Backend
from marsyard.sim.render.reflectance import add_air_light
from marsyard.sim.sensor import DetectorParameters, ImageMotion, natural_fall_off
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Environment

#: Path length for which the fault `haze` states an optical depth, m: about the height of the first image.
HAZE_PATH_M = 2000.0
#: Downward speed of the released heat shield relative to the lander, m/s (assumed).
SHIELD_FALL_M_S = 20.0
#: Diameter of MER's aeroshell (Desai & Knocke 2004), m.
SHIELD_DIAMETER_M = 2.65
#: Heat shield relative to the lander: horizontal speed, m/s, and tumble rate, rad/s (assumed).
SHIELD_DRIFT_M_S, SHIELD_TUMBLE_RAD_S = 2.0, 1.0
#: Largest angle of the heat shield from nadir in the first image, radians (assumed).
SHIELD_MAX_OFF_NADIR_RAD = 0.2
#: Assumed albedos of the shield: charred outside, insulated inside.
SHIELD_OUTSIDE_ALBEDO, SHIELD_INSIDE_ALBEDO = 0.1, 0.5


@dataclass(frozen=True)
class Optics:
    """A camera in the body frame, the rays of its pixels and the relative illumination (fall-off) of its lens."""

    camera: CameraModel
    rays: PixelRays
    fall_off: Float32[np.ndarray, "rows columns"]


@lru_cache(maxsize=8)
def camera_optics(camera: CameraModel) -> Optics:
    """Return the cached optics of a camera in the body frame."""
    return Optics(camera, PixelRays.from_camera(camera), natural_fall_off(camera))


class CalibrationParameters(Parameters):
    """Errors of the calibrated camera that an algorithm receives.

    The values of the descent camera are assumed for all cameras.
    """

    focal_error: Annotated[
        float, CALIBRATION, bounded_field(0.0, 0.05, "RMS relative error of the calibrated focal length")
    ] = 0.0002
    centre_error_px: Annotated[
        float, CALIBRATION, bounded_field(0.0, 50.0, "RMS error of the calibrated image centre per axis, px")
    ] = 0.5
    distortion_error_px: Annotated[
        float, CALIBRATION, bounded_field(0.0, 50.0, "RMS error of the calibrated distortion in the image corners, px")
    ] = 0.3


def add_calibration_error(
    camera: CameraModel, focal_error: float, centre_error_px: tuple[float, float], distortion_error_px: float
) -> CameraModel:
    """Return a camera with calibration errors.

    - focal_error: relative error of the focal length
    - centre_error_px: error of the image centre, (columns, rows)
    - distortion_error_px: outward displacement of the corners
    """
    recentred = camera.magnify(1.0 + focal_error).recentre(*centre_error_px)
    if isinstance(recentred, Cahv):
        recentred = Cahvor.from_cahv(recentred, r=np.zeros(3))
    # R1 displaces a point outwards by R1 chi^3; chi is the radial coordinate of its ray (`marsyard.sim.camera.models`)
    corner = float(np.hypot(0.5 * (recentred.size[0] - 1), 0.5 * (recentred.size[1] - 1)))
    radial = cast(Cahvor | Cahvore, recentred)
    chi = corner / (recentred.focal_lengths[0] * (1.0 + float(radial.r[0])))
    return replace(radial, r=radial.r + np.array([0.0, distortion_error_px / recentred.focal_lengths[0] / chi**3, 0.0]))


def draw_calibrated(camera: CameraModel, p: CalibrationParameters, rng: np.random.Generator) -> CameraModel:
    """Return a camera with normally distributed calibration errors."""
    focal, column, row, distortion = rng.standard_normal(4)
    centre = (p.centre_error_px * float(column), p.centre_error_px * float(row))
    return add_calibration_error(camera, p.focal_error * focal, centre, p.distortion_error_px * distortion)


@dataclass(frozen=True)
class ImageSample:
    """An image and the truth of each pixel.

    - image: counts of `bits` bits, as delivered
    - range_m: distance along the pixel's ray to the surface; infinite for the sky
    - normal: unit normal of the surface, world axes
    - rocks: 1 for a rock or another object, 0 for ground
    - hazard: footprint hazard of a lander: 0 safe, 1 hazard, 255 not completely visible; None without a lander
    - camera: camera in body axes
    - metadata: pose, sun and other values that JSON can store
    """

    image: UInt16[np.ndarray, "rows columns"]
    bits: int
    range_m: Float32[np.ndarray, "rows columns"]
    normal: Float32[np.ndarray, "rows columns 3"]
    rocks: UInt8[np.ndarray, "rows columns"]
    hazard: UInt8[np.ndarray, "rows columns"] | None
    camera: CameraModel
    metadata: Mapping[str, Any]


def select_middle_rows(rows_summed: int) -> slice:
    """Select the rendered row in the middle of each group of summed rows: it represents the truth of an image row."""
    return slice(rows_summed // 2, None, rows_summed)


@runtime_checkable
class ProvidesSamples(Protocol):
    """A scenario that provides images with ground truth, to train and test learned methods."""

    def samples(self, parameters: BaseModel, streams: Streams) -> Iterator[ImageSample]:
        """Yield the images of one case that `run` passes to its algorithms."""


def render_state(
    backend: Backend, scene: Scene, optics: Optics, state: State, mounting: RigidTransform | None = None
) -> tuple[Frame, ImageMotion]:
    """Render the view of a camera at the body's origin, and compute the image motion during its exposure.

    `mounting` rotates the camera in the body.
    """
    pose = state.world_from_body if mounting is None else state.world_from_body * mounting
    frame = process_renderer(backend).render(scene, optics.rays, pose, state.time_s)
    rate = state.attitude.apply(state.body_rate_rad_s)
    return frame, ImageMotion.from_camera(optics.camera, frame.range_m, frame.world_from_body, state.velocity_m_s, rate)


def add_haze(frame: Frame, air: Environment, sun: Sun, extinction_m: float) -> Float32[np.ndarray, "rows columns"]:
    """Compute the radiance factor of an image through a homogeneous layer of dusty air between ground and camera.

    The light from the ground is attenuated by the transmission ``T = exp(-extinction_m * range_m)``. The air adds
    ``(1 - T)`` times its source function: single scattering of sunlight (phase function of Henyey & Greenstein 1941)
    and of the mean light from sky and ground. Sky pixels are not changed.
    """
    if extinction_m == 0.0:
        return frame.radiance
    transmission = np.multiply(frame.range_m, -extinction_m, dtype=np.float32, casting="same_kind")
    np.exp(transmission, out=transmission)
    transmission[np.isinf(frame.range_m)] = 1.0
    # sunlight travels along -sun and is scattered along -direction, towards the camera
    sun_body = frame.world_from_body.rotation.inv().apply(sun.direction)
    sky = air.sky_fraction(float(np.arcsin(np.clip(sun.direction[2], -1.0, 1.0))))
    ambient = 0.5 * (sky + float(frame.radiance.mean()))
    radiance, transmission = frame.radiance.reshape(-1), transmission.reshape(-1)
    scattering = air.single_scattering_albedo, air.asymmetry, ambient
    hazy = add_air_light(radiance, transmission, frame.rays.device.directions, sun_body, *scattering)
    return hazy.reshape(frame.radiance.shape)


@dataclass(frozen=True)
class HeatShield:
    """Freely falling, tumbling disc that approximates the shield's cone of 70 deg half angle.

    Centre, velocity, outward normal and angular velocity are those at the first image, in world axes.
    """

    centre_m: Float64[np.ndarray, "3"]
    velocity_m_s: Float64[np.ndarray, "3"]
    normal: Float64[np.ndarray, "3"]
    spin_rad_s: Float64[np.ndarray, "3"]
    start_s: float

    @classmethod
    def draw(cls, first: State, angle_rad: float, rng: np.random.Generator) -> HeatShield:
        """Draw a shield below the lander at its first image; `angle_rad` is its angular diameter seen face on."""
        limits = [2 * np.pi, SHIELD_MAX_OFF_NADIR_RAD, 2 * np.pi, 2 * np.pi]
        azimuth, off_nadir, drift_azimuth, axis_azimuth = rng.uniform(size=4) * limits
        ray = np.array([np.sin(azimuth) * np.sin(off_nadir), np.cos(azimuth) * np.sin(off_nadir), -np.cos(off_nadir)])
        drift_direction = np.array([np.sin(drift_azimuth), np.cos(drift_azimuth)])
        drift = np.array([*(SHIELD_DRIFT_M_S * drift_direction), -SHIELD_FALL_M_S])
        axis = np.array([np.cos(axis_azimuth), np.sin(axis_azimuth), 0.0])
        return cls(
            centre_m=first.position_m + SHIELD_DIAMETER_M / (2.0 * np.tan(0.5 * angle_rad)) * ray,
            velocity_m_s=first.velocity_m_s + drift,
            normal=Rotation.from_rotvec(rng.uniform(-np.pi, np.pi) * axis).apply([0.0, 0.0, -1.0]),
            spin_rad_s=SHIELD_TUMBLE_RAD_S * axis,
            start_s=first.time_s,
        )

    def paint_over(
        self, radiance: Float32[np.ndarray, "rows columns"], frame: Frame, sun: Sun, time_s: float
    ) -> Float32[np.ndarray, "rows columns"]:
        """Paint the shield over an image's radiance factor: a Lambert surface, lit by the sun only."""
        elapsed_s = time_s - self.start_s
        centre = self.centre_m + elapsed_s * self.velocity_m_s
        normal = Rotation.from_rotvec(elapsed_s * self.spin_rad_s).apply(self.normal)
        origin = frame.world_from_body.apply(frame.rays.centre)
        directions = frame.world_from_body.rotation.apply(frame.rays.directions.astype(np.float64))
        cosines = directions @ normal
        distance = ((centre - origin) @ normal) / np.where(np.abs(cosines) > 1e-9, cosines, 1e-9)
        centre_distance = np.linalg.norm(origin + distance[:, None] * directions - centre, axis=1)
        is_hit = (distance > 0.0) & (centre_distance < 0.5 * SHIELD_DIAMETER_M)
        # the camera sees the outside if the normal points towards it, otherwise the inside
        sun_cosine = np.maximum(-np.sign(cosines) * float(normal @ sun.direction), 0.0)
        reflected = np.where(cosines < 0.0, SHIELD_OUTSIDE_ALBEDO, SHIELD_INSIDE_ALBEDO) * sun_cosine
        painted = np.where(is_hit, reflected, radiance.reshape(-1))
        return painted.astype(np.float32).reshape(radiance.shape)


def sunlight_ratio(air: Environment, elevation_rad: float, detector: DetectorParameters) -> float:
    """Return direct sunlight at the ground divided by the reference sunlight of the detector's responsivity."""
    return air.direct_fraction(elevation_rad) * air.solar_irradiance / detector.sunlight


def pixel_sample(
    counts: UInt16[np.ndarray, "rows columns"],
    frame: Frame,
    detector: DetectorParameters,
    camera: CameraModel,
    metadata: Mapping[str, Any],
    hazard: UInt8[np.ndarray, "rows columns"] | None = None,
) -> ImageSample:
    """Assemble an image and the truth of its pixels; `camera` is that of the delivered image."""
    rows = select_middle_rows(detector.rows_summed)
    return ImageSample(
        image=counts,
        bits=detector.bits,
        range_m=frame.range_m[rows].astype(np.float32),
        normal=frame.normal[rows],
        rocks=(frame.body[rows] >= 0).astype(np.uint8),
        hazard=hazard,
        camera=camera,
        metadata=metadata,
    )
