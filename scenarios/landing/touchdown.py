"""Simulate the landing of a helicopter at the reported site, from the end of its transit to rest on the ground.

The filter's estimate controls the landing, and the filter's errors depend slightly on the flight. Picard iteration
solves for both. Each iteration flies with the errors of the previous iteration. It then simulates instruments and
filter on this flight with the same random numbers. The iterations end when the path converges. The fixed point is
unique because the filter is causal. The change of the path in the last iteration is reported.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from marsyard.algorithms.interface import SiteEstimate
from marsyard.scenarios.landing.faults import stuck_range_m
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.ground_truth import GroundTruth
from marsyard.scenarios.landing.helicopter import NavigatedLeg, Transit
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.sim.dynamics import Resting, State, rotorcraft
from marsyard.sim.dynamics.rotorcraft import kernels
from marsyard.sim.sensor.altimeters import RangingUnit
from marsyard.sim.streams import Streams

#: Maximum number of iterations of a landing, and maximum change of the path at convergence, metres.
MAX_ITERATIONS, MAX_PATH_CHANGE_M = 8, 1e-3
#: Columns of the position in the rows of a simulated path.
_POSITION = slice(kernels.POSITION, kernels.VELOCITY)


@dataclass(frozen=True)
class Touchdown:
    """True and estimated state at the touchdown of a landing."""

    flight: rotorcraft.RotorcraftFlight  #: true flight from its start to rest on the ground
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


def simulate_touchdown(
    p: LandingScenarioParameters, estimate: SiteEstimate, flight: LandingFlight, truth: GroundTruth, streams: Streams
) -> Touchdown | None:
    """Simulate the helicopter's landing at the reported site; None without a site, a helicopter or ground contact."""
    relief = truth.relief
    if flight.transit is None or estimate.site_world is None:
        return None
    ground = rotorcraft.GroundPatch(relief.west_m, relief.south_m, relief.spacing_m, relief.heights_m)
    unit = RangingUnit.draw(p.laser, streams.generator("laser"))
    return land(flight.transit, estimate.site_world, ground, unit, streams, stuck_range_m(p.faults, p.height_m))


def land(
    transit: Transit,
    site_m: Float64[np.ndarray, "3"],
    ground: rotorcraft.GroundPatch,
    laser: RangingUnit,
    streams: Streams,
    laser_stuck_m: float | None = None,
) -> Touchdown | None:
    """Continue a transit to a site in estimated coordinates and land; None without ground contact in time.

    `ground` contains the true heights around the site, including rocks. `laser_stuck_m` is the altimeter's stuck
    range: infinite if it returns no range, None if it has no fault.
    """
    p, path = transit.parameters, transit.flight.path
    parameters = laser.parameters
    noise = np.hypot(parameters.noise_m, parameters.noise * p.guidance.flare_range_m)
    errors_m = noise * streams.generator("laser noise, landing").standard_normal(len(transit.air.gusts_m_s))
    limits_m = parameters.min_range_m, parameters.max_range_m
    x, y, z = laser.axis.tolist()
    altimeter = rotorcraft.AltimeterErrors(
        laser.scale, errors_m, laser_stuck_m, parameters.count_m, limits_m, (x, y, z)
    )
    start = float(transit.navigation_leg.boundaries_s[-1])
    transit_errors = _interpolate_at_knots(
        path, transit.navigation_leg.boundaries_s, transit.navigation_leg.errors(path)
    )
    errors, previous_m, end = transit_errors, None, None
    iterations, path_change_m, initial = 0, np.inf, transit.navigation_leg.solution.end
    while iterations < MAX_ITERATIONS and path_change_m > MAX_PATH_CHANGE_M:
        flight = rotorcraft.simulate_landing(
            transit.flight, p.guidance, site_m[:2], errors, transit.air, ground, altimeter, end
        )
        path = flight.path
        end = path.span_s[1] if end is None else end  # all iterations have the duration of the first one
        navigation_leg = NavigatedLeg.simulate(path, start, end, transit.instruments, streams, "landing", initial)
        leg_errors = _interpolate_at_knots(path, navigation_leg.boundaries_s, navigation_leg.errors(path))
        errors = np.concatenate([transit_errors, leg_errors[len(transit_errors) :]])
        positions_m = path.rows[:, _POSITION]
        path_change_m = np.inf if previous_m is None else float(np.abs(positions_m - previous_m).max())
        previous_m, iterations = positions_m, iterations + 1
    time = flight.phase_start_s(rotorcraft.Phase.ON_GROUND)
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
    path: rotorcraft.SimulatedPath, times_s: Float64[np.ndarray, "m"], values: Float64[np.ndarray, "m 9"]
) -> Float64[np.ndarray, "knots 9"]:
    """Interpolate values linearly at a path's knots; constant before the first and after the last time."""
    return np.stack([np.interp(path.knots_s, times_s, column) for column in values.T], axis=1)
