"""The true motion of a descent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from scenarios.descent.faults import faulty_times
from scenarios.descent.parameters import DescentScenarioParameters
from sim.dynamics import State, SwingDescent
from sim.streams import Streams
from sim.terrain import Surface

PICTURES = 3
#: Gravity over a plain terrain: Mars.
MARS_GRAVITY_M_S2 = 3.72
#: How long before the first picture the flight is known, s.
LEAD_S = 5.0


def gravity_m_s2(p: DescentScenarioParameters) -> float:
    """Gravity of the site."""
    return MARS_GRAVITY_M_S2 if p.preset is None else p.preset.environment.gravity_m_s2


def flown_descent(p: DescentScenarioParameters, surface: Surface, streams: Streams) -> SwingDescent:
    """The descent whose first picture is taken at the stated height above the ground below."""
    ground = float(surface.height(p.place.east_m, p.place.north_m))
    start = np.array([p.place.east_m, p.place.north_m, ground + p.descent.altitude_first_m])
    return SwingDescent.flown(
        p.descent,
        start,
        streams.generator("gusts"),
        ground_height_m=ground,
        gravity_m_s2=gravity_m_s2(p),
        lead_s=LEAD_S,
    )


def nominal_times_s(p: DescentScenarioParameters) -> list[float]:
    """When pictures should be taken."""
    return [number * p.descent.interval_s for number in range(PICTURES)]


def picture_states(p: DescentScenarioParameters, descent: SwingDescent) -> list[State]:
    """Truth at the three exposures."""
    return [descent.state(time) for time in faulty_times(p.faults, nominal_times_s(p))]


def mean_velocities(states: Sequence[State]) -> Float64[np.ndarray, "2 3"]:
    """True mean velocities of the camera between the pictures, world axes, m/s."""
    positions = np.stack([state.position_m for state in states])
    times = np.array([state.time_s for state in states])
    velocities: Float64[np.ndarray, "2 3"] = np.diff(positions, axis=0) / np.diff(times)[:, None]
    return velocities


def off_nadir_deg(state: State) -> float:
    """Angle between the body's axis, along which the camera looks, and nadir."""
    return float(np.degrees(np.arccos(np.clip(state.attitude.as_matrix()[2, 2], -1.0, 1.0))))
