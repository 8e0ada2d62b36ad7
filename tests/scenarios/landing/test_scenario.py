"""What a campaign of landings builds before its flights."""

from __future__ import annotations

import pytest

from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.pictures import KEPT_GROUNDS
from marsyard.scenarios.landing.scenario import LandingScenario


@pytest.mark.parametrize(("bank", "built"), [(1, 1), (KEPT_GROUNDS, KEPT_GROUNDS), (KEPT_GROUNDS + 1, 0), (10_000, 0)])
def test_terrains_of_a_bank_too_large_to_keep_are_built_by_their_flights(bank: int, built: int) -> None:
    parameters = LandingScenarioParameters.model_validate({"location": {"bank": bank}})
    assert LandingScenario().shared_inputs(parameters) == tuple(range(built))
