"""Simulate a helicopter flight with on-board navigation: a transit with images, then the landing at the site.

The filter's estimate controls the landing, and the filter's errors depend slightly on the flight. Picard iteration
solves for both. Each iteration flies with the errors of the previous iteration. It then simulates instruments and
filter on this flight with the same random numbers. The iterations end when the path converges. The fixed point is
unique because the filter is causal. The change of the path in the last iteration is reported.

"The paper" is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from marsyard.sim.dynamics import Resting, State, Trajectory
from marsyard.sim.dynamics.rotorcraft import (
    Air,
    AirParameters,
    AltimeterErrors,
    GroundPatch,
    LandingGuidance,
    Phase,
    RotorcraftFlight,
    RotorcraftParameters,
    SimulatedPath,
    TransitParameters,
    simulate_landing,
    simulate_transit,
)
from marsyard.sim.error_sources import COMPASS, INERTIAL, RECEIVER
from marsyard.sim.measurements import PoseMeasurement
from marsyard.sim.parameters import Parameters
from marsyard.sim.sensor.imu import SMALL_UNIT, Imu, ImuParameters
from marsyard.sim.sensor.instrument import Clock, ClockParameters
from marsyard.sim.sensor.navigation import FilterParameters, FilterState, NavigationFilter, NavigationSolution
from marsyard.sim.sensor.ranging import RangingUnit
from marsyard.sim.sensor.satellite_navigation import RtkParameters, RtkReceiver, RtkSolutions
from marsyard.sim.sensor.tilt_compass import TiltCompass, TiltCompassParameters, TiltCompassReadings
from marsyard.sim.streams import Streams

#: Maximum number of iterations of a landing, and maximum change of the path at convergence, metres.
MAX_ITERATIONS, MAX_PATH_CHANGE_M = 8, 1e-3


class LandingHelicopterParameters(Parameters):
    """Parameters of a helicopter flight: vehicle, air, guidance and instruments."""

    craft: RotorcraftParameters = RotorcraftParameters()
    air: AirParameters = AirParameters()
    transit: TransitParameters = TransitParameters()
    guidance: LandingGuidance = LandingGuidance()
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
    air: Air
    flight: RotorcraftFlight  #: true flight
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
        air = Air.draw(p.air, p.craft.step_s, end - start, streams.generator("gusts"))
        flight = simulate_transit(
            p.craft, p.transit, start_m, course_rad, heading_rad, gravity_m_s2, air, streams.generator("vibration")
        )
        instruments = HelicopterInstruments.draw(p, gravity_m_s2, streams)
        navigation_leg = NavigatedLeg.simulate(flight.path, *flight.path.span_s, instruments, streams, "transit")
        times = np.linspace(0.0, p.transit.imaging_duration_s, p.transit.images)
        # another name of a random stream would change the random values
        clock_stream = streams.generator("picture clock")
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


@dataclass(frozen=True)
class Touchdown:
    """True and estimated state at the touchdown of a landing."""

    flight: RotorcraftFlight  #: true flight from its start to rest on the ground
    navigation_leg: NavigatedLeg  #: navigation from the end of the transit
    time_s: float  #: time of first skid contact
    state: State  #: true state at touchdown
    estimated_m: Float64[np.ndarray, "3"]  #: position estimated by the filter at touchdown
    #: means of the receiver's positions and reported standard deviations at rest, as in Table II; NaN without solutions
    gps_m: Float64[np.ndarray, "3"]
    gps_deviation_m: Float64[np.ndarray, "3"]
    gps_solutions: int  #: number of averaged solutions
    iterations: int  #: number of iterations of flight and filter
    path_change_m: float  #: change of the path in the last iteration


def horizontal_distance_m(first_m: Float64[np.ndarray, "3"], second_m: Float64[np.ndarray, "3"]) -> float:
    """Compute the horizontal distance of two positions: the paper's "position error" of a touchdown."""
    return float(np.hypot(*(first_m - second_m)[:2]))


def land(
    transit: Transit,
    site_m: Float64[np.ndarray, "3"],
    ground: GroundPatch,
    laser: RangingUnit,
    streams: Streams,
    laser_stuck_m: float | None = None,
) -> Touchdown | None:
    """Continue a transit to a site in estimated coordinates and land; None without ground contact in time.

    `ground` contains the true heights around the site, including rocks. `laser_stuck_m` is the altimeter's stuck range.
    """
    p, path = transit.parameters, transit.flight.path
    noise = np.hypot(laser.parameters.noise_m, laser.parameters.noise * p.guidance.flare_range_m)
    errors_m = noise * streams.generator("laser noise, landing").standard_normal(len(transit.air.gusts_m_s))
    altimeter = AltimeterErrors(laser.scale, errors_m, laser_stuck_m)
    start = float(transit.navigation_leg.boundaries_s[-1])
    transit_errors = _interpolate_at_knots(
        path, transit.navigation_leg.boundaries_s, transit.navigation_leg.errors(path)
    )
    errors, previous, end = transit_errors, None, None
    iterations, path_change_m, initial = 0, np.inf, transit.navigation_leg.solution.end
    while iterations < MAX_ITERATIONS and path_change_m > MAX_PATH_CHANGE_M:
        flight = simulate_landing(transit.flight, p.guidance, site_m[:2], errors, transit.air, ground, altimeter, end)
        path = flight.path
        end = path.span_s[1] if end is None else end  # all iterations have the duration of the first one
        navigation_leg = NavigatedLeg.simulate(path, start, end, transit.instruments, streams, "landing", initial)
        leg_errors = _interpolate_at_knots(path, navigation_leg.boundaries_s, navigation_leg.errors(path))
        errors = np.concatenate([transit_errors, leg_errors[len(transit_errors) :]])
        path_change_m = np.inf if previous is None else float(np.abs(path.rows[:, :3] - previous.rows[:, :3]).max())
        previous, iterations = path, iterations + 1
    time = flight.phase_start_s(Phase.ON_GROUND)
    if time is None:
        return None
    # the receiver's averaged solutions, with the helicopter at rest
    receiver, last_state = transit.instruments.receiver, path.state(path.span_s[1])
    resting = Resting(last_state.position_m, last_state.attitude, path.gravity_m_s2)
    first = time + p.averaging_after_s
    times = receiver.sampling.within(first, first + p.averaging_s)
    solutions = receiver.measure(resting, times, streams.generator("receiver's noise, standing"))
    is_valid = np.isfinite(solutions.positions_m[:, 0])
    count = int(np.count_nonzero(is_valid))
    missing = np.full(3, np.nan)
    index = int(np.searchsorted(navigation_leg.boundaries_s, time, side="right")) - 1
    return Touchdown(
        flight=flight,
        navigation_leg=navigation_leg,
        time_s=time,
        state=path.state(time),
        estimated_m=navigation_leg.solution.positions_m[index],
        gps_m=solutions.positions_m[is_valid].mean(axis=0) if count else missing,
        gps_deviation_m=solutions.reported_m[is_valid].mean(axis=0) if count else missing,
        gps_solutions=count,
        iterations=iterations,
        path_change_m=path_change_m,
    )


def _interpolate_at_knots(
    path: SimulatedPath, times_s: Float64[np.ndarray, "m"], values: Float64[np.ndarray, "m 9"]
) -> Float64[np.ndarray, "knots 9"]:
    """Interpolate values linearly at a path's knots; constant before the first and after the last time."""
    return np.stack([np.interp(path.knots_s, times_s, column) for column in values.T], axis=1)
