"""Helicopter flights of a case with their on-board navigation: transit for the pictures, and landing at the site.

The landing is flown on the filter's estimate, and the filter's errors depend slightly on the flight. Both are solved by
Picard iteration: fly with the errors of the previous iteration, then run instruments and filter over that flight with
the same random numbers, until the path converges. As the filter is causal, the fixed point is unique. The change of
the path in the last iteration is reported.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from marsyard.sim.dynamics import Resting, State, Trajectory
from marsyard.sim.dynamics.rotorcraft import (
    Air,
    AirParameters,
    FlownPath,
    GroundPatch,
    LandingGuidance,
    LandingLaser,
    Phase,
    RotorcraftFlight,
    RotorcraftParameters,
    TransitParameters,
    landing_flight,
    transit_flight,
)
from marsyard.sim.measurements import PoseMeasurement
from marsyard.sim.parameters import Parameters
from marsyard.sim.sensor.imu import SMALL_UNIT, Imu, ImuParameters
from marsyard.sim.sensor.instrument import Clock, ClockParameters
from marsyard.sim.sensor.navigation import FilterParameters, FilterState, NavigationFilter, NavigationSolution
from marsyard.sim.sensor.ranging import RangingUnit
from marsyard.sim.sensor.satellite_navigation import RtkParameters, RtkReceiver, RtkSolutions
from marsyard.sim.sensor.tilt_compass import TiltCompass, TiltCompassParameters, TiltCompassReadings
from marsyard.sim.streams import Streams

#: Maximum iterations of a landing, and the change of the path at convergence, metres.
MAX_ITERATIONS, CONVERGED_M = 8, 1e-3


class HelicopterParameters(Parameters):
    """A flight of the helicopter: vehicle, air, guidance, and the classes of its instruments."""

    craft: RotorcraftParameters = RotorcraftParameters()
    air: AirParameters = AirParameters()
    transit: TransitParameters = TransitParameters()
    guidance: LandingGuidance = LandingGuidance()
    imu: ImuParameters = SMALL_UNIT
    rtk: RtkParameters = RtkParameters()
    compass: TiltCompassParameters = TiltCompassParameters()
    navigation: FilterParameters = FilterParameters()
    picture_clock: ClockParameters = Field(
        default=ClockParameters(offset_sd_s=0.001, jitter_sd_s=0.0005), description="errors of the time tags (assumed)"
    )
    averaging_after_s: float = Field(
        default=2.0, ge=2.0, le=3600.0, description="touchdown to the first solution (assumed)"
    )
    averaging_s: float = Field(default=5.0, gt=0.0, le=600.0, description="for dozens of solutions, as in the paper")

    @property
    def span_s(self) -> tuple[float, float]:
        """From the flight's start to its latest possible end."""
        last = self.transit.pictures_s + self.guidance.wait_s + self.guidance.max_duration_s + self.guidance.rest_s
        return -self.transit.lead_s, last + 1.0

    @property
    def received_s(self) -> tuple[float, float]:
        """From the flight's start to the latest averaged solution on the ground."""
        start, end = self.span_s
        return start, end + self.averaging_after_s + self.averaging_s


@dataclass(frozen=True)
class Instruments:
    """The on-board units with their drawn errors, and the filter with their classes."""

    imu: Imu
    receiver: RtkReceiver
    compass: TiltCompass
    navigation: NavigationFilter

    @classmethod
    def draw(cls, p: HelicopterParameters, gravity_m_s2: float, streams: Streams) -> Instruments:
        """The units of a case."""
        return cls(
            Imu.draw(p.imu, p.span_s, streams.generator("inertial unit")),
            RtkReceiver.draw(p.rtk, p.received_s, streams.generator("receiver")),
            TiltCompass.draw(p.compass, streams.generator("compass")),
            NavigationFilter(p.navigation, p.imu, p.rtk, p.compass, gravity_m_s2),
        )


@dataclass(frozen=True)
class NavigatedPart:
    """The filter's solution over a part of a flight, with the measurements that it used."""

    solution: NavigationSolution
    boundaries_s: Float64[np.ndarray, "m"]  #: true times of the solution's boundaries
    solutions: RtkSolutions
    readings: TiltCompassReadings
    fix_times_s: Float64[np.ndarray, "n"]  #: true times of the receiver's solutions

    @classmethod
    def over(
        cls,
        trajectory: Trajectory,
        start_s: float,
        end_s: float,
        instruments: Instruments,
        streams: Streams,
        part: str,
        before: FilterState | None = None,
    ) -> NavigatedPart:
        """The part from a start to an end, its noise from its own streams; the filter continues from a state."""
        fixes = instruments.receiver.sampling.within(start_s, end_s)
        increments = instruments.imu.increments(
            trajectory, start_s, end_s, streams.generator(f"inertial unit's noise, {part}")
        )
        solutions = instruments.receiver.measure(trajectory, fixes, streams.generator(f"receiver's noise, {part}"))
        readings = instruments.compass.measure(
            trajectory,
            instruments.compass.sampling.within(start_s, end_s),
            streams.generator(f"compass' noise, {part}"),
        )
        start = instruments.navigation.initialize(solutions, readings) if before is None else before
        solution = instruments.navigation.run(start, increments, solutions, readings)
        return cls(solution, instruments.imu.boundaries(start_s, end_s), solutions, readings, fixes)

    def errors(self, trajectory: Trajectory) -> Float64[np.ndarray, "m 9"]:
        """Believed less true position, velocity and angles (yaw, pitch, roll) at the boundaries."""
        true = trajectory.motion(self.boundaries_s)
        angles = self.solution.attitudes.as_euler("ZYX") - true.attitudes.as_euler("ZYX")
        parts = [
            self.solution.positions_m - true.positions_m,
            self.solution.velocities_m_s - true.velocities_m_s,
            np.angle(np.exp(1j * angles)),
        ]
        return np.concatenate(parts, axis=1)


@dataclass(frozen=True)
class Transit:
    """The flight over which pictures are taken."""

    parameters: HelicopterParameters
    instruments: Instruments
    air: Air
    flight: RotorcraftFlight  #: truth
    navigated: NavigatedPart
    times_s: Float64[np.ndarray, "pictures"]  #: true times of the middles of the exposures
    tags_s: Float64[np.ndarray, "pictures"]  #: time tags of the pictures

    @classmethod
    def fly(
        cls,
        parameters: HelicopterParameters,
        over_m: Float64[np.ndarray, "3"],
        course_rad: float,
        heading_rad: float,
        gravity_m_s2: float,
        streams: Streams,
    ) -> Transit:
        """The flight with its first picture commanded at a point; course and heading counterclockwise from east.

        The point's height is above the datum: the ground's there plus `transit.height_m`.
        """
        p = parameters
        start, end = p.span_s
        air = Air.draw(p.air, p.craft.step_s, end - start, streams.generator("gusts"))
        flight = transit_flight(
            p.craft, p.transit, over_m, course_rad, heading_rad, gravity_m_s2, air, streams.generator("vibration")
        )
        instruments = Instruments.draw(p, gravity_m_s2, streams)
        navigated = NavigatedPart.over(flight.path, *flight.path.span_s, instruments, streams, "transit")
        times = np.linspace(0.0, p.transit.pictures_s, p.transit.pictures)
        clock_stream = streams.generator("picture clock")
        tags = Clock.draw(p.picture_clock, clock_stream).tags(times, clock_stream)
        return cls(p, instruments, air, flight, navigated, times, tags)

    def state(self, number: int) -> State:
        """Truth at a picture."""
        return self.flight.path.state(float(self.times_s[number]))

    def pose(self, number: int) -> PoseMeasurement:
        """The filter's pose at a picture's time tag."""
        tag = float(self.tags_s[number])
        return PoseMeasurement(self.navigated.solution.pose(tag), tag)

    def up_body(self, number: int) -> Float64[np.ndarray, "3"]:
        """Up vector in body axes by the inclinometers' last reading before a picture."""
        readings = self.navigated.readings
        last = int(np.searchsorted(readings.times_s, self.tags_s[number], side="right")) - 1
        up: Float64[np.ndarray, "3"] = readings.up_body[max(last, 0)]
        return up


@dataclass(frozen=True)
class Touchdown:
    """A landing."""

    flight: RotorcraftFlight  #: from its start to rest on the ground
    navigated: NavigatedPart  #: from the transit's end on
    time_s: float  #: first contact of the skids
    state: State  #: true state then
    believed_m: Float64[np.ndarray, "3"]  #: position by the filter then
    #: means of the receiver's positions and reported standard deviations at rest, as in Table II; NaN without solutions
    gps_m: Float64[np.ndarray, "3"]
    gps_deviation_m: Float64[np.ndarray, "3"]
    gps_solutions: int  #: number averaged
    iterations: int  #: until flight and filter agreed
    change_m: float  #: change of the path in the last iteration


def horizontal_distance_m(first_m: Float64[np.ndarray, "3"], second_m: Float64[np.ndarray, "3"]) -> float:
    """Horizontal distance of two positions: the paper's "position error" of a touchdown."""
    return float(np.hypot(*(first_m - second_m)[:2]))


def land(
    transit: Transit,
    site_m: Float64[np.ndarray, "3"],
    ground: GroundPatch,
    laser: RangingUnit,
    streams: Streams,
    laser_stuck_m: float | None = None,
) -> Touchdown | None:
    """Continue a transit to a site in believed coordinates and land; None without contact with the ground in time.

    `ground` holds the true heights about the site, rocks included.
    """
    p, before = transit.parameters, transit.flight.path
    noise = np.hypot(laser.parameters.noise_m, laser.parameters.noise * p.guidance.flare_range_m)
    errors_m = noise * streams.generator("laser noise, landing").standard_normal(len(transit.air.gusts_m_s))
    altimeter = LandingLaser(laser.scale, errors_m, laser_stuck_m)
    start = float(transit.navigated.boundaries_s[-1])
    errors = _at_knots(before, transit.navigated.boundaries_s, transit.navigated.errors(before))
    held, flown, end = errors, None, None
    iterations, change_m = 0, np.inf
    while iterations < MAX_ITERATIONS and change_m > CONVERGED_M:
        flight = landing_flight(transit.flight, p.guidance, site_m[:2], held, transit.air, ground, altimeter, end)
        path = flight.path
        end = path.span_s[1] if end is None else end
        navigated = NavigatedPart.over(
            path, start, end, transit.instruments, streams, "landing", transit.navigated.solution.end
        )
        later = _at_knots(path, navigated.boundaries_s, navigated.errors(path))
        held = np.concatenate([errors, later[len(errors) :]])
        change_m = np.inf if flown is None else float(np.abs(path.rows[:, :3] - flown.rows[:, :3]).max())
        flown, iterations = path, iterations + 1
    time = flight.first(Phase.ON_GROUND)
    if time is None:
        return None
    # the receiver's averaged solutions, with the helicopter at rest
    receiver, last_state = transit.instruments.receiver, path.state(path.span_s[1])
    standing = Resting(last_state.position_m, last_state.attitude, path.gravity_m_s2)
    first = time + p.averaging_after_s
    times = receiver.sampling.within(first, first + p.averaging_s)
    solutions = receiver.measure(standing, times, streams.generator("receiver's noise, standing"))
    valid = np.isfinite(solutions.positions_m[:, 0])
    count = int(np.count_nonzero(valid))
    nothing = np.full(3, np.nan)
    return Touchdown(
        flight=flight,
        navigated=navigated,
        time_s=time,
        state=path.state(time),
        believed_m=navigated.solution.positions_m[int(np.searchsorted(navigated.boundaries_s, time, side="right")) - 1],
        gps_m=solutions.positions_m[valid].mean(axis=0) if count else nothing,
        gps_deviation_m=solutions.reported_m[valid].mean(axis=0) if count else nothing,
        gps_solutions=count,
        iterations=iterations,
        change_m=change_m,
    )


def _at_knots(
    path: FlownPath, times_s: Float64[np.ndarray, "m"], values: Float64[np.ndarray, "m 9"]
) -> Float64[np.ndarray, "knots 9"]:
    """Values at a path's knots by linear interpolation, held before the first and after the last."""
    return np.stack([np.interp(path.knots_s, times_s, column) for column in values.T], axis=1)
