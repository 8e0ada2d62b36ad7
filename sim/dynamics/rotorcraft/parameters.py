"""Parameters of a small helicopter, its flight while pictures are taken, and its landing."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field

from marsyard.sim.dynamics.rotorcraft.kernels import Craft
from marsyard.sim.parameters import NonNegative, Parameters, Positive, bounded

Gain = Annotated[float, Field(gt=0.0, le=10.0)]


class VibrationParameters(Parameters):
    """Vibration by the main rotor: a sine along and about each axis, its phase drawn. All assumed.

    A rotor of 1.8 m at 22 turns per second has a tip speed of 125 m/s, usual for its size.
    """

    rate_hz: Annotated[Positive, Field(le=45.0, description="frequency of the rotor, 1/s")] = 22.0
    acceleration_m_s2: Annotated[NonNegative, Field(le=20.0, description="amplitude along each world axis")] = 1.5
    angle_deg: Annotated[NonNegative, Field(le=1.0, description="amplitude of yaw, pitch and roll")] = 0.03


class AirParameters(Parameters):
    """Wind at the helicopter: a mean, and gusts correlated in time (first-order, as Dryden's along the flow)."""

    east_m_s: Annotated[float, bounded(-15.0, 15.0, "mean wind to the east")] = 1.0
    north_m_s: Annotated[float, bounded(-15.0, 15.0, "mean wind to the north")] = 1.0
    gust_m_s: Annotated[NonNegative, Field(le=5.0, description="RMS of the gusts per horizontal axis")] = 0.7
    vertical_gust_m_s: Annotated[NonNegative, Field(le=5.0, description="RMS of the vertical gusts")] = 0.2
    correlation_s: Annotated[Positive, Field(le=60.0, description="correlation time of the gusts")] = 2.0


class RotorcraftParameters(Parameters):
    """A helicopter similar to JPL's (2 m long, gas powered) with its autopilot.

    The paper gives no values. All are assumed: an attitude loop of about 1 Hz, position loops several times slower.
    """

    drag_s: Annotated[Positive, Field(description="time constant of the speed under drag alone, s")] = 5.0
    attitude_hz: Annotated[Positive, Field(le=5.0, description="natural frequency of pitch and roll, 1/s")] = 0.9
    heading_hz: Annotated[Positive, Field(le=5.0, description="natural frequency of yaw, 1/s")] = 0.5
    damping: Annotated[Positive, Field(le=2.0, description="damping ratio of the angles")] = 0.8
    thrust_lag_s: Annotated[Positive, Field(le=1.0, description="time constant of the thrust, s")] = 0.15
    most_tilt_deg: Annotated[Positive, Field(le=30.0, description="maximum commanded pitch or roll, deg")] = 12.0
    gust_tilt_deg_s_m: Annotated[NonNegative, Field(le=10.0, description="tilt by a gust, deg per m/s")] = 0.8
    gust_yaw_deg_s_m: Annotated[NonNegative, Field(le=10.0, description="turn into a gust, deg per m/s")] = 0.8
    place_gain: Annotated[Gain, Field(description="commanded speed per distance, 1/s")] = 0.5
    speed_gain: Annotated[Gain, Field(description="commanded acceleration per error of speed, 1/s")] = 1.2
    trim_gain: Annotated[NonNegative, Field(le=5.0, description="growth of trim per error of speed, 1/s2")] = 0.3
    delay_s: Annotated[NonNegative, Field(le=0.5, description="delay of the autopilot's command, s")] = 0.1
    gear_m: Annotated[NonNegative, Field(le=5.0, description="height of the camera above the skids, m")] = 0.4
    contact_s: Annotated[Positive, Field(le=1.0, description="time constant of the motion on the ground, s")] = 0.1
    step_s: Annotated[Positive, Field(le=0.05, description="step of the simulation")] = 0.02
    vibration: VibrationParameters = VibrationParameters()

    def craft(self, gravity_m_s2: float) -> Craft:
        """The same in SI units for the kernels."""
        rad, turn = math.radians(1.0), 2.0 * math.pi
        return Craft(
            gravity_m_s2=gravity_m_s2,
            drag_s=self.drag_s,
            attitude_rad_s=turn * self.attitude_hz,
            attitude_damping=self.damping,
            heading_rad_s=turn * self.heading_hz,
            thrust_lag_s=self.thrust_lag_s,
            max_tilt_rad=rad * self.most_tilt_deg,
            gust_tilt_s_m=rad * self.gust_tilt_deg_s_m,
            gust_yaw_s_m=rad * self.gust_yaw_deg_s_m,
            position_gain=self.place_gain,
            speed_gain=self.speed_gain,
            trim_gain=self.trim_gain,
            delay_steps=round(self.delay_s / self.step_s),
            gear_m=self.gear_m,
            contact_s=self.contact_s,
        )


class TransitParameters(Parameters):
    """The flight at constant height while pictures are taken (paper, V). Height and number of pictures are assumed.

    The paper's "several seconds" are five here. Time 0 is the first picture's.
    """

    height_m: Annotated[Positive, Field(le=200.0, description="height above ground at the first picture")] = 10.0
    speed_m_s: Annotated[Positive, Field(le=15.0, description="commanded speed, m/s (assumed)")] = 1.0
    acceleration_m_s2: Annotated[Positive, Field(le=3.0, description="to that speed (assumed)")] = 1.0
    hover_s: Annotated[NonNegative, Field(le=600.0, description="duration of the hover before, s (assumed)")] = 15.0
    settle_s: Annotated[NonNegative, Field(le=60.0, description="at speed before the first picture (assumed)")] = 1.5
    pictures: Annotated[int, bounded(2, 1000, "pictures taken")] = 40
    pictures_s: Annotated[Positive, Field(le=120.0, description="from the first to the last picture, s")] = 5.0

    @property
    def lead_s(self) -> float:
        """Time from the flight's start to the first picture."""
        return self.hover_s + self.speed_m_s / self.acceleration_m_s2 + self.settle_s


class LandingGuidance(Parameters):
    """Guidance from the last picture to the ground (paper, V).

    The distances of 2 m and 1.5 m are the paper's, the wait is its run time; the rest is assumed. In the paper the
    descent continues to reduce the distance from the site; below 1.5 m only the blades' pitch changes slowly. Here the
    helicopter stops its drift below that height, and no longer steers to the site.
    """

    wait_s: Annotated[NonNegative, Field(le=60.0, description="from the last picture to the answer, s")] = 1.8
    approach_m_s: Annotated[Positive, Field(le=15.0, description="maximum commanded speed to the site")] = 2.0
    near_m: Annotated[Positive, Field(le=50.0, description="distance from the site at which the descent begins")] = 2.0
    descent_m_s: Annotated[Positive, Field(le=5.0, description="commanded speed of the descent, m/s")] = 0.7
    flare_range_m: Annotated[Positive, Field(le=20.0, description="laser range at which the flare begins, m")] = 1.5
    flare_m_s: Annotated[Positive, Field(le=5.0, description="commanded sink rate of the flare, m/s")] = 0.3
    longest_s: Annotated[Positive, Field(le=600.0, description="limit of the landing's duration, s")] = 60.0
    rest_s: Annotated[NonNegative, Field(le=60.0, description="simulated time after the touchdown, s")] = 7.0
