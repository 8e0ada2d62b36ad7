"""What can go wrong in a descent: each fault by its size, all of them off by default."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from marsyard.scenarios.faults import Pictures, SizedFaults, deliver
from marsyard.sim.measurements import AltitudeMeasurement, AttitudeMeasurement
from marsyard.sim.parameters import NonNegative
from marsyard.sim.render.clouds import CloudLayer, CloudParameters
from marsyard.sim.terrain import TerrainParameters
from marsyard.sim.terrain.landforms import Dunes

#: Noise in a burst on the cable and its length: a third of the picture's signal, over two delivered rows.
BURST_DN, BURST_PX = 300.0, 2048.0
#: Dunes as regular as wind makes them.
REPETITIVE = Dunes(wavelength_m=60.0, height_m=1.0, crest_length=20.0, regularity=12.0)
#: Picture that a fault of one picture strikes, from 0: it is in both pairs.
STRUCK = 1


class Faults(SizedFaults):
    """Faults of a descent."""

    heat_shield_deg: Annotated[
        NonNegative,
        Field(le=90.0, description="angle that the heat shield takes in the first picture, deg; it falls ahead"),
    ] = 0.0
    cloud_cover: Annotated[NonNegative, Field(le=0.9, description="share of the ground in moving cloud shadows")] = 0.0
    haze: Annotated[
        NonNegative, Field(le=10.0, description="optical depth of the air over 2000 m, which veils the ground")
    ] = 0.0
    dunes_m: Annotated[NonNegative, Field(le=30.0, description="height of regular dunes that cover the ground, m")] = (
        0.0
    )
    cable_bursts: Annotated[
        NonNegative, Field(le=1e4, description="mean number of noise bursts on the cable in a picture")
    ] = 0.0
    late_s: Annotated[
        NonNegative, Field(le=3.0, description="by how much the second picture is later than its tag, s")
    ] = 0.0
    repeated_picture: Annotated[
        int, Field(ge=0, le=3, description="picture that is delivered as the one before it, 2 or 3; 0: none")
    ] = 0
    black_picture: Annotated[int, Field(ge=0, le=3, description="picture that is delivered black, 1 to 3; 0: none")] = 0
    altitude_error: Annotated[NonNegative, Field(le=0.9, description="share by which all altitudes are too high")] = 0.0
    altitude_error_once: Annotated[
        NonNegative, Field(le=0.9, description="share by which the second altitude is too high")
    ] = 0.0
    attitude_error_deg: Annotated[
        NonNegative, Field(le=90.0, description="tilt by which all attitudes are wrong, deg")
    ] = 0.0
    attitude_error_once_deg: Annotated[
        NonNegative, Field(le=90.0, description="tilt by which the second attitude is wrong, deg")
    ] = 0.0

    def detector_changes(self) -> dict[str, Mapping[str, float | bool]]:
        """Also the cable that is struck."""
        bursts = {"bursts": self.cable_bursts, "length_px": BURST_PX, "amplitude_dn": BURST_DN}
        return {**super().detector_changes(), "bursts": bursts if self.cable_bursts else {}}


def faulty_terrain(faults: Faults, terrain: TerrainParameters) -> TerrainParameters:
    """The terrain, under regular dunes where the fault asks for them."""
    if faults.dunes_m == 0.0:
        return terrain
    dunes = REPETITIVE.model_copy(update={"height_m": faults.dunes_m})
    return terrain.model_copy(update={"dunes": dunes, "rocks": None, "craters_per_km2": 0.0})


def clouds_over(faults: Faults, ground_m: float, rng: np.random.Generator) -> CloudLayer | None:
    """The clouds whose shadows move over ground of this height, drawn; None without the fault."""
    if faults.cloud_cover == 0.0:
        return None
    return CloudLayer.draw(CloudParameters(cover=faults.cloud_cover), rng, ground_m=ground_m)


def faulty_times(faults: Faults, times_s: Sequence[float]) -> list[float]:
    """When pictures are truly taken that should be at these times."""
    return [time + faults.late_s * (number == STRUCK) for number, time in enumerate(times_s)]


def delivered(faults: Faults, pictures: Pictures) -> list[np.ndarray]:
    """The pictures as they arrive."""
    return deliver(pictures, faults.repeated_picture, faults.black_picture)


def faulty_altitudes(faults: Faults, altitudes: Sequence[AltitudeMeasurement]) -> list[AltitudeMeasurement]:
    """Altitudes with errors beyond what the instrument makes."""
    shares = [faults.altitude_error + faults.altitude_error_once * (n == STRUCK) for n in range(len(altitudes))]
    return [
        AltitudeMeasurement(one.altitude_m * (1.0 + share), one.time_s)
        for one, share in zip(altitudes, shares, strict=True)
    ]


def faulty_attitudes(
    faults: Faults, attitudes: Sequence[AttitudeMeasurement], rng: np.random.Generator
) -> list[AttitudeMeasurement]:
    """Attitudes tilted about horizontal axes, drawn, one for the common error and one for that of a single picture."""
    axes = [np.array([np.cos(turn), np.sin(turn), 0.0]) for turn in rng.uniform(-np.pi, np.pi, 2)]
    always = Rotation.from_rotvec(np.radians(faults.attitude_error_deg) * axes[0])
    once = Rotation.from_rotvec(np.radians(faults.attitude_error_once_deg) * axes[1])
    return [
        AttitudeMeasurement((once if n == STRUCK else Rotation.identity()) * always * one.world_from_body, one.time_s)
        for n, one in enumerate(attitudes)
    ]
