"""Result columns of a descent: conditions, measurement errors, and the landing with the estimate."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt16
from scipy.spatial.transform import Rotation

from marsyard.algorithms.dimes import propagate_velocity
from marsyard.algorithms.dimes.views import altitudes_at_images
from marsyard.algorithms.interface import VelocityEstimate
from marsyard.scenarios.condition_columns import attitude_rate_deg_s, off_nadir_deg, sun_columns
from marsyard.scenarios.descent.flight import mean_velocities
from marsyard.scenarios.descent.measurement import DescentInstruments
from marsyard.scenarios.descent.parameters import DescentScenarioParameters, LandingParameters
from marsyard.scenarios.descent.world import DescentWorld
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.velocity import Horizontal
from marsyard.sim.dynamics import State
from marsyard.sim.measurements import DescentMeasurements
from marsyard.sim.sensor import height_above_ground

Images = Sequence[UInt16[np.ndarray, "rows columns"]]


@dataclass(frozen=True)
class TouchdownVelocities:
    """Horizontal touchdown velocities of a descent, steered with the estimate and without it, m/s.

    - is_in_time: with the assumed computation time, the estimate is available before the rockets fire
    """

    with_answer: Horizontal
    without_answer: Horizontal
    is_in_time: bool


def compute_touchdown(
    p: LandingParameters,
    true_m_s: Horizontal,
    estimated_m_s: Horizontal | None,
    available_s: float,
    rng: np.random.Generator,
) -> TouchdownVelocities:
    """Compute touchdown velocities with a simple model of MER's last seconds; `rng` draws errors of burn and steering.

    Solid rockets in the backshell stop the fall near 100 m; small rockets next to them (TIRS) can tilt the backshell
    first to give the burn a horizontal component. The touchdown velocity is the horizontal velocity at the rockets'
    firing plus an error of the burn. If an estimate is available in time and exceeds the deadband, the burn is steered
    against the estimate, up to the tilt limit. Otherwise the burn is not steered. Swinging and wind during the burn of
    three seconds are not modelled. The computation time is an assumed constant, so that rows are reproducible bit for
    bit.

    - true_m_s: horizontal velocity of the lander at the rockets' firing
    - estimated_m_s: the estimate, propagated to that time by the inertial unit; None without an estimate
    - available_s: time from the last image to the firing
    """
    burn, steering = p.burn_error_m_s * rng.standard_normal(2), p.steering_error * rng.standard_normal(2)
    unsteered = true_m_s + burn
    is_in_time = p.computation_s <= available_s
    speed = 0.0 if estimated_m_s is None else float(np.hypot(*estimated_m_s))
    if estimated_m_s is None or not is_in_time or speed <= p.steering_deadband_m_s:
        return TouchdownVelocities(unsteered, unsteered, is_in_time)
    correction = estimated_m_s * min(1.0, p.max_steering_m_s / speed)
    return TouchdownVelocities(unsteered - correction + steering * np.hypot(*correction), unsteered, is_in_time)


def propagate_to_firing(
    estimate: VelocityEstimate | None, instruments: DescentInstruments, firing_s: float, gravity_m_s2: float
) -> Horizontal | None:
    """Propagate the estimate to the thrusters' firing with the inertial unit; None without an estimate.

    The attitude error that the estimate reports corrects the inertial velocity change: navigation rotates the specific
    force with its attitude, and adds gravity along the true vertical.
    """
    if estimate is None or estimate.velocity_m_s is None or estimate.span_s is None:
        return None
    navigation, span = instruments.navigation, np.array(estimate.span_s)
    is_instant = estimate.span_s[0] == estimate.span_s[1]
    start = (navigation.velocity(span) if is_instant else navigation.mean_velocities(span))[0]
    end = navigation.velocity(np.array([firing_s]))[0]
    if estimate.attitude_error_rad is not None:
        by_gravity = np.array([0.0, 0.0, -gravity_m_s2 * (firing_s - span.mean())])
        by_force = end - start - by_gravity
        end = start + by_gravity + Rotation.from_rotvec(-estimate.attitude_error_rad).apply(by_force)
    return propagate_velocity(estimate.velocity_m_s, start[:2], end[:2])


def conditions(
    p: DescentScenarioParameters,
    world: DescentWorld,
    states: Sequence[State],
    at_firing: State,
    instruments: DescentInstruments,
) -> dict[str, Scalar]:
    """Compute the columns of a case's conditions: true states, and the columns of custom instruments."""
    heights = height_above_ground(world.surface, np.stack([state.position_m for state in states]))
    row: dict[str, Scalar] = {
        "site": p.site or "plain",
        "terrain": p.location.terrain,
        **p.faults.columns,
        **sun_columns(world.sun.direction),
        "horizontal_speed_m_s": float(np.hypot(*states[-1].velocity_m_s[:2])),
        "descent_rate_m_s": float(states[0].position_m[2] - states[-1].position_m[2])
        / (states[-1].time_s - states[0].time_s),
        "firing_after_s": at_firing.time_s - states[-1].time_s,
    }
    for number, (state, height) in enumerate(zip(states, heights, strict=True), start=1):
        row[f"altitude_{number}_m"] = float(height)
        row[f"off_nadir_{number}_deg"] = off_nadir_deg(state)
        row[f"attitude_rate_{number}_deg_s"] = attitude_rate_deg_s(state)
    row["off_nadir_max_deg"] = max(off_nadir_deg(state) for state in states)
    row["attitude_rate_max_deg_s"] = max(attitude_rate_deg_s(state) for state in states)
    return {**row, **instruments.row}


def instrument_errors(
    world: DescentWorld, states: Sequence[State], measurements: DescentMeasurements
) -> dict[str, Scalar]:
    """Compute the columns of measurement errors, split into a part common to all images and an independent part.

    The common attitude error is the mean of the images' rotation vectors (world axes); the independent part is the
    RMS length of the residuals. Relative altitude errors are split likewise. True altitudes are heights above the
    ground directly below; a radar return from nearer relief is therefore an error. The velocity change is that between
    the last two intervals.
    """
    rotations = np.stack(
        [
            (measured.world_from_body * state.attitude.inv()).as_rotvec()
            for measured, state in zip(measurements.attitudes, states, strict=True)
        ]
    )
    heights = height_above_ground(world.surface, np.stack([state.position_m for state in states]))
    relative_errors = altitudes_at_images(measurements) / heights - 1.0
    tag_errors = np.array([image.time_s for image in measurements.images]) - np.array(
        [state.time_s for state in states]
    )
    true_changes, changes = (
        np.diff(velocities[:, :2], axis=0)
        for velocities in (mean_velocities(states), measurements.interval_velocities_m_s)
    )
    residuals = rotations - rotations.mean(axis=0)
    row: dict[str, Scalar] = {
        "attitude_error_common_deg": float(np.degrees(np.linalg.norm(rotations.mean(axis=0)))),
        "attitude_error_independent_deg": float(np.degrees(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))),
        "altitude_error_common": float(relative_errors.mean()),
        "altitude_error_independent": float(np.sqrt(np.mean((relative_errors - relative_errors.mean()) ** 2))),
    }
    if len(changes):
        row["velocity_change_error_m_s"] = float(np.hypot(*(changes[-1] - true_changes[-1])))
    for number, (rotation, error, tag_error) in enumerate(
        zip(rotations, relative_errors, tag_errors, strict=True), start=1
    ):
        row[f"attitude_error_{number}_deg"] = float(np.degrees(np.linalg.norm(rotation)))
        row[f"altitude_error_{number}_m"] = float(error * heights[number - 1])
        row[f"tag_error_{number}_s"] = float(tag_error)
    return row
