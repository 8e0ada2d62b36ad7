"""What the lander's computer holds: pictures, attitudes propagated from the stars, altitudes, velocity changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt16
from scipy.spatial.transform import Rotation

from marsyard.scenarios.descent.faults import faulty_altitudes, faulty_attitudes
from marsyard.scenarios.descent.flight import MARGIN_S, Flown, gravity_m_s2
from marsyard.scenarios.descent.optics import calibrated_camera
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.descent.world import World
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.parts.instruments import (
    InstrumentReadings,
    InstrumentTruth,
    OwnAltimeter,
    OwnAttitudeSource,
    attitudes_of,
)
from marsyard.sim.dynamics import Trajectory
from marsyard.sim.measurements import AltitudeMeasurement, AttitudeMeasurement, DescentMeasurements, DetectorImage
from marsyard.sim.sensor import Approach, Clock, Detector, Imu, InertialSolution, RadarAltimeter, Readings
from marsyard.sim.sensor.ranging import first_return
from marsyard.sim.streams import Streams


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
        The radar; or what a user's own read.
    clock
        Of the pictures' time tags.
    attitude_source
        What a user's own instrument read at the pictures' time tags; None where attitudes are navigation's.
    row
        What the user's own were, as columns of the results.
    """

    approach: Approach
    imu: Imu
    navigation: InertialSolution
    altimeter: RadarAltimeter | InstrumentReadings
    clock: Clock
    attitude_source: InstrumentReadings | None
    row: Mapping[str, Scalar]

    @classmethod
    def drawn(cls, p: DescentScenarioParameters, world: World, flown: Flown, streams: Streams) -> Instruments:
        """The instruments of a case, and what navigation makes of its motion."""
        start, end = -flown.lead_s + MARGIN_S, flown.firing_s + MARGIN_S
        approach = Approach(p.approach, start)
        unit = Imu.drawn(p.imu, (approach.start_s, end), streams.generator("inertial unit"))
        imu = approach.calibrate(unit, streams.generator("inertial unit's calibration"))
        clock = Clock.drawn(p.clock, streams.generator("image clock"))
        own = _own_readings(p, world, flown.motion, _tags(p, clock, streams), streams)
        return cls(
            approach=approach,
            imu=imu,
            navigation=_navigated(p, approach, imu, flown, streams),
            altimeter=own["altimeter"][0]
            if isinstance(p.altimeter, OwnAltimeter)
            else RadarAltimeter.drawn(p.altimeter, world.surface, streams.generator("altimeter")),
            clock=clock,
            attitude_source=own["attitude_source"][0] if "attitude_source" in own else None,
            row={name: value for _, row in own.values() for name, value in row.items()},
        )


def _tags(p: DescentScenarioParameters, clock: Clock, streams: Streams) -> Float64[np.ndarray, "n"]:
    """The pictures' time tags."""
    return clock.tags(np.array(p.picture_times_s), streams.generator("image time tags"))


def _own_readings(
    p: DescentScenarioParameters,
    world: World,
    motion: Trajectory,
    tags_s: Float64[np.ndarray, "n"],
    streams: Streams,
) -> dict[str, tuple[InstrumentReadings, Mapping[str, Scalar]]]:
    """What a user's own instruments read, with their columns, by the table that names them."""
    surface = world.surface
    read: dict[str, tuple[InstrumentReadings, Mapping[str, Scalar]]] = {}
    asked = {"altimeter": np.array(p.picture_times_s), "attitude_source": tags_s}
    for table, times in asked.items():
        own = getattr(p, table)
        if isinstance(own, OwnAltimeter | OwnAttitudeSource):
            truth = InstrumentTruth(
                times_s=times,
                motion=motion,
                ground_height=lambda x, y: float(surface.height(x, y)),
                nearest_ground=lambda apex, axis, half, far: first_return(surface, apex, axis, half, far),
            )
            readings = own.read(truth, streams.generator(f"own {table}"))
            read[table] = readings, own.columns(table, readings.columns)
    return read


def _navigated(
    p: DescentScenarioParameters, approach: Approach, imu: Imu, flown: Flown, streams: Streams
) -> InertialSolution:
    """Navigation from the last star reference, before entry, to the thrusters' firing."""
    start, end = approach.end_s, flown.firing_s + MARGIN_S
    errors = approach.errors(imu, streams.generator("approach"))
    increments = imu.increments(flown.motion, start, end, streams.generator("inertial noise"))
    state = flown.motion.state(start)
    attitude, velocity = errors.apply(state.attitude, state.velocity_m_s)
    return InertialSolution.propagate(increments, attitude, velocity, gravity_m_s2(p))


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
    tags = _tags(p, instruments.clock, streams)
    model = calibrated_camera(p.camera, streams.generator("camera calibration"))
    camera = model.binned(columns=1, rows=p.detector.rows_summed)
    images = [
        DetectorImage(counts, float(tag), camera, detector.calibration)
        for counts, tag in zip(pictures, tags, strict=True)
    ]
    attitudes = [
        AttitudeMeasurement(attitude, float(tag))
        for attitude, tag in zip(_attitudes(instruments, tags), tags, strict=True)
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


def _attitudes(instruments: Instruments, tags_s: Float64[np.ndarray, "n"]) -> Rotation:
    """Attitudes at the pictures' time tags: navigation's, or a user's own."""
    own = instruments.attitude_source
    return instruments.navigation.attitude(tags_s) if own is None else attitudes_of(own)


def _altitudes(
    motion: Trajectory,
    times_s: Float64[np.ndarray, "n"],
    altimeter: RadarAltimeter | InstrumentReadings,
    streams: Streams,
) -> list[AltitudeMeasurement]:
    """The radar's last readings before the pictures, or those of a user's own altimeter, with their own tags."""
    readings: Readings | InstrumentReadings
    if isinstance(altimeter, RadarAltimeter):
        at = altimeter.sampling.latest(times_s)
        readings = altimeter.measure(motion, at, streams.generator("altimeter noise"))
    else:
        readings = altimeter
    return [
        AltitudeMeasurement(float(value), float(tag))
        for value, tag in zip(readings.values, readings.times_s, strict=True)
    ]
