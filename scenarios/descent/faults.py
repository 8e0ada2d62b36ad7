"""Faults of a descent, and their injection into terrain, clouds, times and measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator
from scipy.spatial.transform import Rotation

from marsyard.scenarios.case_faults import Haze, SizedFaults
from marsyard.scenarios.heat_shield import SHIELD_FALL_M_S
from marsyard.sim.error_sources import CLOUDS, DETECTOR
from marsyard.sim.measurements import AltitudeMeasurement, AttitudeMeasurement
from marsyard.sim.parameters import NonNegative, bounded_field
from marsyard.sim.render.clouds import CloudLayer, CloudParameters
from marsyard.sim.sensor.detector import BURST_DN, BURST_PX
from marsyard.sim.terrain import TerrainParameters
from marsyard.sim.terrain.landforms import Dunes

#: Regular dunes of the dune fault.
REGULAR_DUNES = Dunes(wavelength_m=60.0, height_m=1.0, crest_length=20.0, regularity=12.0)
#: Faults of instruments, which have no effect on measurements without errors.
INSTRUMENT_FAULTS = (
    "exposure_delay_s", "shield_range_m", "altitude_error", "altitude_error_once", "attitude_error_deg",
    "attitude_error_once_deg",
)  # fmt: skip
#: Index of the image that single-image faults affect; it belongs to both pairs.
FAULTY_IMAGE = 1


class DescentFaults(SizedFaults):
    """Faults of a descent."""

    heat_shield_deg: Annotated[
        NonNegative, Field(le=90.0, description="angular diameter of the falling heat shield in the first image")
    ] = 0.0
    cloud_cover: Annotated[
        NonNegative, CLOUDS, Field(le=0.9, description="fraction of the ground in cloud shadows")
    ] = 0.0
    haze: Haze = 0.0
    dunes_m: Annotated[NonNegative, Field(le=30.0, description="height of regular dunes on the whole terrain")] = 0.0
    cable_bursts: Annotated[NonNegative, DETECTOR, Field(le=1e4, description="mean interference bursts per image")] = (
        0.0
    )
    exposure_delay_s: Annotated[
        NonNegative, Field(le=3.0, description="delay of the second exposure after its time tag")
    ] = 0.0
    repeated_image: Annotated[int, bounded_field(0, 3, "image replaced by the previous one, 2 or 3; 0: none")] = 0
    black_image: Annotated[int, bounded_field(0, 3, "image that is delivered black, 1 to 3; 0: none")] = 0
    shield_range_m: Annotated[
        NonNegative,
        Field(
            le=2000.0, description="range to the heat shield in image 1, if the radar is locked on it; 0: not locked"
        ),
    ] = 0.0
    altitude_error: Annotated[NonNegative, Field(le=0.9, description="relative excess of all altitudes")] = 0.0
    altitude_error_once: Annotated[
        NonNegative, Field(le=0.9, description="additional relative error of the altitude of image 2")
    ] = 0.0
    attitude_error_deg: Annotated[
        NonNegative, Field(le=90.0, description="tilt error of the navigation's attitude, and of its velocity changes")
    ] = 0.0
    attitude_error_once_deg: Annotated[
        NonNegative, Field(le=90.0, description="additional tilt error of the attitude of image 2")
    ] = 0.0

    @field_validator("repeated_image")
    @classmethod
    def _check_repeated_image(cls, number: int) -> int:
        if number == 1:
            raise ValueError("repeated_image is 1, which no image precedes; allowed: 2 or 3, or 0 for none")
        return number

    def detector_changes(self) -> dict[str, Mapping[str, float | bool]]:
        """Return the detector parameters that the faults change, including interference bursts on the camera cable."""
        bursts = {"bursts": self.cable_bursts, "length_px": BURST_PX, "amplitude_dn": BURST_DN}
        return {**super().detector_changes(), "bursts": bursts if self.cable_bursts else {}}


def add_terrain_fault(faults: DescentFaults, terrain: TerrainParameters) -> TerrainParameters:
    """Return the terrain; the dune fault adds regular dunes and removes rocks and craters."""
    if faults.dunes_m == 0.0:
        return terrain
    dunes = REGULAR_DUNES.model_copy(update={"height_m": faults.dunes_m})
    return terrain.model_copy(update={"dunes": dunes, "rocks": None, "craters_per_km2": 0.0})


def draw_clouds(faults: DescentFaults, ground_m: float, rng: np.random.Generator) -> CloudLayer | None:
    """Draw the clouds of the cloud fault over ground at this height; None without the fault."""
    if faults.cloud_cover == 0.0:
        return None
    return CloudLayer.draw(CloudParameters(cover=faults.cloud_cover), rng, ground_m=ground_m)


def add_time_fault(faults: DescentFaults, times_s: Sequence[float]) -> list[float]:
    """Return the true exposure times of images commanded at these times."""
    return [time + faults.exposure_delay_s * (index == FAULTY_IMAGE) for index, time in enumerate(times_s)]


def add_altitude_faults(faults: DescentFaults, altitudes: Sequence[AltitudeMeasurement]) -> list[AltitudeMeasurement]:
    """Add the faults' relative errors to measured altitudes, or replace the altitudes by ranges to the heat shield."""
    if faults.shield_range_m:
        first_s = altitudes[0].time_s
        return [
            AltitudeMeasurement(faults.shield_range_m + SHIELD_FALL_M_S * (altitude.time_s - first_s), altitude.time_s)
            for altitude in altitudes
        ]
    errors = [
        faults.altitude_error + faults.altitude_error_once * (index == FAULTY_IMAGE) for index in range(len(altitudes))
    ]
    return [
        AltitudeMeasurement(altitude.altitude_m * (1.0 + error), altitude.time_s)
        for altitude, error in zip(altitudes, errors, strict=True)
    ]


@dataclass(frozen=True)
class AttitudeTilts:
    """Tilts of the attitude faults, rotations in world axes about random horizontal axes.

    - common: tilt of the navigation's attitude from the start of the descent, and of a custom attitude source
    - single: additional tilt of the measured attitude of `FAULTY_IMAGE`
    """

    common: Rotation
    single: Rotation

    @classmethod
    def draw(cls, faults: DescentFaults, rng: np.random.Generator) -> AttitudeTilts:
        """Draw the axes of both tilts; a fault of size 0 is the identity."""
        axes = [np.array([np.cos(azimuth), np.sin(azimuth), 0.0]) for azimuth in rng.uniform(-np.pi, np.pi, 2)]
        sizes_deg = (faults.attitude_error_deg, faults.attitude_error_once_deg)
        common, single = (
            Rotation.from_rotvec(np.radians(size) * axis) for size, axis in zip(sizes_deg, axes, strict=True)
        )
        return cls(common, single)

    def tilt_faulty_image(self, attitudes: Sequence[AttitudeMeasurement]) -> list[AttitudeMeasurement]:
        """Tilt the measured attitude of `FAULTY_IMAGE` by the single tilt."""
        return [
            replace(attitude, world_from_body=self.single * attitude.world_from_body)
            if index == FAULTY_IMAGE
            else attitude
            for index, attitude in enumerate(attitudes)
        ]
