"""Faults of a descent, each by its size; all are off by default."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from marsyard.scenarios.conditions import SizedFaults
from marsyard.sim.measurements import AltitudeMeasurement, AttitudeMeasurement
from marsyard.sim.parameters import NonNegative, bounded
from marsyard.sim.render.photometry import CloudLayer, CloudParameters
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
