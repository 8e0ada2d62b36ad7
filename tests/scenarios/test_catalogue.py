"""Tests of the requirements of the catalogue: each can fail, judges what it states, and uses reported columns."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from marsyard.campaigns.definition.campaign_file import Requirement
from marsyard.campaigns.definition.loading import find_campaign, load_campaign
from marsyard.campaigns.definition.requirements import select_applicable, shipped_requirements
from marsyard.scenarios.systems import catalogue

#: Columns that are true only for an answer, or that contain a number only for one.
AVAILABILITY = {
    "answered", "tracked", "handed_off", "site_reported", "answer_correct", "fixed_in_time", "coarse_error_m",
    "relief_error_fraction", "tracked_well",
}  # fmt: skip
#: Columns that depend on the answer of an algorithm, and therefore also on its refusals.
ANSWER_FLAGS = {"valid", "site_reported", "descent_target_exists", "fixed_in_time", "position_reported", "answered"}


def has_all_answers(requirement: Requirement) -> bool:
    """Whether the population contains the cases without an answer."""
    return not set(requirement.population.split(" and ")) & ANSWER_FLAGS


@pytest.mark.parametrize(("name", "path"), catalogue().items(), ids=list(catalogue()))
def test_shipped_campaign_has_sources_and_the_applicable_requirements(name: str, path: Path) -> None:
    """The requirements' lists of campaigns agree with the campaigns' lists of requirements."""
    assert find_campaign(name) == path
    definition, shipped = load_campaign(name).definition, shipped_requirements()
    assert definition.name == name
    assert [key for key, dispersion in definition.dispersions.items() if not dispersion.source] == []
    requirements = [entry for entry in definition.requirements if entry.id in shipped]
    assert {entry.id for entry in requirements} == {
        entry["id"] for entry in select_applicable(list(shipped.values()), name)
    }
    for requirement in requirements:
        entry = shipped[requirement.id]
        assert (requirement.metric, requirement.bound, requirement.kind) == (entry.metric, entry.bound, entry.kind)
    # without such a requirement an algorithm that refuses every answer fails none
    assert any(entry.metric in AVAILABILITY and has_all_answers(entry) for entry in definition.requirements)
    # no verdict depends on the run time of the host
    for requirement in definition.requirements:
        columns = f"{requirement.metric} {requirement.population}".split()
        assert not [column for column in columns if re.search(r"_time(_max|_median)?_s$|measured", column)]


def test_disparity_errors_of_table_1_are_normal_with_a_three_sigma_error_of_1_px() -> None:
    campaign = load_campaign("vtt-accuracy")
    assert campaign.parameters(0).model_dump()["stereo"]["disparity_error_px"] == 0.0
    errors_px = np.array([campaign.draws(case)["stereo.disparity_offset_px"] for case in range(1000)])
    # tolerances: four standard errors of the rms, and of the fraction beyond 2 sigma, which is 4.55 %
    assert np.sqrt(np.mean(errors_px**2)) == pytest.approx(1.0 / 3.0, abs=4.0 / 3.0 / np.sqrt(2000.0))
    assert np.mean(np.abs(errors_px) > 2.0 / 3.0) == pytest.approx(0.0455, abs=0.027)


def test_bounds_of_table_1_are_the_three_sigma_errors_of_the_paper() -> None:
    """The last column of Table I for a drift of 2.5 px, in cm; 3 sigma of a normal distribution are 99.73 %."""
    requirements = {entry.id: entry for entry in load_campaign("vtt-accuracy").definition.requirements}
    for name, stereo_cm, drift_cm_px in (("VTT-NAVCAM", 1.6, 0.16), ("VTT-PANCAM", 0.4, 0.06)):
        error_cm = math.hypot(stereo_cm, 2.5 * drift_cm_px)
        assert requirements[name].bound == pytest.approx(0.01 * error_cm, rel=0.01)
        assert requirements[name].probability == pytest.approx(math.erf(3.0 / math.sqrt(2.0)), abs=1e-4)


def test_statements_on_positions_name_the_errors_that_are_not_included() -> None:
    """The registration error of the map has a default of 50 m per axis, more than the limit of 40 m."""
    positions = {name: entry for name, entry in shipped_requirements().items() if name[:4] == "LOC-" and entry.bound}
    assert len(positions) == 4
    for entry in positions.values():
        assert "errors of the map's registration are not included" in entry.statement
