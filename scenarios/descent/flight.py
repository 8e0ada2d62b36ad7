"""True motion of a descent: simulated dynamics, a custom motion, or a recorded flight."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from marsyard.scenarios.descent.faults import add_time_fault
from marsyard.scenarios.descent.parameters import IMU_MARGIN_S, SIMULATED_LEAD_S, DescentScenarioParameters
from marsyard.scenarios.descent.recorded import END_MARGIN_S, check_looks_down
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.parts.motions import CustomMotion, MotionInputs
from marsyard.sim.dynamics import State, Trajectory
from marsyard.sim.dynamics.pose_files import TrajectoryFileError
from marsyard.sim.dynamics.recorded import RecordedMotion
from marsyard.sim.dynamics.swing import SwingDescent
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Environment, Surface

#: Number of times at which the height of a recorded or custom flight is compared with the firing height.
_SEARCH_TIMES = 2000


@dataclass(frozen=True)
class DescentFlight:
    """Motion of a descent.

    - motion: true motion over time; time 0 is that of the first image
    - lead_s: duration of the motion before the first image
    - firing_s: time of the thrusters' firing: at the height `thruster_firing_m` above the ground, or at the end of a
      motion that ends above this height
    - row: result columns of a custom motion
    """

    motion: Trajectory
    lead_s: float
    firing_s: float
    row: Mapping[str, Scalar] = field(default_factory=dict)


def gravity_m_s2(p: DescentScenarioParameters) -> float:
    """Return the gravity of the site, or of Mars for a generic terrain."""
    return (Environment() if p.site_preset is None else p.site_preset.environment).gravity_m_s2


def create_flight(p: DescentScenarioParameters, surface: Surface, streams: Streams) -> DescentFlight:
    """Create the motion of a case: its first image is at the specified height, or at the recorded position.

    Raises ValueError if a recorded or custom motion is below the ground at an image, or a custom motion is invalid.
    """
    ground = float(surface.height(p.location.east_m, p.location.north_m))
    site_m = np.array([p.location.east_m, p.location.north_m, ground])
    times = add_time_fault(p.faults, p.image_times_s)
    if p.flight is None:
        descent = SwingDescent.simulate(
            p.descent,
            site_m + np.array([0.0, 0.0, p.descent.altitude_first_m]),
            streams.generator("gusts"),
            ground_height_m=ground,
            gravity_m_s2=gravity_m_s2(p),
            lead_s=SIMULATED_LEAD_S,
        )
        return DescentFlight(descent, SIMULATED_LEAD_S, descent.thruster_firing_s)
    motion: RecordedMotion
    row: Mapping[str, Scalar] = {}
    if isinstance(p.flight, CustomMotion):
        inputs = MotionInputs(
            ground_height=lambda east, north: float(surface.height(site_m[0] + east, site_m[1] + north) - site_m[2]),
            gravity_m_s2=gravity_m_s2(p),
            image_times_s=tuple(times),
            from_s=-p.flight.lead_s,
            until_s=max(times) + END_MARGIN_S,
            firing_height_m=p.descent.thruster_firing_m,
        )
        motion, row = p.flight.compute(inputs, site_m, streams.generator("own motion"))
        check_looks_down(p.flight.motion, motion, times)
    else:
        motion = p.flight.create_trajectory(site_m, gravity_m_s2(p))
    positions = motion.motion(np.array(times)).positions_m
    heights = positions[:, 2] - surface.height(positions[:, 0], positions[:, 1])
    invalid_indices = np.flatnonzero(heights <= 0.0)
    if invalid_indices.size:
        index = invalid_indices[0]
        raise TrajectoryFileError(
            f"{p.flight.motion if isinstance(p.flight, CustomMotion) else p.flight.file}: at image {index + 1} "
            f"the camera is {-heights[index]:.1f} m below the ground; allowed: above it"
        )
    return DescentFlight(motion, p.flight.lead_s, _find_firing_time(p, motion, surface), row)


def _find_firing_time(p: DescentScenarioParameters, motion: Trajectory, surface: Surface) -> float:
    """Return the first time at the firing height, relative to the ground below the first image, or the last time."""
    times = np.linspace(max(p.image_times_s), motion.span_s[1] - IMU_MARGIN_S, _SEARCH_TIMES)
    east_m, north_m, _ = motion.state(0.0).position_m
    heights = motion.motion(times).positions_m[:, 2] - float(surface.height(east_m, north_m))
    indices = np.flatnonzero(heights <= p.descent.thruster_firing_m)
    if not indices.size or indices[0] == 0:
        return float(times[0 if indices.size else -1])
    # the height decreases; its sign changes because `np.interp` needs increasing values
    crossing = slice(indices[0] - 1, indices[0] + 1)
    return float(np.interp(-p.descent.thruster_firing_m, -heights[crossing], times[crossing]))


def states_at_images(p: DescentScenarioParameters, flight: DescentFlight) -> list[State]:
    """Return the true states at the exposures. Raises ValueError for an image after the thrusters' firing."""
    times = add_time_fault(p.faults, p.image_times_s)
    late_numbers = [number for number, time in enumerate(times, start=1) if time > flight.firing_s]
    if late_numbers:
        raise ValueError(
            f"image {late_numbers[0]} of {p.images} would be taken at {times[late_numbers[0] - 1]:.2f} s, after the "
            f"thrusters' firing at {flight.firing_s:.2f} s; allowed: fewer images, or a smaller descent.interval_s"
        )
    return [flight.motion.state(time) for time in times]


def mean_velocities(states: Sequence[State]) -> Float64[np.ndarray, "intervals 3"]:
    """Compute the true mean velocities of the camera between the images, world axes, m/s."""
    times = np.array([state.time_s for state in states])
    positions = np.stack([state.position_m for state in states])
    return np.asarray(np.diff(positions, axis=0) / np.diff(times)[:, None])


def true_velocity(
    motion: Trajectory, states: Sequence[State], tags_s: Sequence[float], span_s: tuple[float, float]
) -> Float64[np.ndarray, "2"]:
    """Compute the camera's true mean horizontal velocity over a span of time tags, or its velocity at one tag, m/s.

    The time tag of an image is mapped to its true exposure time; tags between images are interpolated. Tag errors
    therefore do not change the true velocity between two images.
    """

    def state_at(tag_s: float) -> State:
        if tag_s in tags_s:
            return states[list(tags_s).index(tag_s)]
        return motion.state(float(np.interp(tag_s, tags_s, [state.time_s for state in states])))

    first, second = (state_at(tag) for tag in span_s)
    if second.time_s == first.time_s:
        return np.asarray(first.velocity_m_s[:2])
    return np.asarray((second.position_m - first.position_m)[:2] / (second.time_s - first.time_s))
