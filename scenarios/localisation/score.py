"""Columns of a localisation case: conditions, errors of the estimates, covariance consistency, times.

Horizontal errors are relative to the map: the reference is the map position below which the lander truly is. The error
relative to the world also contains the registration and the distortion of the map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.algorithms.localisation.details import LocalisationDetails
from marsyard.algorithms.localisation.interface import PositionEstimate, PositionOutcome
from marsyard.scenarios.condition_columns import attitude_rate_deg_s, contrast_columns, off_nadir_deg, sun_columns
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.localisation.map_truth import MapTruth
from marsyard.scenarios.localisation.simulation import LocalisedDescent
from marsyard.scenarios.localisation.world import LocalisationWorld
from marsyard.scenarios.radiance import sun_at
from marsyard.scenarios.streamed import StreamAnswers
from marsyard.sim.dynamics import State

#: Required horizontal accuracy, m, and time after the start in which it is required, s (Mars 2020).
REQUIRED_M, REQUIRED_S = 40.0, 10.0


def attitude_error_deg(estimate: Rotation, truth: State) -> float:
    """Compute the angle between the estimated and the true attitude (both world from body)."""
    return float(np.degrees((truth.attitude * estimate.inv()).magnitude()))


@dataclass(frozen=True)
class EstimateErrors:
    """Errors of one valid estimate: estimate minus truth.

    - position_m: error (east, north, up) relative to the map
    - world_m: horizontal error (east, north) relative to the world
    - velocity_m_s, attitude_deg: magnitudes of the velocity error and of the attitude error
    - sd_m: standard deviations of the position according to the estimator
    - nees: normalised squared error of the horizontal position, chi-square with 2 degrees of freedom if consistent
    """

    time_s: float
    position_m: Float64[np.ndarray, "3"]
    world_m: Float64[np.ndarray, "2"]
    velocity_m_s: float
    attitude_deg: float
    sd_m: Float64[np.ndarray, "3"]
    nees: float

    @property
    def horizontal_m(self) -> float:
        """Horizontal error relative to the map."""
        return float(np.hypot(*self.position_m[:2]))

    @classmethod
    def from_estimate(cls, estimate: PositionEstimate, truth: State, map_truth: MapTruth) -> EstimateErrors:
        """Compute the errors of a valid estimate from the true state at its time. Raises ValueError for a refusal."""
        if (
            estimate.position_m is None
            or estimate.velocity_m_s is None
            or estimate.world_from_body is None
            or estimate.covariance is None
        ):
            raise ValueError(f"the estimate is {estimate.outcome.name}; allowed: VALID")
        reference = np.append(map_truth.map_position(truth.position_m[:2]), truth.position_m[2])
        error = estimate.position_m - reference
        horizontal = estimate.covariance[:2, :2]
        return cls(
            time_s=estimate.time_s,
            position_m=error,
            world_m=estimate.position_m[:2] - truth.position_m[:2],
            velocity_m_s=float(np.linalg.norm(estimate.velocity_m_s - truth.velocity_m_s)),
            attitude_deg=attitude_error_deg(estimate.world_from_body, truth),
            sd_m=np.sqrt(np.diag(estimate.covariance)[:3]),
            nees=float(error[:2] @ np.linalg.solve(horizontal, error[:2])),
        )


def compute_errors(descent: LocalisedDescent, answers: StreamAnswers[PositionEstimate]) -> list[EstimateErrors | None]:
    """Compute the errors of each estimate, None for a refusal."""
    return [
        EstimateErrors.from_estimate(estimate, _true_state(descent, estimate.time_s), descent.map_truth)
        if estimate.outcome is PositionOutcome.VALID
        else None
        for estimate in answers.estimates
    ]


def _true_state(descent: LocalisedDescent, tag_s: float) -> State:
    """Return the true state at a time tag of the inertial unit, whose offset is subtracted for the true time."""
    return descent.flight.state(float(np.clip(tag_s - descent.imu_offset_s, *descent.flight.span_s)))


def conditions(descent: LocalisedDescent) -> dict[str, Scalar]:
    """Return the columns of a case that do not depend on an algorithm."""
    p, world, states = descent.p, descent.world, descent.image_states
    map_sun = sun_at(world.air, p.map.sun_azimuth_deg, p.map.sun_elevation_deg)
    cosine = float(np.clip(map_sun.direction @ world.sun.direction, -1.0, 1.0))
    initial, shift = descent.measurements.initial, descent.map_truth.shift_m
    reference = descent.map_truth.map_position(descent.initial_truth.position_m[:2])
    images = descent.images
    return {
        "site": p.site,
        "terrain": p.location.terrain,
        **sun_columns(world.sun.direction),
        "sun_difference_deg": float(np.degrees(np.arccos(cosine))),
        **(contrast_columns(images[0].counts, p.detector) if images else {}),
        "images": len(images),
        "map_shift_m": float(np.hypot(*shift)),
        "initial_error_m": float(np.hypot(*(initial.position_m[:2] - reference))),
        "initial_attitude_error_deg": attitude_error_deg(initial.world_from_body, descent.initial_truth),
        "off_nadir_max_deg": max(map(off_nadir_deg, states), default=np.nan),
        "attitude_rate_max_deg_s": max(map(attitude_rate_deg_s, states), default=np.nan),
        "altitude_last_m": _altitude_m(world, states[-1]) if states else np.nan,
        **p.faults.columns,
    }


def _altitude_m(world: LocalisationWorld, state: State) -> float:
    """Return the true height above the ground."""
    return float(state.position_m[2] - world.surface.height(*state.position_m[:2]))


def answer_row(descent: LocalisedDescent, answers: StreamAnswers[PositionEstimate]) -> dict[str, Scalar]:
    """Return the columns of one algorithm's answers."""
    errors = compute_errors(descent, answers)
    valid = [error for error in errors if error is not None]
    final = errors[-1]
    early = [error for estimate, error in zip(answers.estimates, errors, strict=True) if estimate.time_s <= REQUIRED_S]
    at_10_s = early[-1] if early else None
    times_s = answers.image_times_s
    details = [estimate.details for estimate in answers.after_images]
    inliers = [item.inliers for item in details if isinstance(item, LocalisationDetails) and item.inliers is not None]
    horizontal = [error.horizontal_m for error in valid]
    coarse = [
        (estimate.time_s, item.coarse_position_m)
        for estimate, item in zip(answers.estimates, details, strict=False)
        if isinstance(item, LocalisationDetails) and item.coarse_position_m is not None
    ]
    return {
        "coarse_error_m": _coarse_error_m(descent, *coarse[0]) if coarse else np.nan,
        "fix_after_s": valid[0].time_s if valid else np.nan,
        "fixed_in_time": at_10_s is not None,
        "position_reported": bool(valid),
        "position_error_at_10_s_m": np.nan if at_10_s is None else at_10_s.horizontal_m,
        "position_error_m": np.nan if final is None else final.horizontal_m,
        "position_error_max_m": max(horizontal, default=np.nan),
        "false_fix": any(error > REQUIRED_M for error in horizontal),
        "valid_images": sum(error is not None for error in errors[:-1]),
        **_final_columns(final),
        "inliers_median": float(np.median(inliers)) if inliers else np.nan,
        "inliers_min": float(min(inliers)) if inliers else np.nan,
        "image_time_max_s": max(times_s, default=0.0),
        "image_time_median_s": float(np.median(times_s)) if times_s else 0.0,
    }


def _coarse_error_m(descent: LocalisedDescent, time_s: float, position_m: Float64[np.ndarray, "2"]) -> float:
    """Return the horizontal error, relative to the map, of a position at a time of the inertial unit."""
    reference = descent.map_truth.map_position(_true_state(descent, time_s).position_m[:2])
    return float(np.hypot(*(position_m - reference)))


def _final_columns(error: EstimateErrors | None) -> dict[str, Scalar]:
    """Return components and consistency of the final error; NaN without a valid estimate."""
    names = [f"position_{kind}_{axis}_m" for kind in ("error", "sd") for axis in ("east", "north", "up")]
    names += ["position_error_world_m", "velocity_error_m_s", "attitude_error_deg", "position_nees"]
    if error is None:
        return dict.fromkeys(names, np.nan)
    values = [*error.position_m, *error.sd_m, np.hypot(*error.world_m)]
    values += [error.velocity_m_s, error.attitude_deg, error.nees]
    return {name: float(value) for name, value in zip(names, values, strict=True)}
