"""What the lander's computer holds: pictures, attitudes propagated from the stars, altitudes, velocity changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt16

from scenarios.descent.faults import faulty_altitudes, faulty_attitudes
from scenarios.descent.flight import MARGIN_S, Flown, gravity_m_s2
from scenarios.descent.optics import calibrated_camera
from scenarios.descent.parameters import DescentScenarioParameters
from scenarios.descent.world import World
from sim.dynamics import Trajectory
from sim.measurements import AltitudeMeasurement, AttitudeMeasurement, DescentMeasurements, DetectorImage
from sim.sensor import Approach, Clock, Detector, Imu, InertialSolution, RadarAltimeter
from sim.streams import Streams


@dataclass(frozen=True)
class Instruments:
    """One descent's instruments, their constant errors drawn.

    Attributes
    ----------
    approach
        The flight before the descent, along which navigation's errors grow.
    imu
        The inertial unit.
    navigation
        Attitude and velocity as propagated on board, from shortly before the first picture to the thrusters' firing.
    altimeter
        The radar.
    clock
        Of the pictures' time tags.
    """

    approach: Approach
    imu: Imu
    navigation: InertialSolution
    altimeter: RadarAltimeter
    clock: Clock

    @classmethod
    def drawn(cls, p: DescentScenarioParameters, world: World, flown: Flown, streams: Streams) -> Instruments:
        """The instruments of a case, and what navigation makes of its motion."""
        start, end = -flown.lead_s + MARGIN_S, flown.firing_s + MARGIN_S
        approach = Approach(p.approach, start)
        unit = Imu.drawn(p.imu, (approach.start_s, end), streams.generator("inertial unit"))
        imu = approach.calibrated(unit, streams.generator("inertial unit's calibration"))
        return cls(
            approach=approach,
            imu=imu,
            navigation=_navigated(p, approach, imu, flown, streams),
            altimeter=RadarAltimeter.drawn(p.altimeter, world.surface, streams.generator("altimeter")),
            clock=Clock.drawn(p.clock, streams.generator("image clock")),
        )


def _navigated(
    p: DescentScenarioParameters, approach: Approach, imu: Imu, flown: Flown, streams: Streams
) -> InertialSolution:
    """Navigation from the last star reference, before entry, to the thrusters' firing."""
    start, end = approach.end_s, flown.firing_s + MARGIN_S
    errors = approach.errors(imu, streams.generator("approach"))
    increments = imu.increments(flown.motion, start, end, streams.generator("inertial noise"))
    state = flown.motion.state(start)
    attitude, velocity = errors.believed(state.attitude, state.velocity_m_s)
    return InertialSolution.propagated(increments, attitude, velocity, gravity_m_s2(p))


def measure(
    p: DescentScenarioParameters,
    world: World,
    motion: Trajectory,
    pictures: Sequence[UInt16[np.ndarray, "rows columns"]],
    detector: Detector,
    instruments: Instruments,
    streams: Streams,
) -> DescentMeasurements:
    """Pictures and readings: attitudes at the pictures' tags, altitudes of the radar's last readings before them."""
    times = np.array(p.picture_times_s)
    tags = instruments.clock.tags(times, streams.generator("image time tags"))
    model = calibrated_camera(p.camera, streams.generator("camera calibration"))
    camera = model.binned(columns=1, rows=p.detector.rows_summed)
    images = [
        DetectorImage(counts, float(tag), camera, detector.calibration)
        for counts, tag in zip(pictures, tags, strict=True)
    ]
    attitudes = [
        AttitudeMeasurement(attitude, float(tag))
        for attitude, tag in zip(instruments.navigation.attitude(tags), tags, strict=True)
    ]
    attitudes = faulty_attitudes(p.faults, attitudes, streams.generator("attitude fault"))
    altitudes = faulty_altitudes(p.faults, _altitudes(motion, times, instruments.altimeter, streams))
    return DescentMeasurements(
        images=tuple(images),
        attitudes=tuple(attitudes),
        altitudes=tuple(altitudes),
        interval_velocities_m_s=instruments.navigation.mean_velocities(tags),
        sun_direction=world.sun.direction,
        inertial_velocities_m_s=instruments.navigation.velocity(tags),
    )


def _altitudes(
    motion: Trajectory, times_s: Float64[np.ndarray, "n"], altimeter: RadarAltimeter, streams: Streams
) -> list[AltitudeMeasurement]:
    """The radar's last readings before the pictures, with their own tags."""
    at = altimeter.sampling.latest(times_s)
    readings = altimeter.measure(motion, at, streams.generator("altimeter noise"))
    return [
        AltitudeMeasurement(float(value), float(tag))
        for value, tag in zip(readings.values, readings.times_s, strict=True)
    ]
