"""Parachute descent over Mars with three pictures: DIMES' scenario."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import numpy as np
from jaxtyping import Float32, Float64, UInt16
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy.spatial.transform import RigidTransform, Rotation

from algorithms.dimes import DimesDetails, DimesEstimator, dimes_products
from algorithms.interface import VelocityEstimate
from scenarios.interface import CaseResult, Scalar
from sim.camera import Cahv, Cahvor
from sim.dynamics import DescentParameters, ParachuteDescent, State
from sim.frames import direction
from sim.measurements import AltitudeMeasurement, DescentMeasurements, DetectorImage
from sim.processor import processor_features
from sim.render import Photometry, PixelRays, Scene, Sun, process_renderer
from sim.render.backend import Backend, default_backend
from sim.sensor import (
    Altimeter,
    AltimeterParameters,
    Detector,
    DetectorChoice,
    DetectorParameters,
    ImageMotion,
    Navigation,
    NavigationParameters,
    natural_fall_off,
)
from sim.streams import Streams
from sim.terrain import Surface, TerrainBank, TerrainParameters

PICTURES = 3


class Place(BaseModel):
    """Where over which terrain the descent happens."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    bank: Annotated[int, Field(ge=1, le=100000, description="terrains in the bank")] = 4
    bank_seed: Annotated[int, Field(ge=0, description="seed of the bank's terrains")] = 1
    terrain: Annotated[int, Field(ge=0, description="number of the terrain in the bank")] = 0
    east_m: Annotated[float, Field(description="where the first picture is taken, on the periodic terrain")] = 0.0
    north_m: Annotated[float, Field(description="where the first picture is taken, on the periodic terrain")] = 0.0

    @model_validator(mode="after")
    def _terrain_is_in_bank(self) -> Place:
        if self.terrain >= self.bank:
            raise ValueError(f"terrain {self.terrain} is not in the bank; allowed: 0 to {self.bank - 1}")
        return self


class SunParameters(BaseModel):
    """Where the sun stands."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    azimuth_deg: Annotated[float, Field(ge=-360.0, le=720.0, description="clockwise from north")] = 270.0
    elevation_deg: Annotated[float, Field(gt=0.0, le=90.0, description="above the horizon")] = 40.0


class CameraParameters(BaseModel):
    """The descent camera: 14.67 mm, 12 um pixels, 45 deg; distortion that of an Opportunity navcam (its PDS label)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    focal_length_mm: Annotated[float, Field(gt=1.0, le=1000.0)] = 14.67
    pixel_pitch_um: Annotated[float, Field(gt=0.5, le=100.0)] = 12.0
    columns: Annotated[int, Field(ge=64, le=4096)] = 1024
    rows: Annotated[int, Field(ge=64, le=4096)] = 1024
    radial_0: Annotated[float, Field(ge=-0.1, le=0.1, description="first term of CAHVOR's R")] = 0.00096
    radial_1: Annotated[float, Field(ge=-0.5, le=0.5, description="second term of CAHVOR's R")] = -0.002183
    radial_2: Annotated[float, Field(ge=-0.5, le=0.5, description="third term of CAHVOR's R")] = 0.018547
    alignment_error_deg: Annotated[
        float, Field(ge=0.0, le=10.0, description="RMS per axis of the mounting's error, not known to the lander")
    ] = 0.02


class RenderParameters(BaseModel):
    """How pictures are drawn."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    backend: Annotated[Backend, Field(description="library that provides OpenGL's context")] = Field(
        default_factory=default_backend
    )


class DescentScenarioParameters(BaseModel):
    """Everything that a descent campaign may set or disperse."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    place: Place = Place()
    terrain: TerrainParameters = TerrainParameters()
    sun: SunParameters = SunParameters()
    descent: DescentParameters = DescentParameters()
    camera: CameraParameters = CameraParameters()
    detector: DetectorChoice = DetectorParameters()
    altimeter: AltimeterParameters = AltimeterParameters()
    navigation: NavigationParameters = NavigationParameters()
    render: RenderParameters = Field(default_factory=RenderParameters)


@dataclass(frozen=True)
class Optics:
    """What depends on the camera's design alone and is shared by all cases of a worker."""

    camera: Cahvor
    rays: PixelRays
    fall_off: Float32[np.ndarray, "rows columns"]


@dataclass(frozen=True)
class Exposure:
    """Truth and picture of one exposure."""

    state: State
    counts: UInt16[np.ndarray, "rows columns"]


class DescentScenario:
    """Three pictures of a parachute descent, measured and given to DIMES."""

    name = "descent"
    parameters_type = DescentScenarioParameters

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Numbers of the bank's terrains."""
        return tuple(range(_checked(parameters).place.bank))

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Builds one terrain of the bank."""
        p = _checked(parameters)
        TerrainBank(p.terrain, p.place.bank_seed).terrain(shared_input)

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """One descent."""
        p = _checked(parameters)
        surface = TerrainBank(p.terrain, p.place.bank_seed).terrain(p.place.terrain)
        descent = placed_descent(p, surface)
        sun = Sun(direction(np.radians(p.sun.azimuth_deg), np.radians(p.sun.elevation_deg)))
        optics = camera_optics(p.camera)
        detector = Detector.drawn(optics.fall_off, p.detector, streams.generator("detector response"))
        exposures = _expose(p, surface, descent, sun, optics, detector, streams)
        altimeter = Altimeter.drawn(p.altimeter, surface, streams.generator("altimeter bias"))
        measurements = _measure(p, descent, exposures, sun, optics, detector, altimeter, streams)
        estimate = DimesEstimator().estimate(measurements)
        true_velocity = _mean_velocities(exposures)[1]
        row = {
            **_score(estimate, true_velocity),
            **_conditions(p, exposures, measurements, altimeter, sun),
            **{f"descent_{name}": value for name, value in descent.parameters.model_dump().items()},
            **_provenance(p, exposures),
        }
        return CaseResult(
            outcome=estimate.outcome.name,
            answered=estimate.velocity_m_s is not None,
            row=row,
            products=_products(exposures, estimate, true_velocity),
        )


def _checked(parameters: BaseModel) -> DescentScenarioParameters:
    if not isinstance(parameters, DescentScenarioParameters):
        raise TypeError(f"the descent scenario takes DescentScenarioParameters, not {type(parameters).__name__}")
    return parameters


@cache
def camera_optics(parameters: CameraParameters) -> Optics:
    """The descent camera in the body frame: at its origin, looking down, columns to the east at zero attitude."""
    pinhole = Cahv.from_focal_length(
        focal_m=parameters.focal_length_mm * 1e-3,
        pixel_pitch_m=parameters.pixel_pitch_um * 1e-6,
        size=(parameters.columns, parameters.rows),
        centre=np.zeros(3),
        axis=np.array([0.0, 0.0, -1.0]),
        right=np.array([1.0, 0.0, 0.0]),
    )
    camera = Cahvor.from_cahv(pinhole, r=np.array([parameters.radial_0, parameters.radial_1, parameters.radial_2]))
    return Optics(camera, PixelRays.of(camera), natural_fall_off(camera))


def placed_descent(p: DescentScenarioParameters, surface: Surface) -> ParachuteDescent:
    """The descent whose first picture is taken at the stated height above the ground below."""
    ground = float(surface.height(p.place.east_m, p.place.north_m))
    start = np.array([p.place.east_m, p.place.north_m, ground + p.descent.altitude_first_m])
    return ParachuteDescent(p.descent, start)


def _expose(
    p: DescentScenarioParameters,
    surface: Surface,
    descent: ParachuteDescent,
    sun: Sun,
    optics: Optics,
    detector: Detector,
    streams: Streams,
) -> list[Exposure]:
    """The three pictures, through the camera as it is truly mounted."""
    renderer = process_renderer(p.render.backend)
    scene = Scene(surface, (p.place.east_m, p.place.north_m), sun, Photometry())
    tilt = np.radians(p.camera.alignment_error_deg) * streams.generator("camera alignment").standard_normal(3)
    mounting = RigidTransform.from_rotation(Rotation.from_rotvec(tilt))
    noise = streams.generator("detector noise")
    exposures = []
    for number in range(PICTURES):
        state = descent.state(number * p.descent.interval_s)
        frame = renderer.render(scene, optics.rays, state.world_from_body * mounting)
        # the camera sits at the body's origin: its mounting turns it, but moves it nowhere
        motion = ImageMotion.seen(
            optics.camera,
            frame.range_m,
            frame.world_from_body,
            state.velocity_m_s,
            state.attitude.apply(state.body_rate_rad_s),
        )
        exposures.append(Exposure(state, detector.expose(frame.radiance, noise, motion)))
    return exposures


def _measure(
    p: DescentScenarioParameters,
    descent: ParachuteDescent,
    exposures: list[Exposure],
    sun: Sun,
    optics: Optics,
    detector: Detector,
    altimeter: Altimeter,
    streams: Streams,
) -> DescentMeasurements:
    """What the lander's computer holds. Attitude and altitude are those of the tagged times, not of the exposures."""
    navigation = Navigation.drawn(p.navigation, streams.generator("navigation bias"))
    clock = streams.generator("image time tags")
    attitude_noise = streams.generator("attitude noise")
    altitude_noise = streams.generator("altimeter noise")
    velocity_noise = streams.generator("velocity noise")
    camera = optics.camera.binned(columns=1, rows=p.detector.rows_summed)
    images, attitudes, altitudes = [], [], []
    for exposure in exposures:
        tag = navigation.tag(exposure.state.time_s, clock)
        at_tag = descent.state(tag)
        images.append(DetectorImage(exposure.counts, tag, camera, detector.calibration))
        attitudes.append(navigation.attitude(at_tag.attitude, tag, attitude_noise))
        altitudes.append(AltitudeMeasurement(altimeter.measure(at_tag.position_m, altitude_noise), tag))
    velocities = [navigation.velocity(true, velocity_noise) for true in _mean_velocities(exposures)]
    return DescentMeasurements(
        images=(images[0], images[1], images[2]),
        attitudes=(attitudes[0], attitudes[1], attitudes[2]),
        altitudes=(altitudes[0], altitudes[1], altitudes[2]),
        interval_velocities_m_s=np.stack(velocities),
        sun_direction=sun.direction,
    )


def _mean_velocities(exposures: list[Exposure]) -> Float64[np.ndarray, "2 3"]:
    """True mean velocities of the camera between the pictures, world axes, m/s."""
    positions = np.stack([exposure.state.position_m for exposure in exposures])
    times = np.array([exposure.state.time_s for exposure in exposures])
    velocities: Float64[np.ndarray, "2 3"] = np.diff(positions, axis=0) / np.diff(times)[:, None]
    return velocities


def _score(estimate: VelocityEstimate, true_velocity: Float64[np.ndarray, "3"]) -> dict[str, Scalar]:
    """Horizontal velocity and its error against the true mean velocity between the second and third picture."""
    estimated = np.full(2, np.nan) if estimate.velocity_m_s is None else estimate.velocity_m_s
    error = estimated - true_velocity[:2]
    return {
        "velocity_error_m_s": float(np.hypot(*error)),
        "velocity_error_x_m_s": float(error[0]),
        "velocity_error_y_m_s": float(error[1]),
        "velocity_estimated_x_m_s": float(estimated[0]),
        "velocity_estimated_y_m_s": float(estimated[1]),
        "velocity_true_x_m_s": float(true_velocity[0]),
        "velocity_true_y_m_s": float(true_velocity[1]),
    }


def _conditions(
    p: DescentScenarioParameters,
    exposures: list[Exposure],
    measurements: DescentMeasurements,
    altimeter: Altimeter,
    sun: Sun,
) -> dict[str, Scalar]:
    """What the case was like, read from the simulated objects."""
    states = [exposure.state for exposure in exposures]
    row: dict[str, Scalar] = {
        "terrain": p.place.terrain,
        "place_east_m": p.place.east_m,
        "place_north_m": p.place.north_m,
        "sun_azimuth_deg": float(np.degrees(np.arctan2(sun.direction[0], sun.direction[1])) % 360.0),
        "sun_elevation_deg": float(np.degrees(np.arcsin(sun.direction[2]))),
        "horizontal_speed_m_s": float(np.hypot(*states[-1].velocity_m_s[:2])),
        "descent_rate_m_s": float(-states[-1].velocity_m_s[2]),
    }
    for number, state in enumerate(states, start=1):
        attitude_error = measurements.attitudes[number - 1].world_from_body * state.attitude.inv()
        true_altitude = altimeter.true_altitude(state.position_m)
        row[f"altitude_{number}_m"] = true_altitude
        row[f"altitude_error_{number}_m"] = measurements.altitudes[number - 1].altitude_m - true_altitude
        row[f"off_nadir_{number}_deg"] = _off_nadir_deg(state.attitude)
        row[f"attitude_rate_{number}_deg_s"] = float(np.degrees(np.linalg.norm(state.body_rate_rad_s)))
        row[f"attitude_error_{number}_deg"] = float(np.degrees(attitude_error.magnitude()))
        row[f"tag_error_{number}_s"] = measurements.images[number - 1].time_s - state.time_s
    row["off_nadir_max_deg"] = max(_off_nadir_deg(state.attitude) for state in states)
    row["attitude_rate_max_deg_s"] = max(float(row[f"attitude_rate_{k}_deg_s"]) for k in range(1, PICTURES + 1))
    return row


def _off_nadir_deg(attitude: Rotation) -> float:
    """Angle between the camera's axis and nadir."""
    return float(np.degrees(np.arccos(np.clip(attitude.as_matrix()[2, 2], -1.0, 1.0))))


def _provenance(p: DescentScenarioParameters, exposures: list[Exposure]) -> dict[str, Scalar]:
    """Hash of the pictures, and what their last bits depend on."""
    digest = hashlib.sha256()
    for exposure in exposures:
        digest.update(np.ascontiguousarray(exposure.counts).tobytes())
    return {
        "image_hash": digest.hexdigest(),
        "gl_backend": p.render.backend,
        "gl_version": process_renderer(p.render.backend).description(),
        "processor_features": processor_features(),
    }


def _products(
    exposures: list[Exposure], estimate: VelocityEstimate, true_velocity: Float64[np.ndarray, "3"]
) -> dict[str, object]:
    """Arrays from which the case's figures are drawn."""
    products: dict[str, object] = {
        f"image_{number}": exposure.counts for number, exposure in enumerate(exposures, start=1)
    }
    if isinstance(estimate.details, DimesDetails):
        products.update(dimes_products(estimate.details))
    products["velocity_true_m_s"] = true_velocity[:2]
    if estimate.velocity_m_s is not None:
        products["velocity_estimated_m_s"] = estimate.velocity_m_s
    return products
