"""Parameters of shared drives: runs of a drive, targets on its rock, and the case's choice of them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.sim.parameters import Parameters


class VariantParameters(Parameters):
    """Rock, terrain and sun of one run; `SharedDriveParameters.run` is the index of a run."""

    terrain: Annotated[int, Field(ge=0, description="number of the terrain in the bank, from 0")] = 0
    diameter_m: Annotated[float, Field(gt=0.01, le=5.0, description="diameter of the rock")] = 1.4
    height_m: Annotated[float, Field(gt=0.01, le=5.0, description="height of the rock")] = 0.8
    shape: Annotated[int, Field(ge=0, le=31, description="number of the rock's shape, see PlacedRock")] = 0
    yaw_deg: Annotated[float, Field(description="yaw of the rock, deg")] = 0.0
    sun_azimuth_deg: Annotated[
        float, Field(ge=-360.0, le=720.0, description="azimuth of the sun, clockwise from north")
    ] = 225.0
    sun_elevation_deg: Annotated[float, Field(gt=3.0, le=90.0, description="elevation of the sun")] = 45.0


class PointParameters(Parameters):
    """A target on the rock's face, seen from the start of the drive, or from the middle of a circular drive."""

    across: Annotated[float, Field(ge=-1.0, le=1.0, description="-1 at the rock's left edge, 1 at its right")] = 0.0
    up: Annotated[float, Field(ge=0.0, le=1.0, description="0 at the rock's foot, 1 at its top")] = 0.5


class StepRangeParameters(Parameters):
    """A range of steps; requirements select cases by a boolean column with this name."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z]\w*$")]
    min: float = 0.0
    max: float = 1.0


class SharedDriveParameters(Parameters):
    """Drives whose images many cases use; each case has its own target and step.

    `run`, `target`, `skipped_stops`, `drive.algorithm` and `drive.vtt` define a case.
    """

    drive: Annotated[RoverScenarioParameters, Field(description="drive with its smallest steps, and the tracker")]
    variants: Annotated[
        tuple[VariantParameters, ...], Field(min_length=1, description="rock, terrain, sun of each run")
    ]
    targets: Annotated[tuple[PointParameters, ...], Field(min_length=1, description="points on every run's rock")]
    run: Annotated[int, Field(ge=0, description="index of the run")] = 0
    target: Annotated[int, Field(ge=0, description="index of the target")] = 0
    skipped_stops: Annotated[int, Field(ge=0, le=100, description="stops skipped between two updates")] = 0
    margin_px: Annotated[float, Field(gt=0.0, description="margin around the rock in the images")] = 110.0
    steering: Annotated[
        Literal["estimate", "oracle-target"],
        Field(description="position that guides the drive: designated and propagated by odometry, or the true one"),
    ] = "estimate"
    step_ranges: Annotated[tuple[StepRangeParameters, ...], Field(description="ranges of steps")] = ()
    max_obliquity_deg: float | None = Field(
        default=None, gt=0.0, le=90.0, description="maximum obliquity of the face at a target for the column `on_face`"
    )

    @model_validator(mode="after")
    def _check_numbers(self) -> SharedDriveParameters:
        for name, index, count in (("run", self.run, len(self.variants)), ("target", self.target, len(self.targets))):
            if index >= count:
                raise ValueError(f"{name} is {index}; allowed: 0 to {count - 1}")
        bank = self.drive.world.bank
        for number, variant in enumerate(self.variants):
            if variant.terrain >= bank:
                raise ValueError(f"variants[{number}].terrain is {variant.terrain}; allowed: 0 to {bank - 1}, the bank")
        if self.drive.variants:
            raise ValueError("drive.variants are runs of the scenario 'rover'; allowed in a shared drive: variants")
        if len(self.drive.legs) != 1:
            raise ValueError(f"a shared drive must have one leg, not {len(self.drive.legs)}")
        return self

    @property
    def step(self) -> float:
        """Step between two updates: degrees of a turn or circle, fixed length (m), or fraction of the distance."""
        leg = self.drive.legs[0]
        if leg.motion in ("turn", "circle"):
            return abs(leg.step_deg) * (self.skipped_stops + 1)
        if leg.step_m is not None:
            return abs(leg.step_m) * (self.skipped_stops + 1)
        return float(1.0 - (1.0 - leg.step_fraction) ** (self.skipped_stops + 1))
