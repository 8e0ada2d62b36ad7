"""Parameters of a helicopter with its autopilot, of the air, and of the two parts of its flight (landing paper, V)."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field, model_validator

from marsyard.sim.dynamics.rotorcraft import kernels
from marsyard.sim.error_sources import VIBRATION, WIND
from marsyard.sim.parameters import NonNegative, Parameters, Positive, bounded_field

Gain = Annotated[float, Field(gt=0.0, le=10.0)]


class VibrationParameters(Parameters):
    """Vibration by the main rotor: a sine along and about each axis with random phase. All values are assumed.

    A rotor of 1.8 m diameter at 22 revolutions per second has a tip speed of 125 m/s, common for this size.
    """

    rate_hz: Annotated[Positive, Field(le=45.0, description="frequency of the rotor, 1/s")] = 22.0
    acceleration_m_s2: Annotated[
        NonNegative, VIBRATION, Field(le=20.0, description="amplitude along each world axis")
    ] = 1.5
    angle_deg: Annotated[NonNegative, VIBRATION, Field(le=1.0, description="amplitude of yaw, pitch and roll")] = 0.03


class AirParameters(Parameters):
    """Wind at the helicopter: mean wind, and gusts as first-order Markov processes (Dryden's longitudinal spectrum)."""

    east_m_s: Annotated[float, WIND, bounded_field(-15.0, 15.0, "mean wind to the east")] = 1.0
    north_m_s: Annotated[float, WIND, bounded_field(-15.0, 15.0, "mean wind to the north")] = 1.0
    gust_m_s: Annotated[NonNegative, WIND, Field(le=5.0, description="RMS of the gusts per horizontal axis")] = 0.7
    vertical_gust_m_s: Annotated[NonNegative, WIND, Field(le=5.0, description="RMS of the vertical gusts")] = 0.2
    correlation_s: Annotated[Positive, Field(le=60.0, description="correlation time of the gusts")] = 2.0


class RotorcraftParameters(Parameters):
    """Parameters of a helicopter similar to JPL's (2 m long, gas powered) and of its autopilot.

    The paper contains no values. All are assumed: an attitude loop of about 1 Hz, position loops several times slower.
    """

    drag_s: Annotated[Positive, Field(description="time constant of the decay of airspeed by drag, s")] = 5.0
    attitude_hz: Annotated[Positive, Field(le=5.0, description="natural frequency of pitch and roll, 1/s")] = 0.9
    heading_hz: Annotated[Positive, Field(le=5.0, description="natural frequency of yaw, 1/s")] = 0.5
    damping: Annotated[Positive, Field(le=2.0, description="damping ratio of the angles")] = 0.8
    thrust_lag_s: Annotated[Positive, Field(le=1.0, description="time constant of the thrust, s")] = 0.15
    max_tilt_deg: Annotated[Positive, Field(le=30.0, description="maximum commanded pitch or roll, deg")] = 12.0
    gust_tilt_deg_s_m: Annotated[NonNegative, Field(le=10.0, description="tilt by a gust, deg per m/s")] = 0.8
    gust_yaw_deg_s_m: Annotated[NonNegative, Field(le=10.0, description="yaw into a gust, deg per m/s")] = 0.8
    position_gain: Annotated[Gain, Field(description="commanded speed / distance, 1/s")] = 0.5
    speed_gain: Annotated[Gain, Field(description="commanded acceleration / speed error, 1/s")] = 1.2
    trim_gain: Annotated[NonNegative, Field(le=5.0, description="rate of trim / speed error, 1/s2")] = 0.3
    delay_s: Annotated[NonNegative, Field(le=0.5, description="delay of the autopilot's command, s")] = 0.1
    gear_m: Annotated[NonNegative, Field(le=5.0, description="height of the camera above the skids, m")] = 0.4
    contact_s: Annotated[Positive, Field(le=1.0, description="time constant of the motion on the ground, s")] = 0.1
    step_s: Annotated[Positive, Field(le=0.05, description="step of the simulation")] = 0.02
    vibration: VibrationParameters = VibrationParameters()

    @model_validator(mode="after")
    def _check_step(self) -> RotorcraftParameters:
        for name in ("drag_s", "contact_s"):
            # at a longer step the simulated velocity oscillates and grows
            if getattr(self, name) <= self.step_s:
                raise ValueError(f"{name} is {getattr(self, name):g}; allowed: above step_s, {self.step_s:g}")
        return self

    def to_kernel(self, gravity_m_s2: float) -> kernels.Craft:
        """Convert the parameters to SI units for the kernels."""
        rad_per_deg, rad_per_cycle = math.radians(1.0), 2.0 * math.pi
        return kernels.Craft(
            **self.model_dump(include=set(kernels.Craft._fields)),
            gravity_m_s2=gravity_m_s2,
            attitude_rad_s=rad_per_cycle * self.attitude_hz,
            attitude_damping=self.damping,
            heading_rad_s=rad_per_cycle * self.heading_hz,
            max_tilt_rad=rad_per_deg * self.max_tilt_deg,
            gust_tilt_s_m=rad_per_deg * self.gust_tilt_deg_s_m,
            gust_yaw_s_m=rad_per_deg * self.gust_yaw_deg_s_m,
            delay_steps=round(self.delay_s / self.step_s),
        )


class TransitParameters(Parameters):
    """Parameters of the flight at constant height during which images are taken (paper, V).

    Height and number of images are assumed. The paper's "several seconds" are 5 s. Time 0 is the time of the first
    image.
    """

    height_m: Annotated[Positive, Field(le=200.0, description="height above ground at the first image")] = 10.0
    speed_m_s: Annotated[Positive, Field(le=15.0, description="commanded speed, m/s (assumed)")] = 1.0
    acceleration_m_s2: Annotated[Positive, Field(le=3.0, description="acceleration to that speed (assumed)")] = 1.0
    hover_s: Annotated[NonNegative, Field(le=600.0, description="duration of the initial hover, s (assumed)")] = 15.0
    settle_s: Annotated[
        NonNegative, Field(le=60.0, description="duration at constant speed before the first image, s (assumed)")
    ] = 1.5
    images: Annotated[int, bounded_field(2, 1000, "number of images")] = 40
    imaging_duration_s: Annotated[
        Positive, Field(le=120.0, description="duration from the first to the last image, s")
    ] = 5.0

    @property
    def lead_s(self) -> float:
        """Time from the flight's start to the first image."""
        return self.hover_s + self.speed_m_s / self.acceleration_m_s2 + self.settle_s


class LandingGuidance(Parameters):
    """Parameters of the guidance from the last image to the ground (paper, V).

    The distances of 2 m and 1.5 m are from the paper, and `wait_s` is the run time of its algorithm; the other values
    are assumed. In the paper the helicopter approaches the site during the descent, and below 1.5 m only the collective
    pitch is reduced slowly. In this model the autopilot controls the velocity below that height, not the position.
    """

    wait_s: Annotated[NonNegative, Field(le=60.0, description="from the last image to the answer, s")] = 1.8
    approach_m_s: Annotated[Positive, Field(le=15.0, description="maximum commanded speed to the site")] = 2.0
    near_m: Annotated[Positive, Field(le=50.0, description="distance from the site at which the descent begins")] = 2.0
    descent_m_s: Annotated[Positive, Field(le=5.0, description="commanded speed of the descent, m/s")] = 0.7
    flare_range_m: Annotated[Positive, Field(le=20.0, description="laser range at which the flare begins, m")] = 1.5
    flare_m_s: Annotated[Positive, Field(le=5.0, description="commanded sink rate of the flare, m/s")] = 0.3
    max_duration_s: Annotated[Positive, Field(le=600.0, description="limit of the landing's duration, s")] = 60.0
    rest_s: Annotated[NonNegative, Field(le=60.0, description="simulated time after the touchdown, s")] = 7.0
