"""Sections that a report has where the rows hold their columns: numbers against truth that is known."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from marsyard.reports.campaign import write_report
from marsyard.reports.common_sections import FAULT_OUTCOMES, answer_shares, faults_section
from marsyard.reports.conditions import conditions_section, cuts, terrain_spread
from marsyard.reports.dimes.sections import FIRING, LANDING, rank_effects, sensitivity_section
from marsyard.reports.section import Section, Subject
from marsyard.reports.stored import StoredRun

Rows = Callable[..., pd.DataFrame]
MakeRun = Callable[..., Path]
METRIC = "velocity_error_m_s"


def subject(frame: pd.DataFrame, bound: float | None = 5.0) -> Subject:
    return Subject(StoredRun(Path("run"), frame, frame, {}, ()), METRIC, bound)


def cells(section: Section | None, row: str) -> list[str]:
    """The cells of the row of that name in the section's tables."""
    assert section is not None
    grids = [block.grid for block in section.blocks if block.grid is not None]
    (found,) = [list(cells) for grid in grids for cells in grid.rows if cells[0] == row]
    return found


def errors(frame: pd.DataFrame, parts: np.ndarray) -> pd.DataFrame:
    return frame.assign(
        velocity_error_x_m_s=parts[:, 0], velocity_error_y_m_s=parts[:, 1], velocity_error_m_s=np.hypot(*parts.T)
    )


def test_answers_are_reported_by_their_share_and_harm() -> None:
    n = 200
    answered, room = np.arange(n) >= 30, np.arange(n) >= 20
    magnitude = np.where(np.arange(n) == 100, 7.0, 1.0)
    magnitude[~answered] = np.nan
    frame = pd.DataFrame(
        {"answered": answered, "feasible_overlap": room, METRIC: magnitude, "terrain": np.arange(n) // 2}
    )
    shares = list(answer_shares(subject(frame)).values())
    assert [(one.hits, one.n) for one in shares] == [(170, 200), (170, 180), (20, 200), (1, 170)]
    # One of 170: Clopper-Pearson at 90 %, both sides: BetaInv(0.05; 1, 170) and BetaInv(0.95; 2, 169).
    assert (shares[3].lower, shares[3].upper) == pytest.approx((0.000302, 0.027594), abs=2e-5)
    # Two cases a terrain fail together: the interval that allows for it must be wider.
    assert shares[0].shared_lower is not None
    assert shares[0].shared_lower < shares[0].lower
    assert answer_shares(subject(frame.drop(columns="answered"))) == {}


def test_crashed_cases_of_unknown_room_count_as_failures_with_room(make_rows: Rows) -> None:
    frame = make_rows(50, answered=1.0, crashed=5)
    room: list[bool | None] = [True] * 45 + [None] * 5
    shares = answer_shares(subject(frame.assign(feasible_overlap=pd.Series(room, dtype=object))))
    assert [(one.hits, one.n) for one in shares.values()] == [(45, 50), (45, 50), (0, 45), (0, 45)]


def test_bins_hold_all_cases_once_and_know_their_errors() -> None:
    rng = np.random.default_rng(1)
    n = 1000
    rate = rng.uniform(0.0, 60.0, n)
    frame = pd.DataFrame({"answered": rng.random(n) < 0.9, "attitude_rate_max_deg_s": rate, "site": ["a", "b"] * 500})
    # East: a bias that grows with the rate, without noise; north: noise of deviation 2.
    frame = errors(frame, np.column_stack([0.1 * rate, rng.normal(0.0, 2.0, n)]))
    by_column = dict(cuts(frame))
    assert list(by_column) == ["attitude_rate_max_deg_s", "site"]
    for bins in by_column.values():
        np.testing.assert_array_equal(np.sum([chosen for _, chosen in bins], axis=0), 1)
    section = conditions_section(subject(frame))
    assert section is not None
    bins = section.data["attitude_rate_max_deg_s"]
    assert [one["answered"]["n"] for one in bins] == [200] * 5
    assert [one["means"][0] for one in bins] == pytest.approx([0.6, 1.8, 3.0, 4.2, 5.4], abs=0.15)
    assert [one["sds"][1] for one in bins] == pytest.approx([2.0] * 5, rel=0.2)
    # Of 450 answers, the 450 of one site: a bound of the 99 % quantile; of 180 none.
    assert bins[0]["quantile_bound"] == np.inf
    of_site = section.data["site"][0]
    valid = frame[frame["answered"] & frame["site"].eq("a")]
    assert np.quantile(valid[METRIC], 0.99) < of_site["quantile_bound"] <= of_site["largest"]


def test_conditions_that_do_not_vary_are_left_out(make_rows: Rows) -> None:
    frame = make_rows(60).assign(sun_elevation_deg=40.0)
    assert "sun_elevation_deg" not in dict(cuts(frame))
    assert conditions_section(subject(frame[["answered", METRIC]])) is None
    # Few cases of many kinds say nothing, kind by kind.
    assert "site" not in dict(cuts(frame.assign(site=[f"site {k % 10}" for k in range(60)])))


def test_spread_between_terrains_is_found() -> None:
    rng = np.random.default_rng(6)
    terrain = np.repeat(np.arange(200), 5)
    # Deviations of 3 within and 2 between terrains: 4 of 13 of the variance. Standard error of the share: about 0.035.
    error = 2.0 * rng.standard_normal(200)[terrain] + 3.0 * rng.standard_normal(1000)
    frame = pd.DataFrame({"answered": True, "terrain": terrain, METRIC: error})
    spread = terrain_spread(frame, METRIC)
    assert spread is not None
    assert spread["share"] == pytest.approx(4.0 / 13.0, abs=0.1)
    assert spread["within_sd"] == pytest.approx(3.0, rel=0.08)
    assert spread["between_sd"] == pytest.approx(2.0, rel=0.2)
    assert spread["p_value"] < 1e-6
    alike = terrain_spread(frame.assign(**{METRIC: rng.standard_normal(1000)}), METRIC)
    assert alike is not None
    assert alike["p_value"] > 0.01
    assert terrain_spread(frame.assign(terrain=np.arange(1000)), METRIC) is None
    assert terrain_spread(frame.drop(columns="terrain"), METRIC) is None


def test_firing_section_wants_its_error(make_rows: Rows) -> None:
    frame = make_rows(30)
    assert FIRING(subject(frame)) is None
    carried = FIRING(subject(frame.assign(firing_velocity_error_m_s=0.5, firing_after_s=18.0)))
    assert cells(carried, "mean")[1] == "0.500"
    assert cells(carried, "firing after (s)")[1:] == ["18.00"] * 3


def test_faults_by_size() -> None:
    frame = pd.DataFrame(
        {
            "fault": ["none"] * 10 + ["dust"] * 20,
            "fault_size": [np.nan] * 10 + [0.5] * 10 + [0.1] * 10,
            "answered": [True] * 10 + [False] * 6 + [True] * 14,
            "outcome": ["VALID"] * 10 + ["NO_VALID_TRACK"] * 5 + ["IMU_MISMATCH"] + ["VALID"] * 14,
            METRIC: [1.0] * 10 + [np.nan] * 6 + [9.0] * 3 + [1.0] * 11,
        }
    )
    rows = FAULT_OUTCOMES.records(frame, subject(frame))
    assert [(row["fault"], row["n"], row["valid"], row["invalid"], row["wrong"]) for row in rows] == [
        ("none", 10, 10, 0, 0),
        ("dust", 10, 10, 0, 0),
        ("dust", 10, 1, 6, 3),
    ]
    assert [row["size"] for row in rows[1:]] == [0.1, 0.5]
    assert (rows[0]["commonest_refusal"], rows[2]["commonest_refusal"]) == ("", "NO_VALID_TRACK")
    assert faults_section(subject(frame)) is not None
    assert faults_section(subject(frame, None)) is None
    assert faults_section(subject(frame.drop(columns="fault"))) is None


def sensitive_rows(n: int, terrains: int, seed: int = 3) -> pd.DataFrame:
    """Errors whose mean magnitude grows by 1 m/s from the 5 % to the 95 % quantile of the attitude rate alone."""
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


def test_sensitivity_finds_the_driver_and_bounds_the_others() -> None:
    found = {driver.column: driver for driver in rank_effects(subject(sensitive_rows(600, 600)), METRIC)}
    effect, low, high = found["attitude_rate_max_deg_s"].effect
    assert effect == pytest.approx(1.0, abs=0.08)
    assert low < 1.0 < high
    # Of z + u, uniform with deviations 1.11 / sqrt(12) and 1 / sqrt(12), z has 0.743 of the whole deviation.
    assert found["attitude_rate_max_deg_s"].coefficient[0] == pytest.approx(0.743, abs=0.05)
    for name in ("descent_rate_m_s", "altitude_1_m"):
        assert abs(found[name].effect[0]) < 0.1
    correlation = found["attitude_rate_max_deg_s"].rank_correlation[0]
    assert correlation == pytest.approx(sensitive_rows(600, 600).corr("spearman").loc[METRIC].iloc[2], abs=1e-9)


def test_sensitivity_intervals_cover_the_truth_nine_times_of_ten() -> None:
    covered = 0
    for seed in range(40):
        (driver,) = (
            one
            for one in rank_effects(subject(sensitive_rows(120, 120, seed)), METRIC)
            if one.column == "attitude_rate_max_deg_s"
        )
        # The truth at this sample's own quantiles: 1/54 m/s for each deg/s.
        covered += driver.effect[1] <= (driver.high - driver.low) / 54.0 <= driver.effect[2]
    # Binomial of 40 with 0.9: three standard deviations are 6.
    assert covered >= 36 - 6


def test_sensitivity_wants_all_drivers_and_enough_cases() -> None:
    assert sensitivity_section(subject(sensitive_rows(49, 49))) is None
    assert sensitivity_section(subject(sensitive_rows(60, 60).drop(columns="altitude_1_m"))) is None
    assert sensitivity_section(subject(sensitive_rows(60, 60).assign(altitude_1_m=2000.0))) is None
    section = sensitivity_section(subject(sensitive_rows(60, 6)))
    assert len(cells(section, "descent rate (m/s)")) == 5


def test_landing_tells_good_and_harm() -> None:
    without = np.linspace(5.0, 25.0, 100)
    with_it = without - 4.0
    with_it[:10] = without[:10] + 2.0
    with_it[10:30] = without[10:30]
    frame = pd.DataFrame({"touchdown_speed_corrected_m_s": with_it, "touchdown_speed_uncorrected_m_s": without})
    frame.loc[100] = [np.nan, np.nan]  # crashed
    section = LANDING(subject(frame))
    assert section is not None
    assert (section.data["landings"], section.data["helped"], section.data["harmed"]) == (100, 0.7, 0.1)
    assert (section.data["largest_gain_m_s"], section.data["largest_loss_m_s"]) == pytest.approx((4.0, 2.0))
    assert cells(section, "faster than 20 m/s")[1:] == ["5.00 %", "25.00 %"]
    assert LANDING(subject(frame[["touchdown_speed_corrected_m_s"]])) is None


def test_page_and_twin_hold_every_section(make_rows: Rows, make_run: MakeRun) -> None:
    rng = np.random.default_rng(4)
    frame = make_rows(120).assign(
        feasible_overlap=True,
        descent_rate_m_s=rng.normal(75.0, 3.0, 120),
        fault=["dust", "cable noise"] * 60,
        fault_size=[0.1, 0.1, 0.2, 0.2] * 30,
        touchdown_speed_corrected_m_s=rng.uniform(0.0, 10.0, 120),
        touchdown_speed_uncorrected_m_s=rng.uniform(0.0, 30.0, 120),
    )
    directory = make_run(frame)
    text = write_report(directory).read_text(encoding="utf-8")
    twin: dict[str, Any] = json.loads((directory / "report.json").read_text(encoding="utf-8"))
    keys = ["answers", "scatter", "explained", "convergence", "faults", "landing", "sensitivity", "conditions"]
    assert list(twin["sections"]) == keys
    assert all(f'<section id="{key}"' in text for key in keys)
