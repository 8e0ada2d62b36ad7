"""Columns of a triple that do not depend on an algorithm: conditions and measurement errors."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from marsyard.scenarios import condition_columns
from marsyard.scenarios.fieldtest.flight import FlownRun
from marsyard.scenarios.fieldtest.images import sun_at
from marsyard.scenarios.fieldtest.measurements import TripleCase
from marsyard.scenarios.fieldtest.parameters import FieldTestParameters
from marsyard.scenarios.fieldtest.triples import Category
from marsyard.scenarios.interface import Scalar
from marsyard.sim.measurements import DescentMeasurements
from marsyard.sim.render import Frame
from marsyard.sim.sensor.altimeters import height_above_ground
from marsyard.sim.terrain import Surface

#: Spacing of the grid on which cloud transmittance is evaluated, pixels.
_CLOUD_GRID_PX = 32


def triple_columns(
    p: FieldTestParameters, case: TripleCase, measurements: DescentMeasurements, surface: Surface
) -> dict[str, Scalar]:
    """Compute the columns of a triple: run, motion and measurement errors; `surface` is that of the true ground."""
    run, indices, second = case.run, case.triple.image_indices, case.states[1]
    true_altitudes = height_above_ground(surface, np.stack([state.position_m for state in case.states]))
    row: dict[str, Scalar] = {
        "run": run.flown.parameters.name,
        "category": str(case.triple.category),
        "one_direction": case.triple.category is not Category.OPPOSITE_DIRECTION,
        "clear_sky": run.flown.clouds is None,
        "intact_cable": run.flown.parameters.cable_bursts == 0.0,
        "noisy_cable": run.flown.parameters.cable_bursts > 0.0,
        "site": run.flown.parameters.site,
        "terrain": p.site_names.index(run.flown.parameters.site),
        "location_east_m": float(second.position_m[0]),
        "location_north_m": float(second.position_m[1]),
        **condition_columns.sun_columns(measurements.sun_direction),
        "horizontal_speed_m_s": float(np.hypot(*case.states[-1].velocity_m_s[:2])),
    }
    errors = []
    samples = zip(case.states, measurements.attitudes, measurements.altitudes, true_altitudes, strict=True)
    for number, (state, attitude, altitude, true_altitude) in enumerate(samples, start=1):
        errors.append((attitude.world_from_body * state.attitude.inv()).as_rotvec())
        row[f"image_time_{number}_s"] = state.time_s
        row[f"pass_{number}"] = int(run.images.pass_number[indices[number - 1]])
        row[f"altitude_{number}_m"] = float(true_altitude)
        row[f"altitude_error_{number}_m"] = altitude.altitude_m - float(true_altitude)
        row[f"off_nadir_{number}_deg"] = condition_columns.off_nadir_deg(state)
        row[f"attitude_rate_{number}_deg_s"] = condition_columns.attitude_rate_deg_s(state)
        row[f"attitude_error_{number}_deg"] = float(np.degrees(np.linalg.norm(errors[-1])))
    for pair in (1, 2):
        row[f"attitude_change_{pair}_deg"] = float(np.degrees(np.linalg.norm(errors[pair] - errors[pair - 1])))
        row[f"interval_{pair}_s"] = abs(case.states[pair].time_s - case.states[pair - 1].time_s)
    # a rotation vector e moves the nadir point at height h by h (-e_y, e_x)
    second_shift, third_shift = (
        height * error[:2] for height, error in zip(true_altitudes[1:], errors[1:], strict=True)
    )
    shift_m = float(np.linalg.norm(third_shift - second_shift))
    row["attitude_velocity_error_m_s"] = shift_m / p.triples.virtual_interval_s
    row["off_nadir_max_deg"] = max(condition_columns.off_nadir_deg(state) for state in case.states)
    row["attitude_rate_max_deg_s"] = max(condition_columns.attitude_rate_deg_s(state) for state in case.states)
    return row


def cloud_columns(case: TripleCase, second: Frame) -> dict[str, Scalar]:
    """Compute the mean cloud transmittance on the ground of the second image at each image, and its changes."""
    ground_m = second.points_world(np.s_[::_CLOUD_GRID_PX, ::_CLOUD_GRID_PX])
    transmittances = cloud_transmittances(case.run.flown, ground_m, [state.time_s for state in case.states])
    changes = np.abs(np.diff(transmittances, axis=0))
    return {
        **{f"cloud_transmittance_{n}": float(np.nanmean(field)) for n, field in enumerate(transmittances, start=1)},
        **{f"cloud_change_{pair}": float(np.nanmean(change)) for pair, change in enumerate(changes, start=1)},
    }


def cloud_transmittances(
    flown: FlownRun, ground_m: Float64[np.ndarray, "m n 3"], times_s: Sequence[float]
) -> Float64[np.ndarray, "times m n"]:
    """Compute the fraction of direct sunlight that clouds transmit to points on the ground."""
    if flown.clouds is None:
        return np.ones((len(times_s), *ground_m.shape[:2]))
    return np.stack([flown.clouds.transmittance(ground_m, sun_at(flown, time), time) for time in times_s])
