"""Tests of the counting bound, of numbers `in-turn`, and of studies on the systems of Marsyard."""

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.definition.margins import compute_margin
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.sampling.study_points import NEW_STREAM, POINT_COLUMN, StudyPoint
from marsyard.campaigns.studies.budget import active_sources
from marsyard.campaigns.studies.counting import count_violations, find_units_needed
from marsyard.campaigns.studies.rare import continue_rare, start_rare
from marsyard.campaigns.studies.regression_campaigns import write_regression_campaigns
from marsyard.campaigns.studies.results import RareParameters, SearchParameters
from marsyard.campaigns.studies.runner import prepare_campaign
from marsyard.campaigns.studies.search import start_search
from marsyard.scenarios.systems import systems
from tests.campaigns.fake_campaign import REQUIREMENT, RecordingWatch, read_case_rows, write_campaign
from tests.inline_workers import inline_workers_fixture

_inline_workers = inline_workers_fixture()


def test_bound_without_violations_is_the_textbook_one() -> None:
    counting = count_violations(np.zeros(1000, dtype=bool), [None] * 1000, 0.025, 0.05)
    assert counting.upper == pytest.approx(1.0 - 0.05 ** (1.0 / 1000.0))
    assert counting.lower == 0.0
    assert (counting.lower_confidence, counting.upper_confidence) == (0.975, 0.95)


@pytest.mark.parametrize(("violations", "limit", "risk", "units"), [(0, 1e-4, 0.1, 23025), (0, 1e-4, 0.05, 29956)])
def test_units_needed_are_the_textbook_ones(violations: int, limit: float, risk: float, units: int) -> None:
    # ln(risk) / ln(1 - limit), rounded up
    assert units == math.ceil(math.log(risk) / math.log1p(-limit))
    assert find_units_needed(violations, limit, risk) == units


def test_bound_needs_no_more_than_the_units_needed() -> None:
    units = find_units_needed(2, 1e-2, 0.05)
    is_violation = np.zeros(units, dtype=bool)
    is_violation[:2] = True
    assert count_violations(is_violation, [None] * units, 0.05, 0.05).upper <= 1e-2
    assert count_violations(is_violation[:-1], [None] * (units - 1), 0.05, 0.05).upper > 1e-2


def test_all_violations_have_the_upper_bound_1() -> None:
    counting = count_violations(np.ones(5, dtype=bool), [None] * 5, 0.05, 0.05)
    assert counting.upper == 1.0
    assert counting.lower == pytest.approx(0.05 ** (1.0 / 5.0))


def test_units_are_terrains_if_a_terrain_has_several_cases() -> None:
    is_violation = np.array([False, True, True, False, True])
    counting = count_violations(is_violation, ["a", "a", "b", "b", None], 0.05, 0.05)
    assert (counting.cases, counting.violations, counting.units) == (5, 3, 3)
    # the violation on "a" is not its first case; the unknown terrain may be "b"
    assert (counting.violating_units, counting.first_violations) == (3, 1)


@pytest.mark.parametrize("cluster_size", [1, 4])
def test_bounds_cover_the_probability_for_any_correlation(cluster_size: int) -> None:
    """Half of the terrains violate with 8 %, the others never: p = 4 %. Each bound has a risk of 5 %."""
    rng, n_terrains, n_too_low, n_too_high, trials = np.random.default_rng(1), 100, 0, 0, 1000
    terrains: list[str | None] = [f"terrain {index % n_terrains}" for index in range(n_terrains * cluster_size)]
    for _ in range(trials):
        rates = np.tile(0.08 * (rng.random(n_terrains) < 0.5), cluster_size)
        counting = count_violations(rng.random(rates.size) < rates, terrains, 0.05, 0.05)
        n_too_low += counting.upper < 0.04
        n_too_high += counting.lower > 0.04
    # three standard errors above 5 %: 0.05 + 3 sqrt(0.05 * 0.95 / 1000)
    assert n_too_low <= 70
    assert n_too_high <= 70


#: Streams of case 5, blended with new ones.
BLEND = ((5, 0.8), (NEW_STREAM, 0.6))
DISPERSIONS = """
[dispersions]
altitude_m = {distribution = "normal", mean = 2000, sd = 100, truncate = [1700, 2200]}
terrain = {distribution = "in-turn", low = 0, high = "HIGH"}
"""


def load_fake_campaign(folder: Path, high: int, bound: float = 5.0) -> Campaign:
    """Load a campaign whose terrains are the numbers up to `high`, in turn."""
    dispersions, requirement = DISPERSIONS.replace("HIGH", str(high)), REQUIREMENT.replace("5.0", str(bound))
    return load_campaign(str(write_campaign(folder, dispersions=dispersions, requirement=requirement)))


def test_terrain_follows_the_number_of_the_streams(tmp_path: Path) -> None:
    campaign = prepare_campaign(load_fake_campaign(tmp_path, 99_999), 20_000)
    # a new case, a case with blended streams (a step of a Markov chain), and a case with the streams of case 3
    first, blended, repeated = (
        point.with_numbers(17) for point in (StudyPoint((0.0,)), StudyPoint((0.0,), blend=BLEND), StudyPoint((0.0,), 3))
    )
    assert [campaign.draws_at(point)["terrain"] for point in (first, blended, repeated)] == [17, 17, 3]
    assert blended.blend == ((5, 0.8), (17, 0.6))


def test_number_in_turn_that_selects_no_terrain_is_rejected(tmp_path: Path) -> None:
    dispersions = (
        DISPERSIONS.replace("HIGH", "99_999") + 'bank_seed = {distribution = "in-turn", low = 0, high = 99999}'
    )
    campaign = load_campaign(str(write_campaign(tmp_path, dispersions=dispersions)))
    with pytest.raises(CampaignError, match=r"dispersions\.bank_seed: is a distribution 'in-turn' of a number that"):
        prepare_campaign(campaign, 100)


def test_additional_cases_do_not_repeat_terrains(tmp_path: Path) -> None:
    """The study has at most 110 cases, and 110 terrains."""
    parameters = RareParameters("velocity", 0.5, samples=50, replicates=(2,), random_cases=(10,))
    start_rare(
        load_fake_campaign(tmp_path, 109), parameters, 100, tmp_path / "run", ExecutorConfig(1), RecordingWatch()
    )
    with pytest.raises(CampaignError, match="the 110 values of the distribution 'in-turn' repeat within 111 cases"):
        continue_rare(tmp_path / "run", ExecutorConfig(1), RecordingWatch(), random_cases=1)


def test_reduced_violation_keeps_its_terrain(tmp_path: Path) -> None:
    campaign = load_fake_campaign(tmp_path, 99_999, bound=0.5)
    parameters = SearchParameters("velocity", cases=20, restarts=1, max_failures=1)
    result = start_search(campaign, parameters, 500, tmp_path / "run", ExecutorConfig(1), RecordingWatch())
    rows = {int(row["case"]): row for row in read_case_rows(tmp_path / "run")}
    assert all(row["terrain"] == StudyPoint.read(str(row[POINT_COLUMN])).stream for row in rows.values())
    (failure,) = result.failures
    assert failure.values["terrain"] == rows[failure.case]["terrain"] == rows[failure.original_case]["terrain"]
    (path,) = write_regression_campaigns(campaign, result, tmp_path / "run")
    assert tomllib.loads(path.read_text())["parameters"]["terrain"] == failure.values["terrain"]


def test_regression_campaign_has_the_fixed_and_derived_values_of_the_violation(tmp_path: Path) -> None:
    other = """
        "wind.north_m_s" = {distribution = "fixed", value = 7.0}
        "wind.east_m_s" = {distribution = "derived", formula = "0.01 * altitude_m"}
    """
    dispersions, requirement = DISPERSIONS.replace("HIGH", "99_999") + other, REQUIREMENT.replace("5.0", "0.5")
    campaign = load_campaign(str(write_campaign(tmp_path, dispersions=dispersions, requirement=requirement)))
    parameters = SearchParameters("velocity", cases=20, restarts=1, max_failures=1)
    result = start_search(campaign, parameters, 500, tmp_path / "run", ExecutorConfig(1), RecordingWatch())
    (failure,) = result.failures
    row = next(row for row in read_case_rows(tmp_path / "run") if row["case"] == failure.case)
    (path,) = write_regression_campaigns(campaign, result, tmp_path / "run")
    wind = tomllib.loads(path.read_text())["parameters"]["wind"]
    assert (wind["north_m_s"], wind["east_m_s"]) == (7.0, row["wind.east_m_s"])
    assert row["wind.east_m_s"] != campaign.definition.parameters["wind"]["east_m_s"]


def test_numbers_that_repeat_within_the_study_are_rejected(tmp_path: Path) -> None:
    campaign = load_fake_campaign(tmp_path, 9)
    assert prepare_campaign(campaign, 10).drawn_paths == ("altitude_m",)
    with pytest.raises(CampaignError, match=r"dispersions\.terrain: the 10 values .* repeat within 11 cases; extend"):
        prepare_campaign(campaign, 11)


@pytest.mark.parametrize("name", ["dimes-gusev", "dimes-smoke", "loc-jezero", "vtt-terrains"])
def test_campaigns_with_a_terrain_for_each_case_can_be_studied(name: str) -> None:
    """20,000 is the default limit of `marsyard rare`."""
    campaign = prepare_campaign(load_campaign(name), 20_000)
    assert not {"location.terrain", "world.terrain"} & set(campaign.drawn_paths)


#: Small campaigns that each render cases of one scenario.
CAMPAIGNS = {
    "dimes-smoke": ("terrain.samples=512",),
    "hda-benign": ("terrain.samples=512",),
    "vtt-montecarlo": ("world.samples=512", "start.distance_m=2.4", "target.diameter_m=0.5"),
}


@pytest.mark.parametrize("system", ["dimes", "vtt", "hda"])
def test_each_system_has_requirements_with_margins_and_error_sources(system: str) -> None:
    (names,) = [item.campaigns for item in systems() if item.name == system]
    n_with_margin = 0
    for name in names:
        campaign = load_campaign(name)
        requirements = campaign.definition.requirements
        n_with_margin += any(item.bound is not None or item.margin is not None for item in requirements)
        assert len(active_sources(campaign)[0]) >= 3, name  # error sources that have an effect in this campaign
    assert n_with_margin >= 1


@pytest.mark.parametrize(("name", "sources"), [("dimes-offnominal", {"optics", "clouds"}), ("hda-limits", {"motion"})])
def test_error_source_in_a_dispersed_table_is_active(name: str, sources: set[str]) -> None:
    """The table (`faults`, `image_poses`) is drawn as a whole; in the campaign's parameters the source does not act."""
    assert sources <= {source.name for source in active_sources(load_campaign(name))[0]}


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMPAIGNS)
def test_case_of_each_system_runs_without_its_error_sources(name: str) -> None:
    """A case at a point is deterministic, has a margin, and changes if all sources of error are removed.

    A small step of its random streams changes it as well.
    """
    campaign = load_campaign(name, CAMPAIGNS[name])
    removed = tuple(source.name for source in active_sources(campaign)[0])
    requirement = next(item for item in campaign.definition.requirements if item.bound or item.margin)
    rows = []
    step = ((3, 0.995), (4, math.sqrt(1.0 - 0.995**2)))
    for sources, blend in (((), ()), (removed, ()), ((), ()), ((), step)):
        point = StudyPoint((0.1,) * len(campaign.drawn_paths), 3, (), sources, blend)
        parameters = campaign.with_values(campaign.draws_at(point), point.removed)
        for shared_input in campaign.scenario.shared_inputs(parameters):
            campaign.scenario.prepare(parameters, shared_input)
        result = campaign.scenario.run(parameters, campaign.streams_at(point))
        row = {column: value for column, value in result.row.items() if "time" not in column}
        rows.append({"outcome": str(result.outcome), "answered": result.answered, **row})
        assert not math.isnan(compute_margin(rows[-1], requirement))
    assert rows[0] == pytest.approx(rows[2], nan_ok=True)
    assert rows[0] != rows[1]
    assert rows[0] != rows[3]
