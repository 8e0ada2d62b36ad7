"""Tests of optional report sections with rows of known statistics."""

import json
from typing import Any

import numpy as np
import pandas as pd
import pytest

from marsyard.reports.campaign_report import write_report
from marsyard.reports.column_selection import driver_columns
from marsyard.reports.common_sections import answer_fractions, fault_outcomes, faults_section
from marsyard.reports.conditions import bin_conditions, conditions_section, terrain_variance
from marsyard.reports.convergence import success_rate_curves
from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.dimes.sections import estimate_effects, ignition_section, landing_section, sensitivity_section
from marsyard.reports.effects import drivers_section
from marsyard.reports.section import Section, Subject
from tests.reports import synthetic_run
from tests.reports.synthetic_run import VELOCITY, MakeRun, make_rows

METRIC = "velocity_error_m_s"


def make_subject(frame: pd.DataFrame, bound: float | None = 5.0) -> Subject:
    return synthetic_run.make_subject(frame, METRIC, bound)


def find_cells(section: Section | None, row: str) -> list[str]:
    """Return the cells of the row with this name in the section's tables."""
    grids = [block.grid for block in section.blocks if block.grid is not None]
    (cells,) = [list(cells) for grid in grids for cells in grid.rows if cells[0] == row]
    return cells


def assign_errors(frame: pd.DataFrame, components: np.ndarray) -> pd.DataFrame:
    return frame.assign(
        velocity_error_x_m_s=components[:, 0],
        velocity_error_y_m_s=components[:, 1],
        velocity_error_m_s=np.hypot(*components.T),
    )


def test_answer_rates_have_clopper_pearson_intervals() -> None:
    n = 200
    is_answered, has_overlap = np.arange(n) >= 30, np.arange(n) >= 20
    errors = np.where(np.arange(n) == 100, 7.0, 1.0)
    errors[~is_answered] = np.nan
    frame = pd.DataFrame(
        {"answered": is_answered, "feasible_overlap": has_overlap, METRIC: errors, "terrain": np.arange(n) // 2}
    )
    rates = list(answer_fractions(make_subject(frame)).values())
    # valid answers of all cases, valid answers with feasible overlap, cases without overlap, wrong of valid answers
    assert [(rate.hits, rate.n) for rate in rates] == [(170, 200), (170, 180), (20, 200), (1, 170)]
    # 1 of 170, two-sided Clopper-Pearson at 90 %: BetaInv(0.05; 1, 170) and BetaInv(0.95; 2, 169)
    assert (rates[3].lower, rates[3].upper) == pytest.approx((0.000302, 0.027594), abs=2e-5)
    # the two cases of a terrain fail together, so the interval for shared terrains is wider
    assert rates[0].shared_lower is not None
    assert rates[0].shared_lower < rates[0].lower
    assert answer_fractions(make_subject(frame.drop(columns="answered"))) == {}


def test_crashed_cases_of_unknown_overlap_count_as_failures() -> None:
    frame = make_rows(50, answer_rate=1.0, n_crashed=5)
    has_overlap: list[bool | None] = [True] * 45 + [None] * 5
    rates = answer_fractions(make_subject(frame.assign(feasible_overlap=pd.Series(has_overlap, dtype=object))))
    # crashed cases count as cases with feasible overlap; the last two rates exclude them
    assert [(rate.hits, rate.n) for rate in rates.values()] == [(45, 50), (45, 50), (0, 45), (0, 45)]


def test_condition_bins_have_correct_error_statistics() -> None:
    rng = np.random.default_rng(1)
    n = 1000
    rate = rng.uniform(0.0, 60.0, n)
    frame = pd.DataFrame({"answered": rng.random(n) < 0.9, "attitude_rate_max_deg_s": rate, "site": ["a", "b"] * 500})
    # x: a bias proportional to the rate; y: noise with standard deviation 2
    frame = assign_errors(frame, np.column_stack([0.1 * rate, rng.normal(0.0, 2.0, n)]))
    by_column = dict(bin_conditions(frame, lambda name: True))
    assert list(by_column) == ["attitude_rate_max_deg_s", "site"]
    for bins in by_column.values():
        np.testing.assert_array_equal(np.sum([is_in_bin for _, is_in_bin in bins], axis=0), 1)
    section = conditions_section(make_subject(frame))
    bins = section.data["attitude_rate_max_deg_s"]
    assert [entry.answered.n for entry in bins] == [200] * 5
    assert [entry.means[0] for entry in bins] == pytest.approx([0.6, 1.8, 3.0, 4.2, 5.4], abs=0.15)
    assert [entry.sds[1] for entry in bins] == pytest.approx([2.0] * 5, rel=0.2)
    # A bound of the 99 % quantile at 90 % confidence needs 230 answers: a bin has 180, a site 450.
    assert bins[0].quantile_bound == np.inf
    site_bin = section.data["site"][0]
    valid = frame[frame["answered"] & frame["site"].eq("a")]
    assert np.quantile(valid[METRIC], 0.99) < site_bin.quantile_bound <= site_bin.largest


def test_constant_conditions_are_omitted() -> None:
    frame = make_rows(60).assign(sun_elevation_deg=40.0)
    assert "sun_elevation_deg" not in dict(bin_conditions(frame, lambda name: True))
    assert conditions_section(make_subject(frame[["answered", METRIC]])) is None
    # too few cases per category
    assert "site" not in dict(
        bin_conditions(frame.assign(site=[f"site {index % 10}" for index in range(60)]), lambda name: True)
    )


def test_variance_between_terrains_is_estimated() -> None:
    rng = np.random.default_rng(6)
    terrain = np.repeat(np.arange(200), 5)
    # standard deviations 3 within and 2 between terrains: 4/13 of the variance, standard error about 0.035
    error = 2.0 * rng.standard_normal(200)[terrain] + 3.0 * rng.standard_normal(1000)
    frame = pd.DataFrame({"answered": True, "terrain": terrain, METRIC: error})
    variance = terrain_variance(frame, METRIC)
    assert variance is not None
    assert variance.fraction == pytest.approx(4.0 / 13.0, abs=0.1)
    assert variance.within_sd == pytest.approx(3.0, rel=0.08)
    assert variance.between_sd == pytest.approx(2.0, rel=0.2)
    assert variance.p_value < 1e-6
    variance_without_effect = terrain_variance(frame.assign(**{METRIC: rng.standard_normal(1000)}), METRIC)
    assert variance_without_effect is not None
    assert variance_without_effect.p_value > 0.01
    assert terrain_variance(frame.assign(terrain=np.arange(1000)), METRIC) is None
    assert terrain_variance(frame.drop(columns="terrain"), METRIC) is None


def test_firing_section_needs_the_firing_error() -> None:
    frame = make_rows(30)
    assert ignition_section(make_subject(frame)) is None
    section = ignition_section(make_subject(frame.assign(firing_velocity_error_m_s=0.5, firing_after_s=18.0)))
    assert find_cells(section, "mean")[1] == "0.500"
    assert find_cells(section, "time from the last image to ignition (s)")[1:] == ["18.00", "18.00", "18.00"]


def test_late_answers_are_not_wrong_and_crashed_cases_are() -> None:
    """A metric at a stated time has no value if the answer came later; a crashed case has no flag `answered`."""
    frame = pd.DataFrame(
        {
            "fault": ["dust"] * 10,
            "fault_size": [0.5] * 10,
            "answered": pd.Series([True] * 8 + [False, None], dtype=object),
            "outcome": ["VALID"] * 8 + ["NO_VALID_TRACK", "CRASHED"],
            METRIC: [1.0] * 5 + [np.nan] * 2 + [9.0] + [np.nan] * 2,
        }
    )
    *_, wrong = answer_fractions(make_subject(frame)).values()
    assert (wrong.hits, wrong.n) == (2, 7)
    (row,) = fault_outcomes(METRIC, 5.0).records(frame)
    assert (row["valid"], row["invalid"], row["wrong"]) == (5, 3, 2)


def test_false_fixes_are_wrong_answers_whatever_is_reported_later() -> None:
    """100 descents: 30 withdraw a wrong position, and refuse at the end; 20 are right at 10 s and wrong at the end."""
    number = np.arange(100)
    frame = pd.DataFrame(
        {
            "fault": "haze",
            "fault_size": 1.0,
            "answered": number >= 30,
            "outcome": np.where(number < 30, "INCONSISTENT", "VALID"),
            "position_reported": True,
            "false_fix": number < 50,
            "position_error_at_10_s_m": np.where(number < 30, 300.0, 5.0),
        }
    )
    # three crashed cases, without flags
    crashed = pd.DataFrame({"fault": ["haze"] * 3, "fault_size": 1.0, "answered": False, "outcome": "CRASHED"})
    frame = pd.concat([frame, crashed], ignore_index=True)
    subject = synthetic_run.make_subject(frame, "position_error_at_10_s_m", 40.0, scenario="localisation")
    name, wrong = list(answer_fractions(subject).items())[-1]
    assert name.startswith("wrong answers: a reported position is more than 40 m from the true one (of cases")
    assert (wrong.hits, wrong.n) == (50, 100)
    counts, table = faults_section(subject).blocks
    (row,) = counts.data["rows"]
    assert (row["valid"], row["invalid"], row["wrong"], row["most_frequent_refusal"]) == (50, 3, 50, "CRASHED")
    assert "Valid: a position is reported, and none is wrong." in table.note


def test_faults_are_grouped_by_kind_and_size() -> None:
    frame = pd.DataFrame(
        {
            "fault": ["none"] * 10 + ["dust"] * 20,
            "fault_size": [np.nan] * 10 + [0.5] * 10 + [0.1] * 10,
            "answered": [True] * 10 + [False] * 6 + [True] * 14,
            "outcome": ["VALID"] * 10 + ["NO_VALID_TRACK"] * 5 + ["IMU_MISMATCH"] + ["VALID"] * 14,
            METRIC: [1.0] * 10 + [np.nan] * 6 + [9.0] * 3 + [1.0] * 11,
        }
    )
    rows = fault_outcomes(METRIC, 5.0).records(frame)
    assert [(row["fault"], row["n"], row["valid"], row["invalid"], row["wrong"]) for row in rows] == [
        ("none", 10, 10, 0, 0),
        ("dust", 10, 10, 0, 0),
        ("dust", 10, 1, 6, 3),
    ]
    assert [row["size"] for row in rows[1:]] == [0.1, 0.5]
    assert (rows[0]["most_frequent_refusal"], rows[2]["most_frequent_refusal"]) == ("", "NO_VALID_TRACK")
    assert faults_section(make_subject(frame)) is not None
    assert faults_section(make_subject(frame, None)) is None
    assert faults_section(make_subject(frame.drop(columns="fault"))) is None


def make_sensitive_rows(n: int, terrains: int, seed: int = 3) -> pd.DataFrame:
    """Return rows whose mean error increases with the attitude rate.

    The rate is uniform from 0 to 60 deg/s: from its 5 % to its 95 % quantile (54 deg/s) the error increases by 1 m/s.
    """
    rng = np.random.default_rng(seed)
    rate = rng.uniform(0.0, 60.0, n)
    return pd.DataFrame(
        {
            "descent_rate_m_s": rng.normal(75.0, 3.0, n),
            "altitude_1_m": rng.normal(2000.0, 30.0, n),
            "attitude_rate_max_deg_s": rate,
            "terrain": rng.integers(0, terrains, n),
            METRIC: 1.0 + rate / 54.0 + rng.uniform(-0.5, 0.5, n),
        }
    )


def test_sensitivity_is_large_for_the_true_driver_only() -> None:
    effects = {
        driver.column: driver for driver in estimate_effects(make_subject(make_sensitive_rows(600, 600)), METRIC)
    }
    effect, low, high = effects["attitude_rate_max_deg_s"].effect
    assert effect == pytest.approx(1.0, abs=0.08)
    assert low < 1.0 < high
    # The error is a sum of uniform variables of widths 60 / 54 = 1.11 and 1. Standardised coefficient:
    # 1.11 / sqrt(1.11^2 + 1^2) = 0.743
    assert effects["attitude_rate_max_deg_s"].coefficient[0] == pytest.approx(0.743, abs=0.05)
    for name in ("descent_rate_m_s", "altitude_1_m"):
        assert abs(effects[name].effect[0]) < 0.1
    correlation = effects["attitude_rate_max_deg_s"].rank_correlation[0]
    # column 2: attitude rate
    assert correlation == pytest.approx(make_sensitive_rows(600, 600).corr("spearman").loc[METRIC].iloc[2], abs=1e-9)


def test_sensitivity_intervals_have_90_percent_coverage() -> None:
    n_covering = 0
    for seed in range(40):
        effects = estimate_effects(make_subject(make_sensitive_rows(120, 120, seed)), METRIC)
        (driver,) = (effect for effect in effects if effect.column == "attitude_rate_max_deg_s")
        # true effect between this sample's quantiles: 1/54 m/s per deg/s
        n_covering += driver.effect[1] <= (driver.high - driver.low) / 54.0 <= driver.effect[2]
    # binomial(40, 0.9): three standard deviations are 6
    assert n_covering >= 36 - 6


def test_sensitivity_requires_all_drivers_and_enough_cases() -> None:
    assert sensitivity_section(make_subject(make_sensitive_rows(49, 49))) is None
    assert sensitivity_section(make_subject(make_sensitive_rows(60, 60).drop(columns="altitude_1_m"))) is None
    assert sensitivity_section(make_subject(make_sensitive_rows(60, 60).assign(altitude_1_m=2000.0))) is None
    section = sensitivity_section(make_subject(make_sensitive_rows(60, 6)))
    assert len(find_cells(section, "descent rate (m/s)")) == 5


def test_landing_section_reports_lower_and_higher_touchdown_speeds() -> None:
    uncorrected_m_s = np.linspace(5.0, 25.0, 100)
    corrected_m_s = uncorrected_m_s - 4.0
    corrected_m_s[:10] = uncorrected_m_s[:10] + 2.0
    corrected_m_s[10:30] = uncorrected_m_s[10:30]
    frame = pd.DataFrame(
        {"touchdown_speed_corrected_m_s": corrected_m_s, "touchdown_speed_uncorrected_m_s": uncorrected_m_s}
    )
    frame.loc[100] = [np.nan, np.nan]  # crashed
    section = landing_section(make_subject(frame))
    assert (section.data["landings"], section.data["reduced_fraction"], section.data["increased_fraction"]) == (
        100,
        0.7,
        0.1,
    )
    assert (section.data["largest_gain_m_s"], section.data["largest_loss_m_s"]) == pytest.approx((4.0, 2.0))
    assert find_cells(section, "faster than 20 m/s")[1:] == ["5.00 %", "25.00 %"]
    assert landing_section(make_subject(frame[["touchdown_speed_corrected_m_s"]])) is None


def test_convergence_is_that_of_the_first_cases() -> None:
    """The first half of the cases violates the requirement, the other half does not."""
    frame = make_rows(64, answer_rate=1.0, terrains=10_000)
    frame[METRIC] = np.where(np.arange(64) < 32, 9.0, 1.0)
    requirement = {**VELOCITY, "population": "all"}
    (curve,) = success_rate_curves(synthetic_run.make_subject(frame, METRIC, 5.0, requirements=[requirement]))
    sizes = [point.cases for point in curve.points]
    assert (sizes[0], sizes[-1], curve.required) == (8, 64, VELOCITY["probability"])
    assert [point.estimate for point in curve.points] == pytest.approx([max(0, n - 32) / n for n in sizes])
    (verdict,) = evaluate_requirements(frame, [requirement])
    assert (curve.points[-1].lower, curve.points[-1].upper) == (verdict.lower, verdict.upper)


@pytest.mark.usefixtures("plain_figures")
def test_page_and_json_contain_every_section(make_run: MakeRun) -> None:
    rng = np.random.default_rng(4)
    frame = make_rows(80).assign(
        feasible_overlap=True,
        descent_rate_m_s=rng.normal(75.0, 3.0, 80),
        fault=["dust", "cable noise"] * 40,
        fault_size=[0.1, 0.1, 0.2, 0.2] * 20,
        touchdown_speed_corrected_m_s=rng.uniform(0.0, 10.0, 80),
        touchdown_speed_uncorrected_m_s=rng.uniform(0.0, 30.0, 80),
    )
    directory = make_run(frame.drop(columns=["sun_elevation_deg", "horizontal_speed_m_s", "off_nadir_max_deg"]))
    text = write_report(directory).read_text(encoding="utf-8")
    report: dict[str, Any] = json.loads((directory / "report.json").read_text(encoding="utf-8"))
    keys = ["robustness", "answers", "scatter", "explained", "convergence", "faults", "validity", "landing"]
    keys += ["sensitivity", "conditions"]
    assert list(report["sections"]) == keys
    assert all(f'<section id="{key}"' in text for key in keys)


def test_true_cause_leads_the_drivers_of_errors_and_of_failures() -> None:
    """Of 30 conditions, one signed error (without correlation) causes the errors, another one the missing answers."""
    rng = np.random.default_rng(4)
    conditions = rng.standard_normal((400, 30))
    error = np.where(conditions[:, 29] > 1.0, np.nan, np.abs(3.0 * conditions[:, 28] + rng.standard_normal(400)))
    frame = pd.DataFrame({f"tilt_{index}_deg": values for index, values in enumerate(conditions.T)})
    frame = frame.assign(outcome="VALID", answered=np.isfinite(error), **{METRIC: error})
    assert driver_columns(frame, METRIC)[0] == "tilt_28_deg"
    section = drivers_section(make_subject(frame, bound=50.0))
    assert section is not None
    leaders = {name: drivers[0] for name, drivers in section.data.items()}
    assert {name: driver["condition"] for name, driver in leaders.items()} == {
        "the size of errors": "tilt_28_deg",
        "failures": "tilt_29_deg",
    }
    # the p-values are corrected for all conditions, of which the tables show 12
    assert [len(drivers) for drivers in section.data.values()] == [30, 30]
    assert [len(block.grid.rows) for block in section.blocks if block.grid] == [12, 12]
