"""Recorded images without an algorithm: their agreement with the measured poses, and the columns of every case.

The scenarios with an algorithm add the same columns to their rows.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel

from marsyard.scenarios.condition_columns import hash_images
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.measured import store
from marsyard.scenarios.measured.pose_agreement import (
    agreement_products,
    agreement_row,
    compare_with_poses,
    match_images,
)
from marsyard.scenarios.measured.store import RECORDED_CASE, MeasuredParameters
from marsyard.scenarios.typed_scenario import TypedScenario
from marsyard.sim.camera import camera_pose
from marsyard.sim.measurements import DetectorImage
from marsyard.sim.streams import Streams

#: Outcomes of `MatchingScenario`, which runs no algorithm.
MATCHED, TOO_FEW = "MATCHED", "TOO_FEW_MATCHES"


def case_row(p: MeasuredParameters, images: Sequence[DetectorImage]) -> dict[str, Scalar]:
    """Return the columns of the case: name, images, and the maximum motion of the camera between two images."""
    poses = [item.pose * camera_pose(image.camera) for item, image in zip(p.case.images, images, strict=True)]
    steps = [earlier.inv() * later for earlier, later in itertools.pairwise(poses)]
    has_positions = all(image.position_m is not None for image in p.case.images)
    return {
        "measured_case": p.case.name,
        "images": len(images),
        "duration_s": images[-1].time_s - images[0].time_s,
        "max_rotation_deg": max(float(np.degrees(step.rotation.magnitude())) for step in steps),
        "max_translation_m": max(float(np.linalg.norm(step.translation)) for step in steps)
        if has_positions
        else np.nan,
        "image_hash": hash_images(image.counts for image in images),
    }


def distance(first: Float[np.ndarray, "n"] | None, second: Float[np.ndarray, "n"] | None) -> float:
    """Return the distance between two answers; NaN if one is missing."""
    return np.nan if first is None or second is None else float(np.linalg.norm(first - second))


class MatchingParameters(MeasuredParameters):
    """Parameters of the comparison of images with their poses."""

    task_name = "matching"


class MatchingScenario(TypedScenario[MatchingParameters]):
    """Comparison of two or more images with their measured poses, without an algorithm."""

    name = "measured-matching"
    parameters_type = MatchingParameters
    recorded_case = RECORDED_CASE

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Run one case."""
        p = self.check_parameters(parameters)
        images = store.load_images(p.cases, p.case)
        pairs = compare_with_poses(images, match_images(images), [image.pose for image in p.case.images])
        has_matches = all(pair.residuals_px.size for pair in pairs)
        return CaseResult(
            outcome=MATCHED if has_matches else TOO_FEW,
            answered=has_matches,
            row={**case_row(p, images), **agreement_row(pairs)},
            products=agreement_products(images, pairs),
        )
