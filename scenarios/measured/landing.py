"""Two real pictures of the ground: site, motion beside the measured poses, and against the true ones where known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.answers import checked_site
from marsyard.algorithms.hda import HdaDetails, hda_products
from marsyard.algorithms.hda.view import camera_pose
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome
from marsyard.scenarios.base import judged_attempt
from marsyard.scenarios.estimators import LANDING
from marsyard.scenarios.interface import CaseResult, Scalar, record_conditions
from marsyard.scenarios.landing.motion import motion_errors, solved_row
from marsyard.scenarios.measured.case import NAN, MeasuredScenario, about, distance, pose, tried
from marsyard.scenarios.measured.consistency import agreement_products, agreement_row, agreements, matched
from marsyard.scenarios.measured.parameters import MeasuredLandingParameters
from marsyard.scenarios.measured.store import StoredCase, images_of, landing_measurements, pose_of
from marsyard.scenarios.parts.named import SCORE, Kind
from marsyard.scenarios.parts.scores import ScoredSite, scored
from marsyard.scenarios.trial import Judged, case_result
from marsyard.sim.measurements import LandingMeasurements
from marsyard.sim.streams import Streams


class MeasuredLandingScenario(MeasuredScenario[MeasuredLandingParameters]):
    """Two real pictures of the ground with measured poses, given to an estimator of landing sites."""

    name = "measured-landing"
    parameters_type = MeasuredLandingParameters
    task = LANDING
    algorithm_table = ()
    part_keys: Mapping[str, Kind] = {"scores": SCORE}

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """One flight."""
        p = self.checked(parameters)
        images = images_of(p.cases, p.case)
        measurements = landing_measurements(p.case, images)
        pairs = agreements(images, matched(images), [pose(picture) for picture in p.case.pictures])
        shown = agreement_products(images, pairs)
        known = {**about(p, images), **_conditions(p.case), **agreement_row(pairs)}
        record_conditions(known)
        attempts = tried(p, p.hda, measurements, checked_site, streams.case)

        def judge(algorithm: str) -> Judged:
            attempt = attempts[algorithm]
            details = None if attempt.answer is None else attempt.answer.details
            row = answer_row(attempt.answer, p.case, measurements)
            if algorithm != p.algorithm:
                row["apart_m"] = distance(_site(attempt.answer), _site(attempts[p.algorithm].answer))
            row |= attempt.row
            if attempt.answer is not None:
                case = ScoredSite(measurements=measurements, answer=attempt.answer, true_poses=_true_poses(p.case))
                row |= scored(p.scores, case, {*row, *known})
            products = {**(hda_products(details) if isinstance(details, HdaDetails) else {}), **shown}
            converged = attempt.answer is not None and attempt.answer.outcome.converged
            return judged_attempt(attempt, converged, row, products)

        return case_result(p.algorithms, judge, known)


def answer_row(estimate: SiteEstimate | None, case: StoredCase, measurements: LandingMeasurements) -> dict[str, Scalar]:
    """A site, and the motion behind it beside that of the measured poses, and against the true one where it is known.

    Whether a site is safe needs the true ground, which no folder of pictures holds.
    """
    site = _site(estimate)
    place = np.full(3, np.nan) if site is None else site
    outcome = SiteOutcome.NO_STRUCTURE if estimate is None else estimate.outcome
    row: dict[str, Scalar] = {
        "converged": outcome.converged,
        "site_reported": outcome is SiteOutcome.SAFE_SITE,
        **{f"site_{name}_m": float(value) for name, value in zip(("east", "north", "up"), place, strict=True)},
    }
    details = None if estimate is None else estimate.details
    if not isinstance(details, HdaDetails):
        return row
    row |= solved_row(details)
    if details.motion is None:
        return row
    found = details.motion.second_from_first
    measured = _camera_motion([one.world_from_body for one in measurements.poses], measurements)
    beside = motion_errors(found, measured)
    row |= {name.replace("_error_", "_beside_poses_"): value for name, value in beside.items()}
    true_poses = _true_poses(case)
    if true_poses is not None:
        row |= motion_errors(found, _camera_motion(true_poses, measurements))
    return row


def _true_poses(case: StoredCase) -> tuple[RigidTransform, RigidTransform] | None:
    """Of the body at the two pictures; None where they are not known."""
    if case.truth.poses is None:
        return None
    first, second = (pose_of(*one) for one in case.truth.poses)
    return first, second


def _camera_motion(poses: Sequence[RigidTransform], measurements: LandingMeasurements) -> RigidTransform:
    """From the first to the second camera's frame."""
    first, second = (body * camera_pose(image.camera) for body, image in zip(poses, measurements.images, strict=True))
    return second.inv() * first


def _site(estimate: SiteEstimate | None) -> Float[np.ndarray, "3"] | None:
    """The site that was found; None where the algorithm did not converge, or found none."""
    found = estimate is not None and estimate.outcome is SiteOutcome.SAFE_SITE
    return estimate.site_world if found and estimate is not None else None


def _conditions(case: StoredCase) -> dict[str, Scalar]:
    return {
        "slant_range_m": NAN if case.slant_range_m is None else case.slant_range_m,
        "truth_known": case.truth.poses is not None,
    }
