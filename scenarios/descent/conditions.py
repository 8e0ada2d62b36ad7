"""Columns of a descent that do not depend on an algorithm: conditions and measurement errors."""

from collections.abc import Sequence

import numpy as np

from marsyard.algorithms.dimes.views import altitudes_at_images
from marsyard.scenarios.condition_columns import attitude_rate_deg_s, off_nadir_deg, sun_columns
from marsyard.scenarios.descent.flight import mean_velocities
from marsyard.scenarios.descent.measurements import DescentInstruments
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.descent.world import DescentWorld
from marsyard.scenarios.interface import Scalar
from marsyard.sim.dynamics import State
from marsyard.sim.measurements import DescentMeasurements
from marsyard.sim.sensor import height_above_ground


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
    p: DescentScenarioParameters, world: DescentWorld, states: Sequence[State], measurements: DescentMeasurements
) -> dict[str, Scalar]:
    """Compute the columns of measurement errors, split into a part common to all images and an independent part.

    The common attitude error is the mean of the images' rotation vectors (world axes); the independent part is the
    RMS length of the residuals. Relative altitude errors are split likewise. True altitudes are heights above the
    ground directly below; a radar return from nearer relief is therefore an error. The velocity change is that between
    the image pairs of the triple.
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
    residuals = rotations - rotations.mean(axis=0)
    row: dict[str, Scalar] = {
        "attitude_error_common_deg": float(np.degrees(np.linalg.norm(rotations.mean(axis=0)))),
        "attitude_error_independent_deg": float(np.degrees(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))),
        "altitude_error_common": float(relative_errors.mean()),
        "altitude_error_independent": float(np.sqrt(np.mean((relative_errors - relative_errors.mean()) ** 2))),
    }
    if p.triple_indices is not None:
        true_m_s = mean_velocities([states[index] for index in p.triple_indices])
        errors_m_s = (measurements.select(p.triple_indices).interval_velocities_m_s - true_m_s)[:, :2]
        row["velocity_change_error_m_s"] = float(np.hypot(*(errors_m_s[1] - errors_m_s[0])))
    for number, (rotation, error, tag_error) in enumerate(
        zip(rotations, relative_errors, tag_errors, strict=True), start=1
    ):
        row[f"attitude_error_{number}_deg"] = float(np.degrees(np.linalg.norm(rotation)))
        row[f"altitude_error_{number}_m"] = float(error * heights[number - 1])
        row[f"tag_error_{number}_s"] = float(tag_error)
    return row
