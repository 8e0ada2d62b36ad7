"""Measurements of a descent: pictures, attitudes from a star reference, altitudes, velocity changes; and faults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64, UInt16
from pydantic import Field
from scipy.spatial.transform import Rotation

from marsyard.scenarios.conditions import SizedFaults
from marsyard.scenarios.descent.exposure import World, calibrated_camera
from marsyard.scenarios.descent.flight import MARGIN_S, DescentFlight, gravity_m_s2
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.parts.instruments import (
    CustomAltimeter,
    CustomAttitudeSource,
    InstrumentReadings,
    InstrumentTruth,
)
from marsyard.sim.dynamics import Trajectory
from marsyard.sim.measurements import AltitudeMeasurement, AttitudeMeasurement, DescentMeasurements, DetectorImage
from marsyard.sim.parameters import NonNegative, bounded
from marsyard.sim.render.photometry import CloudLayer, CloudParameters
from marsyard.sim.sensor import Approach, Clock, Detector, Imu, InertialSolution, RadarAltimeter, Readings
from marsyard.sim.sensor.ranging import first_return
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import TerrainParameters
from marsyard.sim.terrain.landforms import Dunes

#: Amplitude and length of a noise burst on the cable: a third of the picture's signal, over two delivered rows.
BURST_DN, BURST_PX = 300.0, 2048.0
#: Regular dunes.
REGULAR_DUNES = Dunes(wavelength_m=60.0, height_m=1.0, crest_length=20.0, regularity=12.0)
#: Index of the picture that single-picture faults affect: it is in both pairs.
FAULTY_PICTURE = 1


class Faults(SizedFaults):
    """Faults of a descent."""

    heat_shield_deg: Annotated[
        NonNegative, Field(le=90.0, description="angular diameter of the falling heat shield in the first picture")
    ] = 0.0
    cloud_cover: Annotated[NonNegative, Field(le=0.9, description="fraction of the ground in cloud shadows")] = 0.0
    haze: Annotated[NonNegative, Field(le=10.0, description="optical depth of dusty air over 2000 m")] = 0.0
    dunes_m: Annotated[NonNegative, Field(le=30.0, description="height of regular dunes on all of the ground")] = 0.0
    cable_bursts: Annotated[NonNegative, Field(le=1e4, description="mean number of noise bursts in a picture")] = 0.0
    late_s: Annotated[NonNegative, Field(le=3.0, description="delay of the second picture after its time tag")] = 0.0
    repeated_picture: Annotated[int, bounded(0, 3, "picture delivered as the previous one, 2 or 3; 0: none")] = 0
    black_picture: Annotated[int, bounded(0, 3, "picture that is delivered black, 1 to 3; 0: none")] = 0
    altitude_error: Annotated[NonNegative, Field(le=0.9, description="relative error of all altitudes, too high")] = 0.0
    altitude_error_once: Annotated[NonNegative, Field(le=0.9, description="the same of the second altitude")] = 0.0
    attitude_error_deg: Annotated[NonNegative, Field(le=90.0, description="tilt error of all attitudes")] = 0.0
    attitude_error_once_deg: Annotated[NonNegative, Field(le=90.0, description="the same of the second attitude")] = 0.0

    def detector_changes(self) -> dict[str, Mapping[str, float | bool]]:
        """Changed detector parameters, noise bursts on the cable included."""
        bursts = {"bursts": self.cable_bursts, "length_px": BURST_PX, "amplitude_dn": BURST_DN}
        return {**super().detector_changes(), "bursts": bursts if self.cable_bursts else {}}


def faulty_terrain(faults: Faults, terrain: TerrainParameters) -> TerrainParameters:
    """The terrain, or regular dunes on it with that fault."""
    if faults.dunes_m == 0.0:
        return terrain
    dunes = REGULAR_DUNES.model_copy(update={"height_m": faults.dunes_m})
    return terrain.model_copy(update={"dunes": dunes, "rocks": None, "craters_per_km2": 0.0})


def draw_clouds(faults: Faults, ground_m: float, rng: np.random.Generator) -> CloudLayer | None:
    """Draw clouds whose shadows move over ground of this height; None without the fault."""
    if faults.cloud_cover == 0.0:
        return None
    return CloudLayer.draw(CloudParameters(cover=faults.cloud_cover), rng, ground_m=ground_m)


def faulty_times(faults: Faults, times_s: Sequence[float]) -> list[float]:
    """True times of pictures due at these times."""
    return [time + faults.late_s * (number == FAULTY_PICTURE) for number, time in enumerate(times_s)]


def faulty_altitudes(faults: Faults, altitudes: Sequence[AltitudeMeasurement]) -> list[AltitudeMeasurement]:
    """Altitudes with the faults' errors added to the instrument's."""
    errors = [faults.altitude_error + faults.altitude_error_once * (n == FAULTY_PICTURE) for n in range(len(altitudes))]
    return [
        AltitudeMeasurement(one.altitude_m * (1.0 + error), one.time_s)
        for one, error in zip(altitudes, errors, strict=True)
    ]


def faulty_attitudes(
    faults: Faults, attitudes: Sequence[AttitudeMeasurement], rng: np.random.Generator
) -> list[AttitudeMeasurement]:
    """Attitudes tilted about drawn horizontal axes: one of the common error, one of the single picture's error."""
    axes = [np.array([np.cos(turn), np.sin(turn), 0.0]) for turn in rng.uniform(-np.pi, np.pi, 2)]
    common = Rotation.from_rotvec(np.radians(faults.attitude_error_deg) * axes[0])
    once = Rotation.from_rotvec(np.radians(faults.attitude_error_once_deg) * axes[1])
    return [
        AttitudeMeasurement(
            (once if n == FAULTY_PICTURE else Rotation.identity()) * common * one.world_from_body, one.time_s
        )
        for n, one in enumerate(attitudes)
    ]


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
        unit = Imu.drawn(p.imu, (approach.start_s, end), streams.generator("inertial unit"))
        imu = approach.calibrate(unit, streams.generator("inertial unit's calibration"))
        clock = Clock.drawn(p.clock, streams.generator("image clock"))
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
            else RadarAltimeter.drawn(p.altimeter, world.surface, streams.generator("altimeter")),
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
    camera = model.binned(columns=1, rows=p.detector.rows_summed)
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
