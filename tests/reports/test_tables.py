"""Tests of tables, captions, names of columns, printed numbers and requirements in words."""

import io
import math
import re
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rich.console import Console, Group
from rich.table import Table

from marsyard.campaigns.definition.campaign_file import Requirement
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.reports.column_selection import axis_columns, category_column, driver_columns, primary_metric
from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.effects import correlation_text, estimate_effects
from marsyard.reports.hda.sections import MAP_CONDITIONS, MAP_ERRORS
from marsyard.reports.hda.sites_section import HazardDistances, distance_grid
from marsyard.reports.page import driver_figures, outcome_grid
from marsyard.reports.populations import outcome_counts
from marsyard.reports.rates import fraction_of
from marsyard.reports.tables import statistics_grid
from marsyard.reports.terminal_tables import verdict_table
from marsyard.reports.wording import (
    NOTHING,
    format_fraction,
    interval,
    label,
    magnitude_label,
    number,
    percent,
    population_text,
    requirement_text,
)
from marsyard.scenarios.systems import catalogue
from tests.reports.synthetic_run import VELOCITY, make_rows

REQUIREMENTS = sorted((Path(__file__).parents[2] / "scenarios").glob("*/requirements.toml"))


def _print_table(table: Table | Group, width: int) -> str:
    console = Console(width=width, file=io.StringIO(), force_terminal=False, legacy_windows=False)
    console.print(table)
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return text


@pytest.mark.parametrize("width", [80, 140])
def test_verdict_table_is_complete_at_any_width(width: int) -> None:
    verdicts = evaluate_requirements(make_rows(24), [VELOCITY, {**VELOCITY, "id": "DIMES-AVAIL", "population": "all"}])
    text = _print_table(verdict_table(verdicts), width)
    assert max(len(line) for line in text.splitlines()) <= width
    for message in ("DIMES-VEL", "DIMES-AVAIL", "INSUFFICIENT", *(verdict.note for verdict in verdicts)):
        assert message in " ".join(text.split())
    # no number is truncated
    assert "…" not in text


def test_verdict_table_reports_missing_requirements() -> None:
    assert "no requirement" in _print_table(verdict_table([]), 80)


def test_texts_are_not_interpreted_as_markup() -> None:
    verdicts = evaluate_requirements(make_rows(5), [{**VELOCITY, "id": "[red]R[/red]", "metric": "[/]"}])
    text = _print_table(verdict_table(verdicts), 140)
    assert "[red]R[/red]" in text


def test_outcomes_are_ordered_and_counted() -> None:
    frame = make_rows(200, n_crashed=2)
    counts = outcome_counts(frame)
    assert counts[0][0] == "VALID"
    assert counts[-1] == ("CRASHED", 2)
    assert sum(cases for _, cases in counts) == 200
    assert outcome_counts(frame.drop(columns="outcome")) == []


def test_statistics_table_has_errors_and_components() -> None:
    grid = statistics_grid(make_rows(24), "velocity_error_m_s")
    assert list(grid.head) == ["", "velocity error (m/s)", "east velocity error (m/s)", "north velocity error (m/s)"]
    assert [row[0] for row in grid.rows if "interval" not in row[0] and "bounds" not in row[0]][:3] == [
        "cases",
        "mean",
        "standard deviation",
    ]


def test_labels_are_derived_from_column_names() -> None:
    assert label("attitude_rate_max_deg_s") == "maximum attitude rate (deg/s)"
    assert label("terrain") == "terrain"
    assert magnitude_label("velocity_error_m_s") == "|velocity error| (m/s)"


def test_axis_columns_are_the_components_of_an_error() -> None:
    columns = list(make_rows(1).columns)
    assert axis_columns("velocity_error_m_s", columns) == ["velocity_error_x_m_s", "velocity_error_y_m_s"]
    assert axis_columns("score", columns) == []


def test_driver_columns_exclude_errors_and_bookkeeping_columns() -> None:
    drivers = driver_columns(make_rows(50), "velocity_error_m_s", max_columns=20)
    assert drivers[:3] == ["off_nadir_max_deg", "attitude_rate_max_deg_s", "altitude_1_m"]
    assert not {"case", "wall_time_s", "velocity_error_x_m_s", "terrain", "answered"} & set(drivers)


def test_category_column_has_few_distinct_values() -> None:
    frame = make_rows(100)
    assert category_column(frame) == "terrain"
    assert category_column(frame.assign(site=["Gusev", "Meridiani"] * 50)) == "site"
    assert category_column(make_rows(100, terrains=50)) is None


def test_primary_metric_is_an_existing_column() -> None:
    frame = make_rows(3)
    assert primary_metric(frame, [{**VELOCITY, "metric": "off_nadir_max_deg"}]) == "off_nadir_max_deg"
    assert primary_metric(frame, [{**VELOCITY, "metric": "no_such_column"}]) == "velocity_error_m_s"
    assert primary_metric(frame[["case", "outcome"]], []) is None


@pytest.mark.parametrize(
    ("fraction", "text"),
    [
        (1.0, "100 %"),
        (0.0, "0 %"),
        (0.5, "50.00 %"),
        (0.99999, "99.999 %"),
        (1e-9, "0.0000001 %"),
        (math.nan, "–"),
        (1.000673416, "100.07 %"),
    ],
)
def test_percent_format_keeps_significant_digits(fraction: float, text: str) -> None:
    assert percent(fraction) == text


def test_numbers_and_intervals_are_printed_with_four_digits() -> None:
    assert [number(value) for value in (0.0, -1.5, 12.345, 123.45)] == ["0.000", "−1.500", "12.35", "123.5"]  # noqa: RUF100
    assert (number(math.nan), number(math.inf), format_fraction(0.9973)) == ("–", "∞", "99.73 %")
    assert (interval(1.0, math.inf), interval(-math.inf, math.inf)) == ("≥ 1.000", "–")
    # rounding errors are printed as 0
    assert (number(9.09e-13), number(-9.09e-13), number(2e-7)) == ("0.000", "0.000", "2.00e−07")


def test_rate_without_cases_has_the_interval_0_to_1() -> None:
    empty = fraction_of(np.zeros(0, dtype=np.bool_), pd.DataFrame())
    assert (empty.hits, empty.n) == (0, 0)
    assert math.isnan(empty.fraction)
    assert empty.clustered_interval == (0.0, 1.0)


def test_requirement_texts_describe_metric_and_population() -> None:
    entries = {
        requirement["id"]: requirement
        for path in REQUIREMENTS
        for requirement in tomllib.loads(path.read_text(encoding="utf-8"))["requirements"]
    }
    texts = {
        name: requirement_text(
            Requirement.model_validate({key: value for key, value in entry.items() if key != "campaigns"})
        )
        for name, entry in entries.items()
    }
    assert texts["VTT-POS"] == (
        "the position error is at most 0.03 m in at least 99 % of valid answers with a selectable target, "
        "at 90 % confidence"
    )
    assert texts["HDA-SAFE"].startswith("the reported site is safe in at least 99 % of cases with a reported site")
    assert "cases with a selectable target and a rover that is not stuck, at 90 %" in texts["VTT-TRACK"]
    times = {
        "id": "TIME",
        "metric": "tracking_time_s + motion_time_s + structure_time_s + hazards_time_s",
        "scale": 60.0,
        "bound": 2.0,
        "probability": 0.95,
        "confidence": 0.9,
    }
    scaled = requirement_text(Requirement.model_validate(times))
    stages = "tracking time, motion time, structure time, and hazards time"
    assert scaled.startswith(f"60 times the sum of {stages} is at most 2 s in at least 95 % of all cases")
    by_rate = Requirement.model_validate({**times, "metric": "my_error_m", "decide_by": "estimate"})
    assert requirement_text(by_rate) == (
        "60 times the magnitude of 'my error' is at most 2 m in at least 95 % of all cases, "
        "evaluated by the observed rate, with bounds at 90 % confidence"
    )


@pytest.mark.parametrize(
    ("population", "text"),
    [
        ("valid and selectable and navcam", "valid answers with a selectable target and the navcam"),
        ("fault_free and navcam and clear_sky", "cases with the navcam and without a fault or clouds"),
        ("in_the_dark", "cases for which 'in_the_dark' is true"),
        ("valid and navcam and wet and cold", "valid answers with the navcam for which 'wet' and 'cold' are true"),
    ],
)
def test_populations_are_described_in_words(population: str, text: str) -> None:
    assert population_text(population) == text


@pytest.mark.parametrize("campaign", sorted(catalogue()))
def test_criteria_of_the_catalogue_are_written_by_hand(campaign: str) -> None:
    """No text of a requirement contains the name of a column, or a series of phrases that start with "with"."""
    for requirement in load_campaign(campaign).definition.requirements:
        text = requirement_text(requirement)
        # without an entry in `templates/notes.toml`, the name of the column is quoted; 'no safe site' is an answer
        assert "'" not in text.replace("'no safe site'", "").replace("rover's", "").replace("lander's", ""), text
        assert not set("_|≤") & set(text), text
        population = population_text(requirement.population)
        assert population.startswith(("all cases", "cases ", "completed cases", "valid answers"))
        assert population.count(" with ") <= 1 + population.count(" and with "), text


METRIC = "velocity_error_m_s"
DRIVERS = ("off_nadir_max_deg", "sun_elevation_deg")


def test_rank_correlations_have_intervals_and_need_enough_cases() -> None:
    few_captions = [figure.caption for figure in driver_figures(make_rows(12, answer_rate=1.0), METRIC, 5.0, DRIVERS)]
    assert few_captions
    assert not [caption for caption in few_captions if "correlation" in caption]
    captions = [figure.caption for figure in driver_figures(make_rows(60, answer_rate=1.0), METRIC, 5.0, DRIVERS)]
    pattern = r"Rank correlation −?\d\.\d{3} \(−?\d\.\d{3} to −?\d\.\d{3} at 90 % confidence\)"
    assert all(re.search(pattern, caption) for caption in captions)


@pytest.mark.parametrize(("maps", "has_interval"), [(10, False), (40, True)])
def test_rank_correlations_of_maps_have_intervals(maps: int, has_interval: bool) -> None:
    rng = np.random.default_rng(1)
    texture = rng.uniform(0.1, 1.0, maps)
    frame = pd.DataFrame({"texture": texture, "rms_fraction": rng.uniform(0.0, 0.1, maps) / texture})
    effect = estimate_effects(frame, MAP_CONDITIONS, MAP_ERRORS)[0]
    assert effect.response.startswith("elevation error")
    assert (" to " in correlation_text(effect)) == has_interval
    assert has_interval or correlation_text(effect) == NOTHING


def test_bound_without_enough_cases_is_a_dash() -> None:
    # a lower bound of the 5 % quantile at 90 % confidence needs 45 values: 0.95^45 = 0.0994
    (row,) = distance_grid({"sites": HazardDistances(np.array([1.0, 2.0, 3.0]), None)}).rows
    assert row[-1] == NOTHING


@pytest.mark.parametrize(
    ("scenario", "meaning"),
    [
        ("descent", "a velocity is reported"),
        ("localisation", "a position is reported"),
        ("measured-velocity", "reported"),
    ],
)
def test_outcome_has_the_meaning_of_its_system(scenario: str, meaning: str) -> None:
    rows = outcome_grid(pd.DataFrame({"outcome": ["VALID"] * 3}), scenario).rows
    assert len(rows) == 1
    assert meaning in rows[0][3]  # column: meaning
