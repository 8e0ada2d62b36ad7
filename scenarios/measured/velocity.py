"""Velocity estimation from recorded images of a descent."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, Field, model_validator
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.dimes import DimesDetails, DimesOptions
from marsyard.algorithms.interface import VelocityEstimate
from marsyard.scenarios.algorithm_run import AlgorithmRun, run_on_measurements
from marsyard.scenarios.algorithm_selection import AlgorithmSelection
from marsyard.scenarios.case_evaluation import Runs, Score, evaluate_case
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.measured import store
from marsyard.scenarios.measured.matching import case_row, distance
from marsyard.scenarios.measured.pose_agreement import (
    agreement_products,
    agreement_row,
    compare_with_poses,
    match_images,
)
from marsyard.scenarios.measured.store import RECORDED_CASE, MeasuredParameters
from marsyard.scenarios.parts.named import SCORE, PartKind
from marsyard.scenarios.parts.scores import CustomScores, ScoredVelocity
from marsyard.scenarios.typed_scenario import TypedScenario
from marsyard.scenarios.velocity import VELOCITY, check_image_size, check_last_interval
from marsyard.scenarios.velocity_score import consistency_row, velocity_products, velocity_row
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import AltitudeMeasurement, AttitudeMeasurement, DescentMeasurements, DetectorImage
from marsyard.sim.streams import Streams


class MeasuredVelocityParameters(AlgorithmSelection, CustomScores, MeasuredParameters):
    """Parameters of velocity estimation from three images of a descent."""

    task_name = "velocity"
    task = VELOCITY
    scored = ScoredVelocity

    algorithm: str = Field(default="dimes", description="the velocity estimator under test")
    dimes: Annotated[DimesOptions, Field(description="options of DIMES")] = DimesOptions()

    @model_validator(mode="after")
    def _check_image_sizes(self) -> MeasuredVelocityParameters:
        for image in self.case.images:
            check_image_size(self, image.size)
        return self


class MeasuredVelocityScenario(TypedScenario[MeasuredVelocityParameters]):
    """Velocity estimation from three recorded images of a descent and their measurements."""

    name = "measured-velocity"
    parameters_type = MeasuredVelocityParameters
    recorded_case = RECORDED_CASE
    task = VELOCITY
    algorithm_table = ()
    part_keys: Mapping[str, PartKind] = {"scores": SCORE}

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Run one descent."""
        p = self.check_parameters(parameters)
        images = store.load_images(p.cases, p.case)
        measurements = _descent_measurements(p.case, images)
        matches = match_images(images)
        axes = [
            image.camera.transform(RigidTransform.from_rotation(attitude.world_from_body)).boresight()
            for image, attitude in zip(images, measurements.attitudes, strict=True)
        ]
        conditions: dict[str, Scalar] = {
            **case_row(p, images),
            **{f"altitude_{number}_m": item.altitude_m for number, item in enumerate(measurements.altitudes, start=1)},
            "off_nadir_max_deg": max(float(np.degrees(np.arccos(np.clip(-axis[2], -1.0, 1.0)))) for axis in axes),
            "sun_elevation_deg": float(np.degrees(np.arcsin(np.clip(measurements.sun_direction[2], -1.0, 1.0)))),
            "truth_known": p.case.truth.velocity_m_s is not None,
        }
        true_velocity = p.case.truth.velocity_m_s
        truth = np.array(true_velocity or (np.nan, np.nan), dtype=np.float64)
        _, inertial_m_s = measurements.interval_velocities_m_s[:, :2]  # of the second interval, as the estimate

        def run(algorithm: str) -> AlgorithmRun[VelocityEstimate]:
            check = partial(check_last_interval, measurements=measurements)
            return run_on_measurements(partial(p.make, algorithm, streams.case), check, measurements)

        def score(algorithm: str, runs: Runs[VelocityEstimate]) -> Score:
            answer = runs[algorithm].answer
            velocity = _get_velocity(answer)
            pairs = compare_with_poses(images, matches, _descent_poses(p.case, measurements, velocity))
            details = None if answer is None else answer.details
            velocity_pair = details.selected if isinstance(details, DimesDetails) else None
            estimate_m_s = np.full(2, np.nan) if velocity is None else velocity
            row: dict[str, Scalar] = {
                "velocity_estimated_x_m_s": float(estimate_m_s[0]),
                "velocity_estimated_y_m_s": float(estimate_m_s[1]),
                # estimated minus inertial velocity, which has an unknown constant error
                "inertial_difference_m_s": distance(velocity, inertial_m_s),
                # estimated minus inertial velocity change between the intervals, in which this error cancels
                "pair_discrepancy_m_s": np.nan if velocity_pair is None else velocity_pair.discrepancy_m_s,
                **agreement_row(pairs),
            }
            if true_velocity is not None:
                row |= {**velocity_row("velocity", velocity, truth), **consistency_row(answer, truth)}
            if algorithm != p.algorithm:
                row["difference_m_s"] = distance(velocity, _get_velocity(runs[p.algorithm].answer))
            scored = None
            if answer is not None:
                known_truth = None if true_velocity is None else truth
                scored = ScoredVelocity(measurements=measurements, answer=answer, true_velocity_m_s=known_truth)
            products = velocity_products([image.counts for image in images], answer, truth)
            return Score(velocity is not None, row, {**products, **agreement_products(images, pairs)}, scored)

        return evaluate_case(p, conditions, run, score)


def _descent_measurements(case: store.StoredCase, images: tuple[DetectorImage, ...]) -> DescentMeasurements:
    """Return the inputs of a velocity estimator."""
    attitudes, altitudes = [], []
    for item in case.images:
        attitudes.append(AttitudeMeasurement(item.attitude, item.time_s))
        time_s = item.time_s if item.altitude_time_s is None else item.altitude_time_s
        altitudes.append(AltitudeMeasurement(math.nan if item.altitude_m is None else item.altitude_m, time_s))
    return DescentMeasurements(
        images=images,
        attitudes=tuple(attitudes),
        altitudes=tuple(altitudes),
        interval_velocities_m_s=np.array(case.interval_velocities_m_s, dtype=np.float64),
        sun_direction=np.array(case.sun_direction, dtype=np.float64),
    )


def _get_velocity(estimate: VelocityEstimate | None) -> Float64[np.ndarray, "2"] | None:
    return None if estimate is None else estimate.velocity_m_s


def _descent_poses(
    case: store.StoredCase, measurements: DescentMeasurements, velocity_m_s: Float64[np.ndarray, "2"] | None
) -> list[RigidTransform]:
    """Return the body's poses from measured positions or, without these, from the inertial unit's velocities.

    The inertial velocities have an unknown constant error, which the estimate removes. The horizontal velocity of the
    second interval is the estimate; the velocity of the first interval is the estimate minus the inertial velocity
    change. The agreement of images and poses then depends on the estimate as well.
    """
    velocities = measurements.interval_velocities_m_s.copy()
    if velocity_m_s is not None:
        velocities[:, :2] += velocity_m_s - velocities[1, :2]
    times = np.array([image.time_s for image in measurements.images])
    positions = np.concatenate([np.zeros((1, 3)), np.cumsum(velocities * np.diff(times)[:, None], axis=0)])
    positions_m = [image.position_m for image in case.images]
    if None not in positions_m:
        positions = np.array(positions_m, dtype=np.float64)
    rotations = [attitude.world_from_body for attitude in measurements.attitudes]
    return [rigid(rotation, position) for rotation, position in zip(rotations, positions, strict=True)]
