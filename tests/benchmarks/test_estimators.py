"""Tests of the descents on which the benchmarks compare estimators."""

from benchmarks.estimators import simulate_descents
from marsyard.campaigns.definition.loading import load_campaign


def test_simulated_descents_are_those_of_the_campaign() -> None:
    campaign = load_campaign("dimes-smoke")
    (descent,) = simulate_descents("dimes-smoke", 1)
    row = campaign.scenario.run(campaign.parameters(0), campaign.streams(0)).row
    assert descent.velocity_m_s.tolist() == [row["velocity_true_x_m_s"], row["velocity_true_y_m_s"]]
    assert descent.has_feasible_overlap == row["feasible_overlap"]
    assert len(descent.measurements.images) == 3
