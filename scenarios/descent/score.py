"""What is stored of a descent: errors, conditions as read back from the simulated objects, pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, UInt16

from marsyard.algorithms.dimes import DimesDetails, propagated
from marsyard.algorithms.dimes.binning import altitudes_at_images
from marsyard.algorithms.interface import VelocityEstimate
from marsyard.scenarios.conditions import attitude_rate_deg_s, off_nadir_deg, sun_columns
from marsyard.scenarios.descent.flight import mean_velocities
from marsyard.scenarios.descent.landing import Touchdown, is_in_time
from marsyard.scenarios.descent.measurement import Instruments
from marsyard.scenarios.descent.parameters import DescentScenarioParameters, LandingParameters
from marsyard.scenarios.descent.world import World
from marsyard.scenarios.interface import Scalar
from marsyard.sim.dynamics import State
from marsyard.sim.measurements import DescentMeasurements
from marsyard.sim.sensor import height_above_ground

Pictures = Sequence[UInt16[np.ndarray, "rows columns"]]
Horizontal = Float64[np.ndarray, "2"]


def carried_to_firing(
    estimate: VelocityEstimate | None, instruments: Instruments, firing_s: float
) -> Horizontal | None:
    """The reported velocity, carried on to the thrusters' firing by the inertial unit; None where none was reported."""
    if estimate is None or estimate.velocity_m_s is None or estimate.span_s is None:
        return None
    navigation, span = instruments.navigation, np.array(estimate.span_s)
    of_instant = estimate.span_s[0] == estimate.span_s[1]
    then = (navigation.velocity(span) if of_instant else navigation.mean_velocities(span))[0]
    now = navigation.velocity(np.array([firing_s]))[0]
    return propagated(estimate.velocity_m_s, then[:2], now[:2])


def conditions(
    p: DescentScenarioParameters, world: World, states: Sequence[State], at_firing: State
) -> dict[str, Scalar]:
    """What the case was like, read from the simulated objects."""
    heights = height_above_ground(world.surface, np.stack([state.position_m for state in states]))
    row: dict[str, Scalar] = {
        "site": p.site or "plain",
        "terrain": p.place.terrain,
        **p.faults.columns,
        "place_east_m": float(states[0].position_m[0]),
        "place_north_m": float(states[0].position_m[1]),
        **sun_columns(world.sun.direction),
        "horizontal_speed_m_s": float(np.hypot(*states[-1].velocity_m_s[:2])),
        "descent_rate_m_s": float(-np.diff([states[0].position_m[2], states[-1].position_m[2]])[0])
        / (states[-1].time_s - states[0].time_s),
        "firing_after_s": at_firing.time_s - states[-1].time_s,
    }
    for number, (state, height) in enumerate(zip(states, heights, strict=True), start=1):
        row[f"altitude_{number}_m"] = float(height)
        row[f"off_nadir_{number}_deg"] = off_nadir_deg(state)
        row[f"attitude_rate_{number}_deg_s"] = attitude_rate_deg_s(state)
    row["off_nadir_max_deg"] = max(off_nadir_deg(state) for state in states)
    row["attitude_rate_max_deg_s"] = max(attitude_rate_deg_s(state) for state in states)
    return row


def instrument_conditions(instruments: Instruments) -> dict[str, Scalar]:
    """What the instruments went through: the azimuth of flight before entry, and the change of temperature."""
    approach = instruments.approach
    flight = -approach.attitudes(np.array([approach.start_s])).as_matrix()[0, :, 2]
    change_k = instruments.imu.gyro.warm_up.temperature_k(np.array([np.inf]))[0]
    return {
        "approach_heading_deg": float(np.degrees(np.arctan2(flight[0], flight[1])) % 360.0),
        "imu_warm_up_change_k": float(change_k),
        **instruments.row,
    }


def instrument_errors(world: World, states: Sequence[State], measurements: DescentMeasurements) -> dict[str, Scalar]:
    """Errors of what was measured, divided into what the pictures share and what each has of its own.

    The shared part of an attitude error is the mean of the three rotation vectors (world axes), the own part the RMS
    length of what is left; altitude errors, as shares of the altitude, likewise. Altitudes are those at the pictures,
    over the ground straight below: relief that the radar sees nearer is part of their error. The change of velocity is
    that from the last interval but one to the last.
    """
    turned = np.stack(
        [
            (measured.world_from_body * state.attitude.inv()).as_rotvec()
            for measured, state in zip(measurements.attitudes, states, strict=True)
        ]
    )
    heights = height_above_ground(world.surface, np.stack([state.position_m for state in states]))
    shares = altitudes_at_images(measurements) / heights - 1.0
    tags = np.array([image.time_s for image in measurements.images]) - np.array([state.time_s for state in states])
    true_changes, changes = (
        np.diff(velocities[:, :2], axis=0)
        for velocities in (mean_velocities(states), measurements.interval_velocities_m_s)
    )
    row: dict[str, Scalar] = {
        "attitude_error_common_deg": float(np.degrees(np.linalg.norm(turned.mean(axis=0)))),
        "attitude_error_own_deg": float(
            np.degrees(np.sqrt(np.mean(np.sum((turned - turned.mean(axis=0)) ** 2, axis=1))))
        ),
        "altitude_error_common": float(shares.mean()),
        "altitude_error_own": float(np.sqrt(np.mean((shares - shares.mean()) ** 2))),
    }
    if len(changes):
        row["velocity_change_error_m_s"] = float(np.hypot(*(changes[-1] - true_changes[-1])))
    for number, (rotation, share, tag) in enumerate(zip(turned, shares, tags, strict=True), start=1):
        row[f"attitude_error_{number}_deg"] = float(np.degrees(np.linalg.norm(rotation)))
        row[f"altitude_error_{number}_m"] = float(share * heights[number - 1])
        row[f"tag_error_{number}_s"] = float(tag)
    return row


def landing_row(p: LandingParameters, landed: Touchdown, measured_s: float, available_s: float) -> dict[str, Scalar]:
    """What the answer did to the landing, and whether it came in time by the time that was measured."""
    return {
        "touchdown_speed_with_m_s": float(np.hypot(*landed.with_answer)),
        "touchdown_speed_without_m_s": float(np.hypot(*landed.without_answer)),
        "answer_punctual": landed.punctual,
        "answer_in_time": is_in_time(p, measured_s, available_s),
    }


def room_row(places: tuple[int, int] | None) -> dict[str, Scalar]:
    """In how many places DIMES has room in its pairs of pictures; nothing where it has no three pictures."""
    if places is None:
        return {}
    return {"room": min(places) > 0, "room_first_pair": places[0], "room_second_pair": places[1]}


def shown(pictures: Pictures, estimate: VelocityEstimate | None, triple: tuple[int, int, int] | None) -> Pictures:
    """The pictures that a case's figures show: of DIMES the three that it was given."""
    ours = estimate is not None and isinstance(estimate.details, DimesDetails)
    return [pictures[place] for place in triple] if ours and triple is not None else pictures
