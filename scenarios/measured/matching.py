"""Comparison of recorded images with their measured poses, without an algorithm."""

from __future__ import annotations

from pydantic import BaseModel

from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.measured import store
from marsyard.scenarios.measured.base import MeasuredParameters, MeasuredScenario, case_row
from marsyard.scenarios.measured.consistency import agreement_products, agreement_row, compare_with_poses, match_images
from marsyard.sim.streams import Streams

#: Outcomes of `MatchingScenario`, which runs no algorithm.
MATCHED, TOO_FEW = "MATCHED", "TOO_FEW_MATCHES"


class MatchingParameters(MeasuredParameters):
    """Parameters of the comparison of images with their poses."""

    task_name = "matching"


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
            row={**case_row(p, images), **agreement_row(pairs)},
            products=agreement_products(images, pairs),
        )
