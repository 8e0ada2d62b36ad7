"""Tests of the measurements of a simulated landing."""

from typing import Any

import pytest

from marsyard.scenarios.landing import flight
from marsyard.scenarios.landing.pair_choice import choose_pair
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.simulation import RenderedFlight, measure
from marsyard.sim.streams import Streams


def test_algorithm_receives_the_laser_reading_with_which_the_pair_was_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two readings of one instant would differ by their noise, 1 m."""
    choices: list[float] = []

    def record_choice(poses: Any, ranges_m: Any, *others: Any) -> Any:
        choice = choose_pair(poses, ranges_m, *others)
        choices.append(float(ranges_m[choice.first]))
        return choice

    monkeypatch.setattr(flight, "choose_pair", record_choice)
    p = LandingScenarioParameters.model_validate(
        {
            "site": "heli-benign",
            "terrain": {"samples": 256, "rocks": None},
            "helicopter": {"transit": {"hover_s": 8.0}},
            "laser": {"noise_m": 1.0, "boresight_deg": 0.0},
        }
    )
    streams = Streams(1, "laser", 0)
    case = RenderedFlight.simulate(p, streams)
    # the range in the images is the median of pixels whose centres are up to 0.7 px from the axis
    assert measure(p, case.flight, case.pair, streams).slant_range_m == pytest.approx(choices[0], abs=0.05)
