"""The helicopter of a case: its flight for pictures with what its instruments make of it, and its flight to the site.

The landing is flown on what the on-board filter believes, and the filter's errors depend, a little, on what is flown.
Both are worked out in turns: the flight on the errors of the turn before, then instruments and filter over that flight,
with the same random numbers in every turn, until nothing moves any more. As the filter at any time knows only what was
before it, the turns end at the one flight that agrees with its own filter throughout (Picard's iteration of a causal
loop); what the last turn still moved is told.
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
from marsyard.sim.sensor.clock import Clock, ClockParameters
from marsyard.sim.sensor.imu import SMALL_UNIT, Imu, ImuParameters
from marsyard.sim.sensor.navigation import FilterParameters, FilterState, NavigationFilter, NavigationSolution
from marsyard.sim.sensor.ranging import RangingUnit
from marsyard.sim.sensor.rtk import RtkParameters, RtkReceiver, RtkSolutions
from marsyard.sim.sensor.tilt_compass import TiltCompass, TiltCompassParameters, TiltCompassReadings
from marsyard.sim.streams import Streams

#: Turns of the landing's iteration at most, and how little a turn may still move the path for it to be the last, m.
MOST_TURNS, STILL_M = 8, 1e-3


class HelicopterParameters(Parameters):
    """A flight of the helicopter: vehicle, air, what is commanded, and the classes of its instruments."""

    craft: RotorcraftParameters = RotorcraftParameters()
    air: AirParameters = AirParameters()
    transit: TransitParameters = TransitParameters()
    guidance: LandingGuidance = LandingGuidance()
    imu: ImuParameters = SMALL_UNIT
    rtk: RtkParameters = RtkParameters()
    compass: TiltCompassParameters = TiltCompassParameters()
    navigation: FilterParameters = FilterParameters()
    picture_clock: ClockParameters = Field(
        default=ClockParameters(offset_sd_s=0.001, jitter_sd_s=0.0005),
        description="errors of the time tags (assumed)",
    )
    averaging_after_s: float = Field(
        default=2.0, ge=2.0, le=3600.0, description="touchdown to the first averaged solution (assumed)"
    )
    averaging_s: float = Field(
        default=5.0, gt=0.0, le=600.0, description="averaging time: the paper has dozens of solutions"
    )

    @property
    def span_s(self) -> tuple[float, float]:
        """From the flight's start to the latest end that it can have."""
        last = self.transit.pictures_s + self.guidance.wait_s + self.guidance.longest_s + self.guidance.rest_s
        return -self.transit.lead_s, last + 1.0

    @property
    def received_s(self) -> tuple[float, float]:
        """From the flight's start to the latest solution that is averaged on the ground."""
        start, end = self.span_s
        return start, end + self.averaging_after_s + self.averaging_s


@dataclass(frozen=True)
class Instruments:
    """The units on board, their errors drawn, and the filter that knows their classes."""

    imu: Imu
    receiver: RtkReceiver
    compass: TiltCompass
    navigation: NavigationFilter

    @classmethod
    def drawn(cls, p: HelicopterParameters, gravity_m_s2: float, streams: Streams) -> Instruments:
        """The units of a case."""
        return cls(
            Imu.drawn(p.imu, p.span_s, streams.generator("inertial unit")),
            RtkReceiver.drawn(p.rtk, p.received_s, streams.generator("receiver")),
            TiltCompass.drawn(p.compass, streams.generator("compass")),
            NavigationFilter(p.navigation, p.imu, p.rtk, p.compass, gravity_m_s2),
        )


@dataclass(frozen=True)
class Navigated:
    """A part of a flight as the instruments and the filter had it."""

    solution: NavigationSolution  #: The filter's
    boundaries_s: Float64[np.ndarray, "m"]  #: True times of its boundaries
    solutions: RtkSolutions  #: What it took in
    readings: TiltCompassReadings  #: What it took in
    fix_times_s: Float64[np.ndarray, "n"]  #: True times of the receiver's solutions

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
    ) -> Navigated:
        """The part from a start to an end, its noise from streams of its own; the filter goes on from a state."""
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
        start = instruments.navigation.started(solutions, readings) if before is None else before
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
    """A flight for pictures."""

    parameters: HelicopterParameters  #: What it was flown with
    instruments: Instruments  #: What it was flown with
    air: Air  #: What it was flown with
    flight: RotorcraftFlight  #: The truth
    navigated: Navigated  #: The filter's solution up to its end
    times_s: Float64[np.ndarray, "pictures"]  #: True times of the pictures (the middles of their exposures)
    tags_s: Float64[np.ndarray, "pictures"]  #: Their time tags

    @classmethod
    def flown(
        cls,
        parameters: HelicopterParameters,
        over_m: Float64[np.ndarray, "3"],
        course_rad: float,
        heading_rad: float,
        gravity_m_s2: float,
        streams: Streams,
    ) -> Transit:
        """The flight whose first picture is commanded at a point; course and heading counterclockwise from east.

        The point's height is that above the datum: the ground's there plus `transit.height_m`.
        """
        p = parameters
        start, end = p.span_s
        air = Air.drawn(p.air, p.craft.step_s, end - start, streams.generator("gusts"))
        flight = transit_flight(
            p.craft, p.transit, over_m, course_rad, heading_rad, gravity_m_s2, air, streams.generator("vibration")
        )
        instruments = Instruments.drawn(p, gravity_m_s2, streams)
        navigated = Navigated.over(flight.path, *flight.path.span_s, instruments, streams, "transit")
        times = np.linspace(0.0, p.transit.pictures_s, p.transit.pictures)
        clock_stream = streams.generator("picture clock")
        tags = Clock.drawn(p.picture_clock, clock_stream).tags(times, clock_stream)
        return cls(p, instruments, air, flight, navigated, times, tags)

    def state(self, number: int) -> State:
        """Truth at a picture."""
        return self.flight.path.state(float(self.times_s[number]))

    def pose(self, number: int) -> PoseMeasurement:
        """The filter's pose at a picture's time tag."""
        tag = float(self.tags_s[number])
        return PoseMeasurement(self.navigated.solution.pose(tag), tag)

    def poses(self) -> list[PoseMeasurement]:
        """The filter's poses at all pictures."""
        return [self.pose(number) for number in range(self.times_s.size)]

    def up_body(self, number: int) -> Float64[np.ndarray, "3"]:
        """Upwards as the inclinometers last had it before a picture, unit vector in body axes."""
        readings = self.navigated.readings
        last = int(np.searchsorted(readings.times_s, self.tags_s[number], side="right")) - 1
        up: Float64[np.ndarray, "3"] = readings.up_body[max(last, 0)]
        return up


@dataclass(frozen=True)
class Touchdown:
    """A landing."""

    flight: RotorcraftFlight  #: The whole flight, from its start to rest on the ground
    navigated: Navigated  #: Instruments and filter from the transit's end on
    time_s: float  #: When the skids touched
    state: State  #: Truth then
    believed_m: Float64[np.ndarray, "3"]  #: Where the filter had it then
    #: Means of the receiver's positions and of the standard deviations it reported, while it stood: how the paper
    #: measured (Table II); not a number without solutions
    gps_m: Float64[np.ndarray, "3"]
    gps_deviation_m: Float64[np.ndarray, "3"]
    gps_solutions: int  #: How many were averaged
    turns: int  #: Turns that were needed to agree on flight and filter, and what the last one still moved the path
    moved_m: float  #: Turns that were needed to agree on flight and filter, and what the last one still moved the path

    def gps_error_m(self, site_m: Float64[np.ndarray, "3"]) -> float:
        """Horizontal distance of the averaged solutions from the desired site: the paper's "position error"."""
        return float(np.hypot(*(self.gps_m - site_m)[:2]))

    def believed_error_m(self, site_m: Float64[np.ndarray, "3"]) -> float:
        """Horizontal distance of where the filter had the touchdown from the desired site."""
        return float(np.hypot(*(self.believed_m - site_m)[:2]))

    def true_error_m(self, place_m: Float64[np.ndarray, "3"]) -> float:
        """Horizontal distance of the true touchdown from a place in true coordinates.

        The site that an algorithm reports is in believed coordinates: the ground that it meant lies where its offset
        from the believed pose of the first picture is put onto the true one.
        """
        return float(np.hypot(*(self.state.position_m - place_m)[:2]))


def land(
    transit: Transit,
    site_m: Float64[np.ndarray, "3"],
    ground: GroundPatch,
    laser: RangingUnit,
    streams: Streams,
    laser_stuck_m: float | None = None,
) -> Touchdown | None:
    """Flies on from a transit to a site in believed coordinates and down; None if it does not touch the ground in time.

    `ground` holds the true heights, rocks included, about where it may come down.
    """
    p, before = transit.parameters, transit.flight.path
    altimeter = _landing_laser(p, laser, len(transit.air.gusts_m_s), laser_stuck_m, streams)
    start = float(transit.navigated.boundaries_s[-1])
    errors = _at_knots(before, transit.navigated.boundaries_s, transit.navigated.errors(before))
    held, flown, end = errors, None, None
    turns, moved = 0, np.inf
    while turns < MOST_TURNS and moved > STILL_M:
        flight = landing_flight(transit.flight, p.guidance, site_m[:2], held, transit.air, ground, altimeter, end)
        path = flight.path
        end = path.span_s[1] if end is None else end
        navigated = Navigated.over(
            path, start, end, transit.instruments, streams, "landing", transit.navigated.solution.end
        )
        later = _at_knots(path, navigated.boundaries_s, navigated.errors(path))
        held = np.concatenate([errors, later[len(errors) :]])
        moved = np.inf if flown is None else float(np.abs(path.rows[:, :3] - flown.rows[:, :3]).max())
        flown, turns = path, turns + 1
    time = flight.first(Phase.ON_GROUND)
    if time is None:
        return None
    return _touchdown(transit, flight, navigated, time, turns, moved, streams)


def _landing_laser(
    p: HelicopterParameters, unit: RangingUnit, knots: int, stuck_m: float | None, streams: Streams
) -> LandingLaser:
    noise = np.hypot(unit.parameters.noise_m, unit.parameters.noise * p.guidance.flare_range_m)
    return LandingLaser(unit.scale, noise * streams.generator("laser noise, landing").standard_normal(knots), stuck_m)


def _at_knots(
    path: FlownPath, times_s: Float64[np.ndarray, "m"], values: Float64[np.ndarray, "m 9"]
) -> Float64[np.ndarray, "knots 9"]:
    """Values at a path's knots, on straight lines, held before the first and after the last."""
    return np.stack([np.interp(path.knots_s, times_s, column) for column in values.T], axis=1)


def _touchdown(
    transit: Transit,
    flight: RotorcraftFlight,
    navigated: Navigated,
    time: float,
    turns: int,
    moved: float,
    streams: Streams,
) -> Touchdown:
    solutions = _standing(transit, flight, time, streams)
    known = np.isfinite(solutions.positions_m[:, 0])
    count = int(np.count_nonzero(known))
    unknown = np.full(3, np.nan)
    last = int(np.searchsorted(navigated.boundaries_s, time, side="right")) - 1
    return Touchdown(
        flight=flight,
        navigated=navigated,
        time_s=time,
        state=flight.path.state(time),
        believed_m=navigated.solution.positions_m[last],
        gps_m=solutions.positions_m[known].mean(axis=0) if count else unknown,
        gps_deviation_m=solutions.reported_m[known].mean(axis=0) if count else unknown,
        gps_solutions=count,
        turns=turns,
        moved_m=moved,
    )


def _standing(transit: Transit, flight: RotorcraftFlight, time: float, streams: Streams) -> RtkSolutions:
    """The receiver's solutions that are averaged, while the helicopter stands where it came to rest."""
    p, receiver, path = transit.parameters, transit.instruments.receiver, flight.path
    end = path.state(path.span_s[1])
    standing = Resting(end.position_m, end.attitude, path.gravity_m_s2)
    first = time + p.averaging_after_s
    times = receiver.sampling.within(first, first + p.averaging_s)
    return receiver.measure(standing, times, streams.generator("receiver's noise, standing"))
