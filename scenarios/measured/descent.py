"""Three real pictures of a descent: estimate, what the inertial unit says, the truth where it is known."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.dimes import DimesDetails
from marsyard.algorithms.interface import VelocityEstimate
from marsyard.scenarios.base import judged_attempt
from marsyard.scenarios.estimators import VELOCITY
from marsyard.scenarios.interface import CaseResult, Scalar, record_conditions
from marsyard.scenarios.measured.case import NAN, MeasuredScenario, about, distance, tried
from marsyard.scenarios.measured.consistency import agreement_products, agreement_row, agreements, matched
from marsyard.scenarios.measured.parameters import MeasuredVelocityParameters
from marsyard.scenarios.measured.store import StoredCase, descent_measurements, images_of
from marsyard.scenarios.parts.named import SCORE, Kind
from marsyard.scenarios.parts.scores import ScoredVelocity, scored
from marsyard.scenarios.trial import Judged, case_result
from marsyard.scenarios.velocity import checked_last_interval, consistency_row, velocity_products, velocity_row
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DescentMeasurements
from marsyard.sim.streams import Streams


class MeasuredVelocityScenario(MeasuredScenario[MeasuredVelocityParameters]):
    """Three real pictures of a descent with measurements, given to a velocity estimator."""

    name = "measured-velocity"
    parameters_type = MeasuredVelocityParameters
    task = VELOCITY
    algorithm_table = ()
    part_keys: Mapping[str, Kind] = {"scores": SCORE}

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """One descent."""
        p = self.checked(parameters)
        images = images_of(p.cases, p.case)
        measurements = descent_measurements(p.case, images)
        matches = matched(images)
        known = {**about(p, images), **_conditions(p.case, measurements)}
        record_conditions(known)
        attempts = tried(
            p, p.dimes, measurements, lambda answer: checked_last_interval(answer, measurements), streams.case
        )

        def judge(algorithm: str) -> Judged:
            attempt = attempts[algorithm]
            poses = descent_poses(p.case, measurements, _velocity(attempt.answer))
            pairs = agreements(images, matches, poses)
            row = answer_row(attempt.answer, p.case, measurements)
            if algorithm != p.algorithm:
                row["apart_m_s"] = distance(_velocity(attempt.answer), _velocity(attempts[p.algorithm].answer))
            row |= {**agreement_row(pairs), **attempt.row}
            if attempt.answer is not None:
                truth = None if p.case.truth.velocity_m_s is None else _true(p.case)
                case = ScoredVelocity(measurements=measurements, answer=attempt.answer, true_velocity_m_s=truth)
                row |= scored(p.scores, case, {*row, *known})
            kept = velocity_products([image.counts for image in images], attempt.answer, _true(p.case))
            products = {**kept, **agreement_products(images, pairs)}
            return judged_attempt(attempt, _velocity(attempt.answer) is not None, row, products)

        return case_result(p.algorithms, judge, known)


def descent_poses(
    case: StoredCase, measurements: DescentMeasurements, answered: Float64[np.ndarray, "2"] | None
) -> list[RigidTransform]:
    """The body's poses: by measured positions; where there are none by the inertial unit's velocities.

    Those carry an unknown constant error, which an answer tells: with it, the second interval's horizontal velocity is
    the answer's, and the first one's follows by the inertial change. Pictures then are held against the answer too.
    """
    velocities = measurements.interval_velocities_m_s.copy()
    if answered is not None:
        velocities[:, :2] += answered - velocities[1, :2]
    times = np.array([image.time_s for image in measurements.images])
    steps = velocities * np.diff(times)[:, None]
    places = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    measured = [picture.position_m for picture in case.pictures]
    if all(place is not None for place in measured):
        places = np.array(measured, dtype=np.float64)
    return [rigid(one.world_from_body, place) for one, place in zip(measurements.attitudes, places, strict=True)]


def answer_row(
    estimate: VelocityEstimate | None, case: StoredCase, measurements: DescentMeasurements
) -> dict[str, Scalar]:
    """An answer beside what the inertial unit has, and against the truth where it is known.

    `beside_inertial_m_s` holds the unknown error of the inertial velocity itself. `pair_discrepancy_m_s` does not: it
    is the change of velocity from the first pair of pictures to the second against the inertial unit's, which DIMES
    alone tells of.
    """
    velocity = _velocity(estimate)
    details = None if estimate is None else estimate.details
    chosen = details.chosen if isinstance(details, DimesDetails) else None
    given = np.full(2, np.nan) if velocity is None else velocity
    row: dict[str, Scalar] = {
        "velocity_estimated_x_m_s": float(given[0]),
        "velocity_estimated_y_m_s": float(given[1]),
        "beside_inertial_m_s": distance(velocity, measurements.interval_velocities_m_s[1, :2]),
        "pair_discrepancy_m_s": NAN if chosen is None else chosen.discrepancy_m_s,
    }
    if case.truth.velocity_m_s is None:
        return row
    true = _true(case)
    return {**row, **velocity_row("velocity", velocity, true), **consistency_row(estimate, true)}


def _velocity(estimate: VelocityEstimate | None) -> Float64[np.ndarray, "2"] | None:
    return None if estimate is None else estimate.velocity_m_s


def _true(case: StoredCase) -> Float64[np.ndarray, "2"]:
    """NaN where it is not known."""
    return np.array(case.truth.velocity_m_s or (np.nan, np.nan), dtype=np.float64)


def _conditions(case: StoredCase, measurements: DescentMeasurements) -> dict[str, Scalar]:
    """What the descent was like, as measured."""
    row: dict[str, Scalar] = {
        f"altitude_{number}_m": one.altitude_m for number, one in enumerate(measurements.altitudes, start=1)
    }
    axes = [
        image.camera.moved(RigidTransform.from_rotation(attitude.world_from_body)).boresight()
        for image, attitude in zip(measurements.images, measurements.attitudes, strict=True)
    ]
    off_nadir = [float(np.degrees(np.arccos(np.clip(-axis[2], -1.0, 1.0)))) for axis in axes]
    sun = measurements.sun_direction
    return {
        **row,
        "off_nadir_max_deg": max(off_nadir),
        "sun_elevation_deg": float(np.degrees(np.arcsin(np.clip(sun[2], -1.0, 1.0)))),
        "truth_known": case.truth.velocity_m_s is not None,
    }
