"""Simulated descent with its map and its measurements, which all algorithms of a case use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import UInt16
from scipy.spatial.transform import Rotation

from marsyard.algorithms.localisation.interface import InitialState
from marsyard.scenarios.cameras import camera_optics
from marsyard.scenarios.case_faults import HAZE_PATH_M, add_detector_faults
from marsyard.scenarios.heat_shield import HeatShield
from marsyard.scenarios.localisation.camera import draw_calibrated_camera, true_camera
from marsyard.scenarios.localisation.flight import LanderFlight
from marsyard.scenarios.localisation.instruments import INERTIAL_MARGIN_S, measure_altitudes
from marsyard.scenarios.localisation.map_product import make_map
from marsyard.scenarios.localisation.map_truth import MapTruth
from marsyard.scenarios.localisation.measurements import LocalisationMeasurements
from marsyard.scenarios.localisation.parameters import LocalisationScenarioParameters
from marsyard.scenarios.localisation.world import LocalisationWorld
from marsyard.scenarios.radiance import add_haze
from marsyard.scenarios.views import render_state
from marsyard.sim.dynamics import State
from marsyard.sim.measurements import AltitudeMeasurement, DetectorImage, ImuIncrements
from marsyard.sim.sensor import ClockParameters, Detector, Imu
from marsyard.sim.sensor.altimeters import RadarAltimeter
from marsyard.sim.sensor.instrument import Clock
from marsyard.sim.streams import Streams

#: The inertial data begin and end this long before the start of localisation and after the last image, s. The span is
#: longer if the error of a clock moves a time tag out of it.
INERTIAL_LEAD_S, INERTIAL_TAIL_S = 0.2, 0.2
#: Minimum height of a camera for which the ground's mesh is made, m: a lower one needs no finer first guess.
_MIN_HEIGHT_M = 50.0
#: Index of the terrain that a wrong map shows, minus the index of the case's terrain.
_WRONG_TERRAIN = 1


@dataclass(frozen=True)
class LocalisedDescent:
    """A simulated descent, its map and its measurements, which all algorithms of a case use.

    - states: true states at the images
    - image_states: true states at the delivered images
    - inertial_start_s: true time of the first inertial boundary and of the initial state
    - imu_offset_s: time tags of the inertial unit minus true times, without jitter
    """

    p: LocalisationScenarioParameters
    world: LocalisationWorld
    flight: LanderFlight
    states: tuple[State, ...]
    image_states: tuple[State, ...]
    map_truth: MapTruth
    inertial_start_s: float
    imu_offset_s: float
    measurements: LocalisationMeasurements

    @property
    def images(self) -> tuple[DetectorImage, ...]:
        """Delivered images."""
        return self.measurements.images

    @property
    def initial_truth(self) -> State:
        """True state at the time of the initial state of inertial navigation."""
        return self.flight.state(self.inertial_start_s)

    @classmethod
    def simulate(cls, p: LocalisationScenarioParameters, streams: Streams) -> LocalisedDescent:
        """Simulate the descent of a case, its map and its measurements."""
        world = _create_world(p, p.location.terrain)
        gravity = world.air.gravity_m_s2
        centre = np.array([p.location.east_m, p.location.north_m])
        start_xy = centre + np.array([p.start_east_m, p.start_north_m])
        ground_m = float(world.surface.height(*start_xy))
        start = np.array([*start_xy, ground_m + p.flight.altitude_start_m])
        flight = LanderFlight.simulate(
            p.flight, start, streams.generator("flight"), ground_height_m=ground_m, gravity_m_s2=gravity
        )
        mapped = _create_world(p, map_terrain(p)) if p.faults.wrong_map else world
        map_product, map_truth = make_map(mapped, p.map, centre, streams.generator("map"), p.render.backend)
        times = p.images.times(0.0, flight.end_s)
        if not times.size:
            raise ValueError(
                f"images.first_s is {p.images.first_s:.6g} s; allowed: before the end of the flight, "
                f"{flight.end_s:.4g} s"
            )
        states = tuple(flight.motion(times).state(row) for row in range(times.size))
        images, image_states = _take_images(p, world, states, streams)
        altitudes = _measure_altitudes(p, world, flight, float(times[-1]), streams)
        tags_s = [altitude.time_s for altitude in altitudes] + [image.time_s for image in images]
        span_s = _inertial_span(flight, float(times[-1]), tags_s)
        increments, initial, offset_s = _measure_inertially(p, flight, span_s, gravity, streams)
        measurements = LocalisationMeasurements(initial, map_product, increments, tuple(altitudes), tuple(images))
        return cls(p, world, flight, states, tuple(image_states), map_truth, span_s[0], offset_s, measurements)


def map_terrain(p: LocalisationScenarioParameters) -> int:
    """Return the index of the terrain on the map."""
    return (p.location.terrain + p.faults.wrong_map * _WRONG_TERRAIN) % p.location.bank


def _create_world(p: LocalisationScenarioParameters, number: int) -> LocalisationWorld:
    return LocalisationWorld.from_parameters(
        p.site_preset,
        p.terrain,
        bank_seed=p.location.bank_seed,
        terrain_number=number,
        sun_azimuth_deg=p.sun.azimuth_deg,
        sun_elevation_deg=p.sun.elevation_deg,
        optical_depth=p.dust_opacity,
        detector=p.detector,
    )


def _take_images(
    p: LocalisationScenarioParameters, world: LocalisationWorld, states: Sequence[State], streams: Streams
) -> tuple[list[DetectorImage], list[State]]:
    """Render and expose the images; return the delivered images and the true states at their exposures."""
    optics = camera_optics(true_camera(p.camera))
    calibrated = (
        optics.camera if p.exact_instruments else draw_calibrated_camera(p.camera, streams.generator("calibration"))
    )
    detector = Detector.draw(
        optics.fall_off, add_detector_faults(p.faults, p.detector), streams.generator("detector response")
    )
    clock = Clock.draw(p.clock, streams.generator("image clock"))
    times = np.array([state.time_s for state in states])
    tags = times if p.exact_instruments else clock.tags(times, streams.generator("image tags"))
    east_m, north_m = states[0].position_m[:2].tolist()
    scene = world.scene(east_m, north_m, _MIN_HEIGHT_M, optics.rays.pixel_rad)
    shield = None
    if p.faults.heat_shield_deg:
        angle = float(np.radians(p.faults.heat_shield_deg))
        shield = HeatShield.draw(states[0], angle, streams.generator("heat shield"))
    noise, losses = streams.generator("detector noise"), streams.generator("lost images")
    images: list[DetectorImage] = []
    delivered_states: list[State] = []
    for number, (state, tag) in enumerate(zip(states, tags, strict=True), start=1):
        east_m, north_m, up_m = state.position_m.tolist()
        height = up_m - float(world.surface.height(east_m, north_m))
        scene = world.move_scene(scene, east_m, north_m, max(height, _MIN_HEIGHT_M))
        frame, motion = render_state(p.render.backend, scene, optics, state)
        extinction = world.air.mean_extinction_m(height) + p.faults.haze / HAZE_PATH_M
        frame = replace(frame, radiance=add_haze(frame, world.air, world.sun, extinction))
        if shield is not None:
            frame = shield.paint_over(frame, world.sun, state.time_s)
        counts: UInt16[np.ndarray, "rows columns"] = detector.expose(
            frame.radiance * np.float32(world.brightness), noise, motion
        )
        if number == p.faults.black_image:
            counts = np.zeros_like(counts)
        if losses.random() >= p.faults.lost_images:
            images.append(DetectorImage(counts, float(tag), calibrated, detector.calibration))
            delivered_states.append(state)
    return images, delivered_states


def _inertial_span(flight: LanderFlight, last_s: float, tags_s: Sequence[float]) -> tuple[float, float]:
    """Return the span of the inertial data: around all time tags, as far as the flight is simulated."""
    start_s = min(-INERTIAL_LEAD_S, min(tags_s, default=0.0) - INERTIAL_MARGIN_S)
    end_s = max(last_s + INERTIAL_TAIL_S, max(tags_s, default=0.0) + INERTIAL_MARGIN_S)
    first_s, final_s = flight.span_s
    return max(start_s, first_s), min(end_s, final_s)


def _measure_inertially(
    p: LocalisationScenarioParameters,
    flight: LanderFlight,
    span_s: tuple[float, float],
    gravity_m_s2: float,
    streams: Streams,
) -> tuple[ImuIncrements, InitialState, float]:
    """Measure the inertial increments, draw the state at their beginning, and return the offset of their time tags."""
    start_s, end_s = span_s
    imu = Imu.draw(p.imu, (start_s, end_s), streams.generator("imu"))
    if p.exact_instruments:
        increments = imu.exact_increments(flight, start_s, end_s)
    else:
        increments = imu.increments(flight, start_s, end_s, streams.generator("imu noise"))
    truth = flight.state(start_s)
    rng = streams.generator("initial state")
    initial = p.initial.draw(truth, float(increments.times_s[0]), gravity_m_s2, rng)
    azimuth = rng.uniform(-np.pi, np.pi)
    if p.exact_instruments:
        exact = replace(initial, world_from_body=truth.attitude, velocity_m_s=truth.velocity_m_s)
        return increments, exact, 0.0
    tilt = np.radians(p.faults.attitude_error_deg) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    tilted = Rotation.from_rotvec(tilt) * initial.world_from_body
    return increments, replace(initial, world_from_body=tilted), imu.clock.offset_s


def _measure_altitudes(
    p: LocalisationScenarioParameters, world: LocalisationWorld, flight: LanderFlight, last_s: float, streams: Streams
) -> list[AltitudeMeasurement]:
    """Measure the altitudes from start to end, or compute the true altitudes at the same times."""
    exact = {"clock": ClockParameters()} if p.exact_instruments else {}
    altimeter = p.altimeter.model_copy(update=exact)
    radar = RadarAltimeter.draw(altimeter, world.surface, streams.generator("altimeter"))
    readings = measure_altitudes(radar, flight, (0.0, last_s), streams.generator("altimeter noise"))
    if p.exact_instruments:
        times = np.array([reading.time_s for reading in readings])
        positions = flight.motion(times).positions_m
        heights = positions[:, 2] - world.surface.height(positions[:, 0], positions[:, 1])
        return [AltitudeMeasurement(float(height), float(tag)) for height, tag in zip(heights, times, strict=True)]
    factor = 1.0 + p.faults.altitude_error
    return [AltitudeMeasurement(factor * reading.altitude_m, reading.time_s) for reading in readings]
