"""Parameters of a helicopter flight."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from pydantic import Field

from marsyard.sim.dynamics import rotorcraft
from marsyard.sim.error_sources import COMPASS, INERTIAL, RECEIVER
from marsyard.sim.parameters import Parameters
from marsyard.sim.sensor.gps import RtkParameters
from marsyard.sim.sensor.helicopter_navigation import FilterParameters
from marsyard.sim.sensor.imu import SMALL_UNIT, ImuParameters
from marsyard.sim.sensor.instrument import ClockParameters
from marsyard.sim.sensor.tilt_compass import TiltCompassParameters


class LandingHelicopterParameters(Parameters):
    """Parameters of a helicopter flight: vehicle, air, guidance and instruments."""

    craft: rotorcraft.RotorcraftParameters = rotorcraft.RotorcraftParameters()
    air: rotorcraft.AirParameters = rotorcraft.AirParameters()
    transit: rotorcraft.TransitParameters = rotorcraft.TransitParameters()
    guidance: rotorcraft.LandingGuidance = rotorcraft.LandingGuidance()
    # the filter is tuned with the parameters of its sensors
    imu: Annotated[ImuParameters, INERTIAL] = SMALL_UNIT
    rtk: Annotated[RtkParameters, replace(RECEIVER, remaining=0.1)] = RtkParameters()
    compass: Annotated[TiltCompassParameters, replace(COMPASS, remaining=0.1)] = TiltCompassParameters()
    navigation: FilterParameters = FilterParameters()
    image_clock: ClockParameters = Field(
        default=ClockParameters(offset_sd_s=0.001, jitter_sd_s=0.0005), description="errors of the time tags (assumed)"
    )
    averaging_after_s: float = Field(
        default=2.0, ge=2.0, le=3600.0, description="start of the average after touchdown (assumed)"
    )
    averaging_s: float = Field(
        default=5.0, gt=0.0, le=600.0, description="duration of the average: dozens of solutions, as in the paper"
    )

    @property
    def span_s(self) -> tuple[float, float]:
        """Time span from the flight's start to its latest possible end, with 1 s of margin."""
        end = (
            self.transit.imaging_duration_s + self.guidance.wait_s + self.guidance.max_duration_s + self.guidance.rest_s
        )
        return -self.transit.lead_s, end + 1.0

    @property
    def receiver_span_s(self) -> tuple[float, float]:
        """Time span from the flight's start to the latest averaged solution on the ground."""
        start, end = self.span_s
        return start, end + self.averaging_after_s + self.averaging_s
