"""Draw the instruments of a descent, and create the measurements of an estimator from true motion and images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.scenarios.case_faults import Images
from marsyard.scenarios.descent.faults import AttitudeTilts, add_altitude_faults
from marsyard.scenarios.descent.flight import DescentFlight, gravity_m_s2, mean_velocities
from marsyard.scenarios.descent.images import calibrated_camera, camera_optics
from marsyard.scenarios.descent.parameters import IMU_MARGIN_S, DescentScenarioParameters
from marsyard.scenarios.descent.world import DescentWorld
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.parts.instruments import (
    CustomAltimeter,
    CustomAttitudeSource,
    InstrumentReadings,
    InstrumentTruth,
)
from marsyard.sim.dynamics import State, Trajectory
from marsyard.sim.measurements import AltitudeMeasurement, AttitudeMeasurement, DescentMeasurements, DetectorImage
from marsyard.sim.sensor import (
    Approach,
    Clock,
    Detector,
    Imu,
    InertialSolution,
    RadarAltimeter,
    Readings,
    height_above_ground,
)
from marsyard.sim.sensor.altimeters import first_return
from marsyard.sim.streams import Streams


@dataclass(frozen=True)
class DescentInstruments:
    """Instruments of one descent with their constant errors, and readings of custom instruments.

    - approach: flight before the descent, during which navigation errors grow
    - imu: inertial unit of the navigation, with the errors that remain after its calibration
    - navigation: propagated attitude and velocity, from shortly before the first image to the thrusters' firing; exact
      with `exact_instruments`
    - altimeter: the radar, or the readings of a custom altimeter
    - tags_s: time tags of the images
    - attitude_source: readings of a custom attitude source at the time tags; None: attitudes of the navigation are used
    - tilts: tilts of the attitude faults
    - row: columns of the custom instruments
    """

    approach: Approach
    imu: Imu
    navigation: InertialSolution
    altimeter: RadarAltimeter | InstrumentReadings
    tags_s: Float64[np.ndarray, "images"]
    attitude_source: InstrumentReadings | None
    tilts: AttitudeTilts
    row: Mapping[str, Scalar]

    @classmethod
    def draw(
        cls, p: DescentScenarioParameters, world: DescentWorld, flight: DescentFlight, streams: Streams
    ) -> DescentInstruments:
        """Draw the instruments of a case, propagate the navigation, and read the custom instruments."""
        start, end = -flight.lead_s + IMU_MARGIN_S, flight.firing_s + IMU_MARGIN_S
        approach = Approach(p.approach, start)
        uncalibrated_imu = Imu.draw(p.imu, (approach.start_s, end), streams.generator("inertial unit"))
        imu = approach.calibrate(uncalibrated_imu, streams.generator("inertial unit's calibration"))
        clock = Clock.draw(p.clock, streams.generator("image clock"))
        surface, motion, image_times = world.surface, flight.motion, np.array(p.image_times_s)
        tags = clock.tags(image_times, streams.generator("image time tags"))
        row: dict[str, Scalar] = {}

        def read(
            instrument: CustomAltimeter | CustomAttitudeSource, table: str, times_s: np.ndarray
        ) -> InstrumentReadings:
            """Return the readings of a custom instrument; add the columns of its parameter table to the row."""
            truth = InstrumentTruth(
                times_s=times_s.copy(),  # the instrument may change them; `tags` are also those of the images
                motion=motion,
                ground_height=lambda x, y: float(surface.height(x, y)),
                nearest_ground=partial(first_return, surface),
            )
            readings = instrument.read(truth, streams.generator(f"own {table}"))
            row.update(instrument.columns(table, readings.columns))
            return readings

        altimeter: RadarAltimeter | InstrumentReadings
        if isinstance(p.altimeter, CustomAltimeter):
            altimeter = read(p.altimeter, "altimeter", image_times)
        else:
            altimeter = RadarAltimeter.draw(p.altimeter, surface, streams.generator("altimeter"))
        attitude_source = None if p.attitude_source is None else read(p.attitude_source, "attitude_source", tags)
        tilts = AttitudeTilts.draw(p.faults, streams.generator("attitude fault"))
        state = motion.state(approach.end_s)
        if p.exact_instruments:
            increments = imu.exact_increments(motion, approach.end_s, end)
            attitude, velocity = state.attitude, state.velocity_m_s
        else:
            # inertial navigation from the last star reference, before entry, to the thrusters' firing
            increments = imu.increments(motion, approach.end_s, end, streams.generator("inertial noise"))
            errors = approach.errors(imu, streams.generator("approach"))
            attitude, velocity = errors.apply(state.attitude, state.velocity_m_s)
        return cls(
            approach=approach,
            imu=imu,
            navigation=InertialSolution.propagate(increments, tilts.common * attitude, velocity, gravity_m_s2(p)),
            altimeter=altimeter,
            tags_s=tags,
            attitude_source=attitude_source,
            tilts=tilts,
            row=row,
        )


def add_increments(
    measurements: DescentMeasurements, p: DescentScenarioParameters, flight: DescentFlight, streams: Streams
) -> DescentMeasurements:
    """Add the increments of the estimator's inertial unit over the time of the navigation, if it has a unit."""
    if p.inertial.unit is None:
        return measurements
    span = -flight.lead_s + IMU_MARGIN_S, flight.firing_s + IMU_MARGIN_S
    imu = Imu.draw(p.inertial.unit, span, streams.generator("estimator's inertial unit"))
    increments = (
        imu.exact_increments(flight.motion, *span)
        if p.exact_instruments
        else imu.increments(flight.motion, *span, streams.generator("estimator's inertial noise"))
    )
    return replace(measurements, increments=increments, gravity_m_s2=gravity_m_s2(p))


def measure_exactly(
    p: DescentScenarioParameters, world: DescentWorld, states: Sequence[State], images: Images, detector: Detector
) -> DescentMeasurements:
    """Create measurements without errors: true attitudes, altitudes, times and velocities, and the true camera."""
    camera = p.detector.delivered_camera(camera_optics(p.camera).camera)
    heights = height_above_ground(world.surface, np.stack([state.position_m for state in states]))
    return DescentMeasurements(
        images=tuple(
            DetectorImage(counts, state.time_s, camera, detector.calibration)
            for counts, state in zip(images, states, strict=True)
        ),
        attitudes=tuple(AttitudeMeasurement(state.attitude, state.time_s) for state in states),
        altitudes=tuple(
            AltitudeMeasurement(float(height), state.time_s) for height, state in zip(heights, states, strict=True)
        ),
        interval_velocities_m_s=mean_velocities(states),
        sun_direction=world.sun.direction,
        inertial_velocities_m_s=np.stack([state.velocity_m_s for state in states]),
    )


def measure(
    p: DescentScenarioParameters,
    world: DescentWorld,
    motion: Trajectory,
    images: Images,
    detector: Detector,
    instruments: DescentInstruments,
    streams: Streams,
) -> DescentMeasurements:
    """Create measurements with errors: attitudes at the images' time tags, and the last altitude before each image."""
    tags = instruments.tags_s
    model = calibrated_camera(p.camera, streams.generator("camera calibration"))
    camera = p.detector.delivered_camera(model)
    detector_images = [
        DetectorImage(counts, float(tag), camera, detector.calibration)
        for counts, tag in zip(images, tags, strict=True)
    ]
    source, tilts = instruments.attitude_source, instruments.tilts
    rotations = (
        instruments.navigation.attitude(tags) if source is None else tilts.common * Rotation.from_quat(source.values)
    )
    attitudes = [AttitudeMeasurement(rotation, float(tag)) for rotation, tag in zip(rotations, tags, strict=True)]
    readings: Readings | InstrumentReadings
    if isinstance(instruments.altimeter, RadarAltimeter):
        times = instruments.altimeter.sampling.latest(np.array(p.image_times_s))
        readings = instruments.altimeter.measure(motion, times, streams.generator("altimeter noise"))
    else:
        readings = instruments.altimeter
    altitudes = [
        AltitudeMeasurement(float(value), float(tag))
        for value, tag in zip(readings.values, readings.times_s, strict=True)
    ]
    return DescentMeasurements(
        images=tuple(detector_images),
        attitudes=tuple(tilts.tilt_faulty_image(attitudes)),
        altitudes=tuple(add_altitude_faults(p.faults, altitudes)),
        interval_velocities_m_s=instruments.navigation.mean_velocities(tags),
        sun_direction=world.sun.direction,
        inertial_velocities_m_s=instruments.navigation.velocity(tags),
    )
