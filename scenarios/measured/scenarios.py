"""Scenarios of recorded images: run velocity or landing site estimators, or compare the images with measured poses."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np
from jaxtyping import Float, Float64
from pydantic import BaseModel, Field, model_validator
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.answers import check_site
from marsyard.algorithms.dimes import DimesDetails, DimesOptions
from marsyard.algorithms.hda import HdaDetails, HdaOptions, hda_products
from marsyard.algorithms.hda.motion import camera_pose
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome, VelocityEstimate
from marsyard.scenarios.algorithm_run import AlgorithmRun, AlgorithmSelection, case_result, run_on_measurements
from marsyard.scenarios.base import BaseScenario, algorithm_result
from marsyard.scenarios.conditions import hash_images
from marsyard.scenarios.descent.parameters import check_binning
from marsyard.scenarios.estimators import LANDING, VELOCITY
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.landing.score import motion_errors, stage_row
from marsyard.scenarios.measured import store
from marsyard.scenarios.measured.consistency import agreement_products, agreement_row, compare_with_poses, match_images
from marsyard.scenarios.measured.layout import TaskName
from marsyard.scenarios.parts.named import SCORE, PartKind
from marsyard.scenarios.parts.scores import CustomScores, ScoredSite, ScoredVelocity, compute_scores
from marsyard.scenarios.velocity import check_last_interval, consistency_row, velocity_products, velocity_row
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DescentMeasurements, DetectorImage, LandingMeasurements
from marsyard.sim.parameters import Parameters
from marsyard.sim.streams import Streams

Answer = TypeVar("Answer")
ParametersType = TypeVar("ParametersType", bound=BaseModel)

NAN = float("nan")
#: Outcomes of `MatchingScenario`, which runs no algorithm.
MATCHED, TOO_FEW = "MATCHED", "TOO_FEW_MATCHES"


class MeasuredParameters(Parameters):
    """Parameters of all tasks; subclasses define `task_name`, the required task of `cases.json`."""

    task_name: ClassVar[TaskName]

    cases: Annotated[store.CasesFile, Field(description="`cases.json` of `marsyard ingest`")]
    number: Annotated[int, Field(ge=0, description="index of the case in the file; usually a grid over all cases")] = 0

    @model_validator(mode="after")
    def _check_case_and_task(self) -> MeasuredParameters:
        stored = self.cases.stored
        if self.number >= len(stored.cases):
            raise ValueError(f"number is {self.number}; {self.cases.file} contains 0 to {len(stored.cases) - 1}")
        if stored.task != self.task_name:
            raise ValueError(
                f"{self.cases.file}: its task is {stored.task}; the scenario measured-{stored.task} runs it"
            )
        return self

    @property
    def case(self) -> store.StoredCase:
        """The case with this number."""
        return self.cases.stored.cases[self.number]


class MatchingParameters(MeasuredParameters):
    """Parameters of the comparison of images with their poses."""

    task_name = "matching"


class MeasuredVelocityParameters(AlgorithmSelection, CustomScores, MeasuredParameters):
    """Parameters of velocity estimation from three images of a descent."""

    task_name = "velocity"
    task = VELOCITY
    scored = ScoredVelocity

    algorithm: str = Field(default="dimes", description="the velocity estimator under test")
    dimes: Annotated[DimesOptions, Field(description="options of DIMES")] = DimesOptions()

    @model_validator(mode="after")
    def _check_binning(self) -> MeasuredVelocityParameters:
        if any(name.startswith("dimes") for name in self.algorithms):
            for image in self.case.images:
                check_binning(self.dimes.binned_size, image.size)
        return self


class MeasuredLandingParameters(AlgorithmSelection, CustomScores, MeasuredParameters):
    """Parameters of landing site estimation from two images of the ground."""

    task_name = "landing"
    task = LANDING
    scored = ScoredSite

    algorithm: Annotated[str, Field(description="the estimator of landing sites under test")] = "hda"
    hda: Annotated[HdaOptions, Field(description="options of the hazard detection and avoidance")] = HdaOptions()


class MeasuredScenario(BaseScenario[ParametersType]):
    """A scenario whose cases are stored files, so there are no inputs to prepare before the cases."""

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Return an empty tuple: no inputs are shared by cases."""
        return ()

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Do nothing: there is no input to prepare."""


class MatchingScenario(MeasuredScenario[MatchingParameters]):
    """Comparison of two or more images with their measured poses, without an algorithm."""

    name = "measured-matching"
    parameters_type = MatchingParameters

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Run one case."""
        p = self.check_parameters(parameters)
        images = store.load_images(p.cases, p.case)
        pairs = compare_with_poses(images, match_images(images), [image.pose for image in p.case.images])
        has_matches = all(pair.residuals_px.size for pair in pairs)
        return CaseResult(
            outcome=MATCHED if has_matches else TOO_FEW,
            answered=has_matches,
            row={**_case_row(p, images), **agreement_row(pairs)},
            products=agreement_products(images, pairs),
        )


class MeasuredVelocityScenario(MeasuredScenario[MeasuredVelocityParameters]):
    """Velocity estimation from three recorded images of a descent and their measurements."""

    name = "measured-velocity"
    parameters_type = MeasuredVelocityParameters
    task = VELOCITY
    algorithm_table = ()
    part_keys: Mapping[str, PartKind] = {"scores": SCORE}

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Run one descent."""
        p = self.check_parameters(parameters)
        images = store.load_images(p.cases, p.case)
        measurements = store.descent_measurements(p.case, images)
        matches = match_images(images)
        axes = [
            image.camera.transform(RigidTransform.from_rotation(attitude.world_from_body)).boresight()
            for image, attitude in zip(images, measurements.attitudes, strict=True)
        ]
        conditions: dict[str, Scalar] = {
            **_case_row(p, images),
            **{f"altitude_{number}_m": item.altitude_m for number, item in enumerate(measurements.altitudes, start=1)},
            "off_nadir_max_deg": max(float(np.degrees(np.arccos(np.clip(-axis[2], -1.0, 1.0)))) for axis in axes),
            "sun_elevation_deg": float(np.degrees(np.arcsin(np.clip(measurements.sun_direction[2], -1.0, 1.0)))),
            "truth_known": p.case.truth.velocity_m_s is not None,
        }
        runs = _run_algorithms(
            p, p.dimes, measurements, lambda answer: check_last_interval(answer, measurements), streams.case
        )
        true_velocity = p.case.truth.velocity_m_s
        truth = np.array(true_velocity or (np.nan, np.nan), dtype=np.float64)

        def evaluate(algorithm: str) -> CaseResult:
            run = runs[algorithm]
            velocity = _get_velocity(run.answer)
            pairs = compare_with_poses(images, matches, _descent_poses(p.case, measurements, velocity))
            details = None if run.answer is None else run.answer.details
            velocity_pair = details.selected if isinstance(details, DimesDetails) else None
            estimate_m_s = np.full(2, np.nan) if velocity is None else velocity
            row: dict[str, Scalar] = {
                "velocity_estimated_x_m_s": float(estimate_m_s[0]),
                "velocity_estimated_y_m_s": float(estimate_m_s[1]),
                # estimated minus inertial velocity, which has an unknown constant error
                "inertial_difference_m_s": _distance(velocity, measurements.interval_velocities_m_s[1, :2]),
                # estimated minus inertial velocity change between the intervals, in which this error cancels
                "pair_discrepancy_m_s": NAN if velocity_pair is None else velocity_pair.discrepancy_m_s,
            }
            if true_velocity is not None:
                row |= {**velocity_row("velocity", velocity, truth), **consistency_row(run.answer, truth)}
            if algorithm != p.algorithm:
                row["difference_m_s"] = _distance(velocity, _get_velocity(runs[p.algorithm].answer))
            row |= {**agreement_row(pairs), **run.row}
            if run.answer is not None:
                case = ScoredVelocity(
                    measurements=measurements,
                    answer=run.answer,
                    true_velocity_m_s=None if true_velocity is None else truth,
                )
                row |= compute_scores(p.scores, case, {*row, *conditions})
            products = velocity_products([image.counts for image in images], run.answer, truth)
            return algorithm_result(run, velocity is not None, row, {**products, **agreement_products(images, pairs)})

        return case_result(p.algorithms, evaluate, conditions)


class MeasuredLandingScenario(MeasuredScenario[MeasuredLandingParameters]):
    """Estimation of a landing site from two recorded images of the ground and their measured poses."""

    name = "measured-landing"
    parameters_type = MeasuredLandingParameters
    task = LANDING
    algorithm_table = ()
    part_keys: Mapping[str, PartKind] = {"scores": SCORE}

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Run one flight."""
        p = self.check_parameters(parameters)
        images = store.load_images(p.cases, p.case)
        measurements = store.landing_measurements(p.case, images)
        pairs = compare_with_poses(images, match_images(images), [image.pose for image in p.case.images])
        true_poses = None
        if p.case.truth.poses is not None:
            first, second = (store.body_pose(*pose) for pose in p.case.truth.poses)
            true_poses = first, second
        conditions: dict[str, Scalar] = {
            **_case_row(p, images),
            "slant_range_m": measurements.slant_range_m,
            "truth_known": true_poses is not None,
            **agreement_row(pairs),
        }
        runs = _run_algorithms(p, p.hda, measurements, check_site, streams.case)

        def evaluate(algorithm: str) -> CaseResult:
            run = runs[algorithm]
            details = None if run.answer is None else run.answer.details
            row = _site_answer_row(run.answer, measurements, true_poses)
            if algorithm != p.algorithm:
                row["difference_m"] = _distance(_get_site(run.answer), _get_site(runs[p.algorithm].answer))
            row |= run.row
            if run.answer is not None:
                case = ScoredSite(measurements=measurements, answer=run.answer, true_poses=true_poses)
                row |= compute_scores(p.scores, case, {*row, *conditions})
            products = hda_products(details) if isinstance(details, HdaDetails) else {}
            is_converged = run.answer is not None and run.answer.outcome.converged
            return algorithm_result(run, is_converged, row, {**products, **agreement_products(images, pairs)})

        return case_result(p.algorithms, evaluate, conditions)


def _run_algorithms(
    p: AlgorithmSelection, options: Any, measurements: Any, check: Callable[[object], Answer], case: int
) -> Mapping[str, AlgorithmRun[Answer]]:
    """Run all algorithms on the measurements."""
    return {
        spec: run_on_measurements(partial(p.task.make, spec, options, p.executable, case), check, measurements)
        for spec in p.algorithms
    }


def _case_row(p: MeasuredParameters, images: Sequence[DetectorImage]) -> dict[str, Scalar]:
    """Return the columns of the case: name, images, and the maximum motion of the camera between two images."""
    poses = [item.pose * camera_pose(image.camera) for item, image in zip(p.case.images, images, strict=True)]
    steps = [earlier.inv() * later for earlier, later in itertools.pairwise(poses)]
    has_positions = all(image.position_m is not None for image in p.case.images)
    return {
        "measured_case": p.case.name,
        "images": len(images),
        "duration_s": images[-1].time_s - images[0].time_s,
        "max_rotation_deg": max(float(np.degrees(step.rotation.magnitude())) for step in steps),
        "max_translation_m": max(float(np.linalg.norm(step.translation)) for step in steps) if has_positions else NAN,
        "image_hash": hash_images(image.counts for image in images),
    }


def _distance(first: Float[np.ndarray, "n"] | None, second: Float[np.ndarray, "n"] | None) -> float:
    """Return the distance between two answers; NaN if one is missing."""
    return NAN if first is None or second is None else float(np.linalg.norm(first - second))


def _get_velocity(estimate: VelocityEstimate | None) -> Float64[np.ndarray, "2"] | None:
    return None if estimate is None else estimate.velocity_m_s


def _get_site(estimate: SiteEstimate | None) -> Float[np.ndarray, "3"] | None:
    """Return the site; None if the algorithm reports no safe site."""
    return None if estimate is None or estimate.outcome is not SiteOutcome.SAFE_SITE else estimate.site_world


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


def _site_answer_row(
    estimate: SiteEstimate | None,
    measurements: LandingMeasurements,
    true_poses: tuple[RigidTransform, RigidTransform] | None,
) -> dict[str, Scalar]:
    """Return the columns of an answer: site, and motion compared with the measured and the true poses.

    The safety of the site is not scored: it needs the true ground, which a folder of images does not contain.
    """
    site = _get_site(estimate)
    position = np.full(3, np.nan) if site is None else site
    # without an answer both outcome columns are false, as for NO_STRUCTURE
    outcome = SiteOutcome.NO_STRUCTURE if estimate is None else estimate.outcome
    row: dict[str, Scalar] = {
        "converged": outcome.converged,
        "site_reported": outcome is SiteOutcome.SAFE_SITE,
        **{f"site_{name}_m": float(value) for name, value in zip(("east", "north", "up"), position, strict=True)},
    }
    details = None if estimate is None else estimate.details
    if not isinstance(details, HdaDetails):
        return row
    row |= stage_row(details)
    if details.motion is None:
        return row

    def compare_motion(poses: Sequence[RigidTransform]) -> dict[str, Scalar]:
        """Compare the estimated motion from the first to the second camera's frame with poses of the body."""
        cameras = [body * camera_pose(image.camera) for body, image in zip(poses, measurements.images, strict=True)]
        return motion_errors(motion.second_from_first, cameras[1].inv() * cameras[0])

    motion = details.motion
    differences = compare_motion([pose.world_from_body for pose in measurements.poses])
    row |= {name.replace("_error_", "_pose_difference_"): value for name, value in differences.items()}
    return row if true_poses is None else {**row, **compare_motion(true_poses)}
