"""Real pictures held against their measured poses, with no algorithm under test."""

from __future__ import annotations

from pydantic import BaseModel

from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.measured.case import MeasuredScenario, about, pose
from marsyard.scenarios.measured.consistency import agreement_products, agreement_row, agreements, matched
from marsyard.scenarios.measured.parameters import MatchingParameters
from marsyard.scenarios.measured.store import images_of
from marsyard.sim.streams import Streams

#: Outcomes.
MATCHED, TOO_FEW = "MATCHED", "TOO_FEW_MATCHES"


class MatchingScenario(MeasuredScenario[MatchingParameters]):
    """Two or more real pictures, held against their measured poses."""

    name = "measured-matching"
    parameters_type = MatchingParameters

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """One case."""
        p = self.checked(parameters)
        images = images_of(p.cases, p.case)
        pairs = agreements(images, matched(images), [pose(picture) for picture in p.case.pictures])
        told = all(pair.residuals_px.size for pair in pairs)
        return CaseResult(
            outcome=MATCHED if told else TOO_FEW,
            answered=told,
            row={**about(p, images), **agreement_row(pairs)},
            products=agreement_products(images, pairs),
        )
