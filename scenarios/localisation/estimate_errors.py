"""Errors of position estimates, relative to the map and to the world.

Horizontal errors are relative to the map: the reference is the map position below which the lander truly is. The error
relative to the world also contains the map's registration and distortion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.algorithms.localisation.interface import PositionEstimate, PositionOutcome
from marsyard.scenarios.localisation.map_truth import MapTruth
from marsyard.scenarios.localisation.simulation import LocalisedDescent
from marsyard.scenarios.streamed import StreamAnswers
from marsyard.sim.dynamics import State


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
    """Compute the errors of each estimate, None for a refusal.

    Estimates have time tags of the inertial unit, whose offset is subtracted for the true time.
    """
    first, last = descent.flight.span_s
    return [
        EstimateErrors.from_estimate(
            estimate,
            descent.flight.state(float(np.clip(estimate.time_s - descent.imu_offset_s, first, last))),
            descent.map_truth,
        )
        if estimate.outcome is PositionOutcome.VALID
        else None
        for estimate in answers.estimates
    ]
