"""Helicopter of a landing case: its parameters, instruments with on-board navigation, and the transit with images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field, model_validator

from marsyard.sim.dynamics import State, Trajectory, rotorcraft
from marsyard.sim.error_sources import COMPASS, INERTIAL, RECEIVER
from marsyard.sim.measurements import PoseMeasurement
from marsyard.sim.parameters import Parameters
from marsyard.sim.sensor.helicopter_navigation import (
    FilterParameters,
    FilterState,
    NavigationFilter,
    NavigationSolution,
)
from marsyard.sim.sensor.imu import SMALL_UNIT, Imu, ImuParameters
from marsyard.sim.sensor.instrument import MAX_TAG_DEVIATIONS, Clock, ClockParameters
from marsyard.sim.sensor.rtk import RtkParameters, RtkReceiver, RtkSolutions
from marsyard.sim.sensor.tilt_compass import TiltCompass, TiltCompassParameters, TiltCompassReadings
from marsyard.sim.streams import Streams


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

    @model_validator(mode="after")
    def _check_image_clock(self) -> LandingHelicopterParameters:
        # the filter runs until `TAIL_S` after the last image
        if (error_s := self.image_clock.max_error_s) > rotorcraft.TAIL_S:
            raise ValueError(
                f"image_clock: |offset_s| plus {MAX_TAG_DEVIATIONS:g} standard deviations (offset_sd_s, jitter_sd_s) "
                f"is {error_s:.3g} s; allowed: at most {rotorcraft.TAIL_S:g} s, the flight after the last image"
            )
        return self

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


@dataclass(frozen=True)
class HelicopterInstruments:
    """On-board instruments with sampled errors, and the filter configured for them."""

    imu: Imu
    receiver: RtkReceiver
    compass: TiltCompass
    navigation: NavigationFilter

    @classmethod
    def draw(cls, p: LandingHelicopterParameters, gravity_m_s2: float, streams: Streams) -> HelicopterInstruments:
        """Draw the instruments of a case."""
        return cls(
            Imu.draw(p.imu, p.span_s, streams.generator("inertial unit")),
            RtkReceiver.draw(p.rtk, p.receiver_span_s, streams.generator("receiver")),
            TiltCompass.draw(p.compass, streams.generator("compass")),
            NavigationFilter(p.navigation, p.imu, p.rtk, p.compass, gravity_m_s2),
        )


@dataclass(frozen=True)
class NavigatedLeg:
    """The filter's solution over a leg of a flight, and the measurements that it processes."""

    solution: NavigationSolution
    boundaries_s: Float64[np.ndarray, "m"]  #: true times of the solution's boundaries
    solutions: RtkSolutions
    readings: TiltCompassReadings
    fix_times_s: Float64[np.ndarray, "n"]  #: true times of the receiver's solutions

    @classmethod
    def simulate(
        cls,
        trajectory: Trajectory,
        start_s: float,
        end_s: float,
        instruments: HelicopterInstruments,
        streams: Streams,
        leg: str,
        initial: FilterState | None = None,
    ) -> NavigatedLeg:
        """Simulate instruments and filter on one leg; `leg` selects its random streams."""
        fix_times = instruments.receiver.sampling.within(start_s, end_s)
        increments = instruments.imu.increments(
            trajectory, start_s, end_s, streams.generator(f"inertial unit's noise, {leg}")
        )
        solutions = instruments.receiver.measure(trajectory, fix_times, streams.generator(f"receiver's noise, {leg}"))
        readings = instruments.compass.measure(
            trajectory, instruments.compass.sampling.within(start_s, end_s), streams.generator(f"compass' noise, {leg}")
        )
        start = instruments.navigation.initialize(solutions, readings) if initial is None else initial
        solution = instruments.navigation.run(start, increments, solutions, readings)
        return cls(solution, instruments.imu.boundaries(start_s, end_s), solutions, readings, fix_times)

    def errors(self, trajectory: Trajectory) -> Float64[np.ndarray, "m 9"]:
        """Compute estimated minus true position, velocity and angles (yaw, pitch, roll) at the boundaries."""
        true_motion = trajectory.motion(self.boundaries_s)
        angles = self.solution.attitudes.as_euler("ZYX") - true_motion.attitudes.as_euler("ZYX")
        components = [
            self.solution.positions_m - true_motion.positions_m,
            self.solution.velocities_m_s - true_motion.velocities_m_s,
            np.angle(np.exp(1j * angles)),  # wraps the angles to -pi to pi
        ]
        return np.concatenate(components, axis=1)


@dataclass(frozen=True)
class Transit:
    """The leg of the flight in which the images are taken."""

    parameters: LandingHelicopterParameters
    instruments: HelicopterInstruments
    air: rotorcraft.Air
    flight: rotorcraft.RotorcraftFlight  #: true flight
    navigation_leg: NavigatedLeg
    times_s: Float64[np.ndarray, "images"]  #: true mid-exposure times
    tags_s: Float64[np.ndarray, "images"]  #: time tags of the images

    @classmethod
    def fly(
        cls,
        parameters: LandingHelicopterParameters,
        start_m: Float64[np.ndarray, "3"],
        course_rad: float,
        heading_rad: float,
        gravity_m_s2: float,
        streams: Streams,
    ) -> Transit:
        """Simulate a transit whose first image is commanded at `start_m`; angles are counterclockwise from east.

        The height of `start_m` is that of the ground plus `transit.height_m`.
        """
        p = parameters
        start, end = p.span_s
        air = rotorcraft.Air.draw(p.air, p.craft.step_s, end - start, streams.generator("gusts"))
        flight = rotorcraft.simulate_transit(
            p.craft, p.transit, start_m, course_rad, heading_rad, gravity_m_s2, air, streams.generator("vibration")
        )
        instruments = HelicopterInstruments.draw(p, gravity_m_s2, streams)
        navigation_leg = NavigatedLeg.simulate(flight.path, *flight.path.span_s, instruments, streams, "transit")
        times = np.linspace(0.0, p.transit.imaging_duration_s, p.transit.images)
        # another name of a random stream would change the random values
        clock_stream = streams.generator("image clock")
        tags = Clock.draw(p.image_clock, clock_stream).tags(times, clock_stream)
        return cls(p, instruments, air, flight, navigation_leg, times, tags)

    def state(self, number: int) -> State:
        """Return the true state at an image."""
        return self.flight.path.state(float(self.times_s[number]))

    def pose(self, number: int) -> PoseMeasurement:
        """Return the filter's pose at an image's time tag."""
        tag = float(self.tags_s[number])
        return PoseMeasurement(self.navigation_leg.solution.pose(tag), tag)

    def up_body(self, number: int) -> Float64[np.ndarray, "3"]:
        """Return the up vector in body axes from the inclinometers' last reading before an image."""
        readings = self.navigation_leg.readings
        last = int(np.searchsorted(readings.times_s, self.tags_s[number], side="right")) - 1
        up: Float64[np.ndarray, "3"] = readings.up_body[max(last, 0)]
        return up
