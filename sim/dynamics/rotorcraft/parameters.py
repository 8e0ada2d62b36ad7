"""What may be set of a small helicopter, its flight for pictures and its landing."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field

from marsyard.sim.dynamics.rotorcraft.kernels import Craft
from marsyard.sim.parameters import NonNegative, Parameters, Positive

Gain = Annotated[float, Field(gt=0.0, le=10.0)]


class VibrationParameters(Parameters):
    """What the main rotor shakes: a sine along and about each axis, of drawn phase. All assumed.

    A rotor of 1.8 m at 22 turns per second has a tip speed of 125 m/s, usual for its size.
    """

    rate_hz: Annotated[Positive, Field(le=45.0, description="turns of the rotor per second")] = 22.0
    acceleration_m_s2: Annotated[NonNegative, Field(le=20.0, description="amplitude along each world axis, m/s2")] = 1.5
    angle_deg: Annotated[NonNegative, Field(le=1.0, description="amplitude of yaw, pitch and roll, deg")] = 0.03


class AirParameters(Parameters):
    """The wind at the helicopter: a mean, and gusts correlated in time (first-order, as Dryden's along the flow)."""

    east_m_s: Annotated[float, Field(ge=-15.0, le=15.0, description="mean wind towards the east, m/s")] = 1.0
    north_m_s: Annotated[float, Field(ge=-15.0, le=15.0, description="mean wind towards the north, m/s")] = 1.0
    gust_m_s: Annotated[NonNegative, Field(le=5.0, description="gusts, one standard deviation per horizontal axis")] = (
        0.7
    )
    vertical_gust_m_s: Annotated[NonNegative, Field(le=5.0, description="vertical gusts, one standard deviation")] = 0.2
    correlation_s: Annotated[Positive, Field(le=60.0, description="correlation time of the gusts, s")] = 2.0


class RotorcraftParameters(Parameters):
    """A helicopter of the class of JPL's (2 m long, gas powered) with its autopilot.

    The paper gives no figure of either. All assumed: an attitude loop of about 1 Hz and position loops several times
    slower, as such helicopters fly.
    """

    drag_s: Annotated[Positive, Field(description="time in which drag alone halts it by 1/e, s")] = 5.0
    attitude_hz: Annotated[Positive, Field(le=5.0, description="natural frequency of pitch and roll, 1/s")] = 0.9
    heading_hz: Annotated[Positive, Field(le=5.0, description="natural frequency of yaw, 1/s")] = 0.5
    damping: Annotated[Positive, Field(le=2.0, description="damping ratio of the angles")] = 0.8
    thrust_lag_s: Annotated[Positive, Field(le=1.0, description="time constant of the thrust, s")] = 0.15
    most_tilt_deg: Annotated[Positive, Field(le=30.0, description="greatest pitch or roll commanded, deg")] = 12.0
    gust_tilt_deg_s_m: Annotated[NonNegative, Field(le=10.0, description="tilt by a gust, deg per m/s")] = 0.8
    gust_yaw_deg_s_m: Annotated[NonNegative, Field(le=10.0, description="turn into a gust, deg per m/s")] = 0.8
    place_gain: Annotated[Gain, Field(description="speed commanded per distance, 1/s")] = 0.5
    speed_gain: Annotated[Gain, Field(description="acceleration commanded per error of speed, 1/s")] = 1.2
    trim_gain: Annotated[NonNegative, Field(le=5.0, description="growth of trim per error of speed, 1/s2")] = 0.3
    delay_s: Annotated[
        float, Field(ge=0.0, le=0.5, description="from the state to the autopilot's command on it, s")
    ] = 0.1
    gear_m: Annotated[NonNegative, Field(le=5.0, description="height of camera and instruments above the skids, m")] = (
        0.4
    )
    contact_s: Annotated[Positive, Field(le=1.0, description="time in which the ground halts it by 1/e, s")] = 0.1
    step_s: Annotated[Positive, Field(le=0.05, description="step of the simulation, s")] = 0.02
    vibration: VibrationParameters = VibrationParameters()

    def craft(self, gravity_m_s2: float) -> Craft:
        """As the kernels take it."""
        rad, turn = math.radians(1.0), 2.0 * math.pi
        return Craft(
            gravity_m_s2=gravity_m_s2,
            drag_s=self.drag_s,
            attitude_rad_s=turn * self.attitude_hz,
            attitude_damping=self.damping,
            heading_rad_s=turn * self.heading_hz,
            thrust_lag_s=self.thrust_lag_s,
            most_tilt_rad=rad * self.most_tilt_deg,
            gust_tilt_s_m=rad * self.gust_tilt_deg_s_m,
            gust_yaw_s_m=rad * self.gust_yaw_deg_s_m,
            place_gain=self.place_gain,
            speed_gain=self.speed_gain,
            trim_gain=self.trim_gain,
            delay_steps=round(self.delay_s / self.step_s),
            gear_m=self.gear_m,
            contact_s=self.contact_s,
        )


class TransitParameters(Parameters):
    """The flight at constant height while pictures are taken (paper, V). Height and the number of pictures are its own.

    "Several seconds" are taken as five. Time 0 is the first picture's.
    """

    height_m: Annotated[Positive, Field(le=200.0, description="height above the ground below the first picture, m")] = (
        10.0
    )
    speed_m_s: Annotated[Positive, Field(le=15.0, description="commanded speed, m/s (assumed)")] = 1.0
    acceleration_m_s2: Annotated[Positive, Field(le=3.0, description="up to that speed, m/s2 (assumed)")] = 1.0
    hover_s: Annotated[NonNegative, Field(le=600.0, description="hovering before, s (assumed)")] = 15.0
    settle_s: Annotated[NonNegative, Field(le=60.0, description="at speed before the first picture, s (assumed)")] = 1.5
    pictures: Annotated[int, Field(ge=2, le=1000, description="pictures taken")] = 40
    pictures_s: Annotated[Positive, Field(le=120.0, description="from the first to the last picture, s")] = 5.0

    @property
    def lead_s(self) -> float:
        """From the flight's start to the first picture."""
        return self.hover_s + self.speed_m_s / self.acceleration_m_s2 + self.settle_s


class LandingGuidance(Parameters):
    """From the pictures to the ground (paper, V).

    The distances of 2 m and 1.5 m are the paper's, the wait is its run time; the rest is assumed. The paper says of the
    descent that it goes on reducing the distance from the site, and of what follows below 1.5 m only that the blades'
    pitch is slowly changed: there it stops its drift, but goes for the site no more.
    """

    wait_s: Annotated[NonNegative, Field(le=60.0, description="from the last picture until the site is known, s")] = 1.8
    approach_m_s: Annotated[Positive, Field(le=15.0, description="greatest commanded speed to the site, m/s")] = 2.0
    near_m: Annotated[Positive, Field(le=50.0, description="distance from the site at which it descends, m")] = 2.0
    descent_m_s: Annotated[Positive, Field(le=5.0, description="commanded speed of the descent, m/s")] = 0.7
    flare_range_m: Annotated[Positive, Field(le=20.0, description="laser range below which it lands, m")] = 1.5
    flare_m_s: Annotated[Positive, Field(le=5.0, description="commanded speed of sinking when it lands, m/s")] = 0.3
    longest_s: Annotated[Positive, Field(le=600.0, description="after which it has not landed, s")] = 60.0
    rest_s: Annotated[NonNegative, Field(le=60.0, description="known after touchdown, s")] = 7.0
