"""Measurements of a descent: pictures, attitudes propagated from a star reference, altitudes, velocity changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt16
from scipy.spatial.transform import Rotation

from marsyard.scenarios.descent.exposure import World, calibrated_camera
from marsyard.scenarios.descent.flight import MARGIN_S, DescentFlight, gravity_m_s2
from marsyard.scenarios.descent.parameters import DescentScenarioParameters, faulty_altitudes, faulty_attitudes
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.parts.instruments import (
    CustomAltimeter,
    CustomAttitudeSource,
    InstrumentReadings,
    InstrumentTruth,
)
from marsyard.sim.dynamics import Trajectory
from marsyard.sim.measurements import AltitudeMeasurement, AttitudeMeasurement, DescentMeasurements, DetectorImage
from marsyard.sim.sensor import Approach, Clock, Detector, Imu, InertialSolution, RadarAltimeter, Readings
from marsyard.sim.sensor.ranging import first_return
from marsyard.sim.streams import Streams


@dataclass(frozen=True)
class Instruments:
    """Instruments of one descent with drawn constant errors.

    - approach: flight before the descent, along which navigation errors grow
    - navigation: propagated attitude and velocity, from shortly before the first picture to the thrusters' firing
    - altimeter: the radar, or the readings of a user's own instrument
    - tags_s: time tags of the pictures
    - attitude_source: readings of a user's own instrument at the time tags; None for attitudes of the navigation
    - row: columns of the user's own instruments
    """

    approach: Approach
    imu: Imu
    navigation: InertialSolution
    altimeter: RadarAltimeter | InstrumentReadings
    tags_s: Float64[np.ndarray, "pictures"]
    attitude_source: InstrumentReadings | None
    row: Mapping[str, Scalar]

    @classmethod
    def draw(cls, p: DescentScenarioParameters, world: World, flight: DescentFlight, streams: Streams) -> Instruments:
        """Draw the instruments of a case, propagate the navigation, and read a user's own instruments."""
        start, end = -flight.lead_s + MARGIN_S, flight.firing_s + MARGIN_S
        approach = Approach(p.approach, start)
        unit = Imu.draw(p.imu, (approach.start_s, end), streams.generator("inertial unit"))
        imu = approach.calibrate(unit, streams.generator("inertial unit's calibration"))
        clock = Clock.draw(p.clock, streams.generator("image clock"))
        surface, motion = world.surface, flight.motion
        # readings and columns of the user's own instruments, by parameter table
        own: dict[str, tuple[InstrumentReadings, Mapping[str, Scalar]]] = {}
        tags = clock.tags(np.array(p.picture_times_s), streams.generator("image time tags"))
        for table, times in (("altimeter", np.array(p.picture_times_s)), ("attitude_source", tags)):
            instrument = getattr(p, table)
            if isinstance(instrument, CustomAltimeter | CustomAttitudeSource):
                truth = InstrumentTruth(
                    times_s=times,
                    motion=motion,
                    ground_height=lambda x, y: float(surface.height(x, y)),
                    nearest_ground=lambda apex, axis, half, far: first_return(surface, apex, axis, half, far),
                )
                readings = instrument.read(truth, streams.generator(f"own {table}"))
                own[table] = readings, instrument.columns(table, readings.columns)
        # inertial navigation from the last star reference, before entry, to the thrusters' firing
        errors = approach.errors(imu, streams.generator("approach"))
        increments = imu.increments(motion, approach.end_s, end, streams.generator("inertial noise"))
        state = motion.state(approach.end_s)
        attitude, velocity = errors.apply(state.attitude, state.velocity_m_s)
        return cls(
            approach=approach,
            imu=imu,
            navigation=InertialSolution.propagate(increments, attitude, velocity, gravity_m_s2(p)),
            altimeter=own["altimeter"][0]
            if isinstance(p.altimeter, CustomAltimeter)
            else RadarAltimeter.draw(p.altimeter, world.surface, streams.generator("altimeter")),
            tags_s=tags,
            attitude_source=own["attitude_source"][0] if "attitude_source" in own else None,
            row={name: value for _, row in own.values() for name, value in row.items()},
        )


def measure(
    p: DescentScenarioParameters,
    world: World,
    motion: Trajectory,
    pictures: Sequence[UInt16[np.ndarray, "rows columns"]],
    detector: Detector,
    instruments: Instruments,
    streams: Streams,
) -> DescentMeasurements:
    """Measurements of an estimator: attitudes at the pictures' tags, altitudes of the last readings before them."""
    tags = instruments.tags_s
    model = calibrated_camera(p.camera, streams.generator("camera calibration"))
    camera = model.bin(columns=1, rows=p.detector.rows_summed)
    images = [
        DetectorImage(counts, float(tag), camera, detector.calibration)
        for counts, tag in zip(pictures, tags, strict=True)
    ]
    own = instruments.attitude_source
    rotations = instruments.navigation.attitude(tags) if own is None else Rotation.from_quat(own.values)
    attitudes = [AttitudeMeasurement(one, float(tag)) for one, tag in zip(rotations, tags, strict=True)]
    attitudes = faulty_attitudes(p.faults, attitudes, streams.generator("attitude fault"))
    readings: Readings | InstrumentReadings
    if isinstance(instruments.altimeter, RadarAltimeter):
        at = instruments.altimeter.sampling.latest(np.array(p.picture_times_s))
        readings = instruments.altimeter.measure(motion, at, streams.generator("altimeter noise"))
    else:
        readings = instruments.altimeter
    altitudes = [
        AltitudeMeasurement(float(value), float(tag))
        for value, tag in zip(readings.values, readings.times_s, strict=True)
    ]
    return DescentMeasurements(
        images=tuple(images),
        attitudes=tuple(attitudes),
        altitudes=tuple(faulty_altitudes(p.faults, altitudes)),
        interval_velocities_m_s=instruments.navigation.mean_velocities(tags),
        sun_direction=world.sun.direction,
        inertial_velocities_m_s=instruments.navigation.velocity(tags),
    )
