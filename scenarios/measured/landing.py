"""Estimation of landing sites from recorded images of the ground."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, Field
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.answers import check_site
from marsyard.algorithms.hda import HdaDetails, HdaOptions, hda_products
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome
from marsyard.scenarios.algorithm_run import AlgorithmRun, run_on_measurements
from marsyard.scenarios.algorithm_selection import AlgorithmSelection
from marsyard.scenarios.case_evaluation import Runs, Score, evaluate_case
from marsyard.scenarios.hda_stage_columns import motion_errors, stage_row
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.landing_task import LANDING
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
from marsyard.scenarios.parts.scores import CustomScores, ScoredSite
from marsyard.scenarios.typed_scenario import TypedScenario
from marsyard.sim.camera import camera_pose
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DetectorImage, LandingMeasurements, PoseMeasurement
from marsyard.sim.streams import Streams


class MeasuredLandingParameters(AlgorithmSelection, CustomScores, MeasuredParameters):
    """Parameters of landing site estimation from two images of the ground."""

    task_name = "landing"
    task = LANDING
    scored = ScoredSite

    algorithm: Annotated[str, Field(description="the estimator of landing sites under test")] = "hda"
    hda: Annotated[HdaOptions, Field(description="options of the hazard detection and avoidance")] = HdaOptions()


class MeasuredLandingScenario(TypedScenario[MeasuredLandingParameters]):
    """Estimation of a landing site from two recorded images of the ground and their measured poses."""

    name = "measured-landing"
    parameters_type = MeasuredLandingParameters
    recorded_case = RECORDED_CASE
    task = LANDING
    algorithm_table = ()
    part_keys: Mapping[str, PartKind] = {"scores": SCORE}

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Run one flight."""
        p = self.check_parameters(parameters)
        images = store.load_images(p.cases, p.case)
        measurements = _landing_measurements(p.case, images)
        pairs = compare_with_poses(images, match_images(images), [image.pose for image in p.case.images])
        true_poses = None
        if p.case.truth.poses is not None:
            first, second = (_body_pose(*pose) for pose in p.case.truth.poses)
            true_poses = first, second
        conditions: dict[str, Scalar] = {
            **case_row(p, images),
            "slant_range_m": measurements.slant_range_m,
            "truth_known": true_poses is not None,
            **agreement_row(pairs),
        }

        def run(algorithm: str) -> AlgorithmRun[SiteEstimate]:
            check = partial(check_site, apriori_m=measurements.apriori_site_world)
            return run_on_measurements(partial(p.make, algorithm, streams.case), check, measurements)

        def score(algorithm: str, runs: Runs[SiteEstimate]) -> Score:
            answer = runs[algorithm].answer
            details = None if answer is None else answer.details
            row = _site_answer_row(answer, measurements, true_poses)
            if algorithm != p.algorithm:
                row["difference_m"] = distance(_get_site(answer), _get_site(runs[p.algorithm].answer))
            scored = None
            if answer is not None:
                scored = ScoredSite(measurements=measurements, answer=answer, true_poses=true_poses)
            products = hda_products(details) if isinstance(details, HdaDetails) else {}
            is_converged = answer is not None and answer.outcome.converged
            return Score(is_converged, row, {**products, **agreement_products(images, pairs)}, scored)

        return evaluate_case(p, conditions, run, score)


def _body_pose(position_m: store.Vector, xyzw: store.Quaternion) -> RigidTransform:
    """Return the pose of a body in the world."""
    return rigid(Rotation.from_quat(np.array(xyzw)), np.array(position_m))


def _landing_measurements(case: store.StoredCase, images: tuple[DetectorImage, ...]) -> LandingMeasurements:
    """Return the inputs of an estimator of landing sites."""
    first, second = (PoseMeasurement(image.pose, image.time_s) for image in case.images)
    return LandingMeasurements(
        images=(images[0], images[1]),
        poses=(first, second),
        slant_range_m=math.nan if case.slant_range_m is None else case.slant_range_m,
        up_body=case.images[0].attitude.inv().apply(np.array([0.0, 0.0, 1.0])),
        apriori_site_world=np.array(case.site_m, dtype=np.float64),
    )


def _get_site(estimate: SiteEstimate | None) -> Float[np.ndarray, "3"] | None:
    """Return the site; None if the algorithm reports no safe site."""
    return None if estimate is None or estimate.outcome is not SiteOutcome.SAFE_SITE else estimate.site_world


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
