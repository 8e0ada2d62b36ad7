"""What is stored of a descent: errors, conditions as read back from the simulated objects, pictures."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from algorithms.dimes import DimesDetails, dimes_products
from algorithms.interface import VelocityEstimate
from scenarios.descent.exposure import Exposure
from scenarios.descent.flight import PICTURES, off_nadir_deg
from scenarios.descent.parameters import DescentScenarioParameters
from scenarios.interface import Scalar
from sim.measurements import DescentMeasurements
from sim.processor import processor_features
from sim.render import Sun, process_renderer
from sim.sensor import Altimeter


def score(estimate: VelocityEstimate, true_velocity: Float64[np.ndarray, "3"]) -> dict[str, Scalar]:
    """Horizontal velocity and its error against the true mean velocity between the second and third picture."""
    estimated = np.full(2, np.nan) if estimate.velocity_m_s is None else estimate.velocity_m_s
    error = estimated - true_velocity[:2]
    return {
        "velocity_error_m_s": float(np.hypot(*error)),
        "velocity_error_x_m_s": float(error[0]),
        "velocity_error_y_m_s": float(error[1]),
        "velocity_estimated_x_m_s": float(estimated[0]),
        "velocity_estimated_y_m_s": float(estimated[1]),
        "velocity_true_x_m_s": float(true_velocity[0]),
        "velocity_true_y_m_s": float(true_velocity[1]),
    }


def conditions(
    p: DescentScenarioParameters,
    exposures: Sequence[Exposure],
    measurements: DescentMeasurements,
    altimeter: Altimeter,
    sun: Sun,
) -> dict[str, Scalar]:
    """What the case was like, read from the simulated objects."""
    states = [exposure.state for exposure in exposures]
    row: dict[str, Scalar] = {
        "site": p.site or "plain",
        "terrain": p.place.terrain,
        "place_east_m": p.place.east_m,
        "place_north_m": p.place.north_m,
        "sun_azimuth_deg": float(np.degrees(np.arctan2(sun.direction[0], sun.direction[1])) % 360.0),
        "sun_elevation_deg": float(np.degrees(np.arcsin(sun.direction[2]))),
        "horizontal_speed_m_s": float(np.hypot(*states[-1].velocity_m_s[:2])),
        "descent_rate_m_s": float(-states[-1].velocity_m_s[2]),
    }
    for number, state in enumerate(states, start=1):
        attitude_error = measurements.attitudes[number - 1].world_from_body * state.attitude.inv()
        true_altitude = altimeter.true_altitude(state.position_m)
        row[f"altitude_{number}_m"] = true_altitude
        row[f"altitude_error_{number}_m"] = measurements.altitudes[number - 1].altitude_m - true_altitude
        row[f"off_nadir_{number}_deg"] = off_nadir_deg(state)
        row[f"attitude_rate_{number}_deg_s"] = float(np.degrees(np.linalg.norm(state.body_rate_rad_s)))
        row[f"attitude_error_{number}_deg"] = float(np.degrees(attitude_error.magnitude()))
        row[f"tag_error_{number}_s"] = measurements.images[number - 1].time_s - state.time_s
    row["off_nadir_max_deg"] = max(off_nadir_deg(state) for state in states)
    row["attitude_rate_max_deg_s"] = max(float(row[f"attitude_rate_{k}_deg_s"]) for k in range(1, PICTURES + 1))
    return row


def provenance(p: DescentScenarioParameters, exposures: Sequence[Exposure]) -> dict[str, Scalar]:
    """Hash of the pictures, and what their last bits depend on."""
    digest = hashlib.sha256()
    for exposure in exposures:
        digest.update(np.ascontiguousarray(exposure.counts).tobytes())
    return {
        "image_hash": digest.hexdigest(),
        "gl_backend": p.render.backend,
        "gl_version": process_renderer(p.render.backend).description(),
        "processor_features": processor_features(),
    }


def products(
    exposures: Sequence[Exposure], estimate: VelocityEstimate, true_velocity: Float64[np.ndarray, "3"]
) -> dict[str, object]:
    """Arrays from which the case's figures are drawn."""
    kept: dict[str, object] = {f"image_{number}": one.counts for number, one in enumerate(exposures, start=1)}
    if isinstance(estimate.details, DimesDetails):
        kept.update(dimes_products(estimate.details))
    kept["velocity_true_m_s"] = true_velocity[:2]
    if estimate.velocity_m_s is not None:
        kept["velocity_estimated_m_s"] = estimate.velocity_m_s
    return kept
