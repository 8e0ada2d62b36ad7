"""Tests of the report sections on visual target tracking with rows of known statistics."""

import numpy as np
import pandas as pd
import pytest

from marsyard.reports.presentation import presentations
from marsyard.reports.vtt.goal_section import goal_section, losses_grid, summarize_cameras
from marsyard.reports.vtt.paper_sections import (
    regression_section,
    single_run_section,
    terrains_section,
    updates_section,
)
from marsyard.reports.vtt.presentation import VTT
from marsyard.reports.vtt.steps_section import step_rates, steps_section
from marsyard.reports.vtt.table_1_section import measured_accuracy, table_1_section
from marsyard.reports.vtt.tracking_runs import CHECKOUT_1, CHECKOUT_3, PAPER, REGRESSION, TERRAINS
from tests.reports.vtt.tracking_rows import make_rows, make_subject, read_table, set_values


def test_table_1_agrees_with_the_printed_digits() -> None:
    table_rows = read_table(table_1_section(make_subject(make_rows(4))))
    for printed_row, computed_row in (table_rows[:2], table_rows[2:]):
        assert (printed_row.pop("Source"), computed_row.pop("Source")) == ("paper", "computed")
        assert computed_row == printed_row
    assert table_rows[0]["3 sigma at the designation (cm)"] == "9.7"
    assert table_rows[2]["3 sigma at the goal without tracking (cm)"] == "42.0"


def test_measured_accuracy_is_3_sigma_per_camera() -> None:
    frame = make_rows(8, camera=["research-navcam"] * 4 + ["research-pancam"] * 4)
    frame.loc[:3, "designation_error_m"] = [0.0, 0.0, 0.0, 0.2]
    frame.loc[4:, "drift_px"] = [3.0, 4.0, 5.0, 0.0]
    navcam, pancam = measured_accuracy(frame)
    # the errors have 0.1 m rms: 3 sigma in cm
    assert navcam.designation_cm == pytest.approx(300.0 * 0.1)
    # Eq. 3 of the tracking paper: sqrt(0.1^2 + 0.05^2)
    assert navcam.untracked_cm == pytest.approx(300.0 * np.hypot(0.1, 0.05))
    assert pancam.drift_px == pytest.approx(np.sqrt(12.5))
    table = read_table(table_1_section(make_subject(frame)), 1)
    # Navcam, 2 px of drift: sqrt(1.6^2 + 0.32^2) = 1.63
    assert table[0]["Paper's formula: with tracking (cm)"] == "1.6"
    # runs from other ranges, at unselectable targets or without result are excluded
    assert measured_accuracy(frame.assign(range_start_m=7.0)) == []
    assert measured_accuracy(frame.assign(selectable=False)) == []
    assert measured_accuracy(frame.assign(position_error_m=np.nan)) == []


def _make_two_tracker_rows(step_sizes: int = 5) -> pd.DataFrame:
    """Return ten targets per tracker and step size; pure NCC loses one more target at each larger step.

    With n skipped images the step is 1 - 0.95^(n + 1) of the range.
    """
    frames = []
    for algorithm in ("vtt", "pure_ncc"):
        for skipped_stops in range(step_sizes):
            is_tracked = np.arange(10) < (10 if algorithm == "vtt" else 8 - skipped_stops)
            frames.append(
                make_rows(
                    10,
                    algorithm=algorithm,
                    skipped_stops=skipped_stops,
                    step=1.0 - 0.95 ** (skipped_stops + 1),
                    tracked=is_tracked,
                )
            )
    return pd.concat(frames, ignore_index=True)


def test_step_rates_are_compared_with_fig_8() -> None:
    """`good`: selectable targets that are tracked to the end."""
    frame = _make_two_tracker_rows()
    frame.loc[0, ["selectable", "tracked", "no_false_track"]] = False  # unselectable targets are excluded
    rates = step_rates(make_subject(frame, legs=[{"motion": "approach", "step_fraction": 0.05}]))
    rate_at = {(rate.line, round(rate.step)): rate for rate in rates}
    assert (rate_at["vtt", 5].good.hits, rate_at["vtt", 5].good.n, rate_at["vtt", 5].paper_percent) == (9, 9, 100.0)
    assert (rate_at["vtt", 5].all_targets.hits, rate_at["vtt", 5].all_targets.n) == (9, 10)
    assert rate_at["vtt", 5].false_tracks.hits == 0
    assert (rate_at["pure-ncc", 23].good.hits, rate_at["pure-ncc", 23].paper_percent) == (4, 15.0)
    assert rate_at["pure-ncc", 10].paper_percent is None
    section = steps_section(make_subject(frame, legs=[{"motion": "approach"}]))
    assert "Fig. 8" in section.title
    assert "Open marks" in section.blocks[0].figures[0].caption
    assert read_table(section)[0]["Tracker"] == "vtt"


def test_step_rates_of_circles_and_turns_are_per_degree() -> None:
    frame = pd.concat(
        [
            make_rows(11, skipped_stops=skipped_stops, step=5.0 * (skipped_stops + 1), search_px=window_px)
            for skipped_stops in range(3)
            for window_px in (200, 600)
        ]
    )
    frame = frame.reset_index(drop=True)
    circle_rates = step_rates(make_subject(frame, legs=[{"motion": "circle"}]))
    assert [(rate.line, rate.step) for rate in circle_rates[:3]] == [
        ("200 px", 5.0),
        ("200 px", 10.0),
        ("200 px", 15.0),
    ]
    assert circle_rates[2].paper_percent == pytest.approx(100.0 * 9 / 11)
    turn_rates = step_rates(make_subject(frame, legs=[{"motion": "turn"}]))
    assert {rate.paper_percent for rate in turn_rates} == {None}
    section = steps_section(make_subject(frame, legs=[{"motion": "turn"}]))
    # without numbers in the paper, there is no column of dashes and no mark to explain
    assert "Open marks" not in section.blocks[0].figures[0].caption
    assert "Paper, of selectable" not in read_table(section)[0]
    assert read_table(section)[0]["Search window"] == "200 px"
    assert steps_section(make_subject(make_rows(3))) is None


def test_oblique_targets_are_reported_separately() -> None:
    """The rate for the comparison with the paper excludes oblique targets; a separate table lists their rate."""
    face_on = make_rows(6, skipped_stops=0, step=5.0, obliquity_max_deg=40.0, in_view=True, on_face=True)
    oblique = make_rows(
        4, skipped_stops=0, step=5.0, obliquity_max_deg=72.0, in_view=True, on_face=False, tracked=False
    )
    hidden = make_rows(
        3, skipped_stops=0, step=5.0, obliquity_max_deg=80.0, in_view=False, on_face=False, tracked=False
    )
    run_subject = make_subject(pd.concat([face_on, oblique, hidden], ignore_index=True), legs=[{"motion": "circle"}])
    (cell,) = step_rates(run_subject)
    assert (cell.good.hits, cell.good.n, cell.all_targets.n) == (6, 6, 13)
    section = steps_section(run_subject)
    grid = section.blocks[-1].grid
    assert [list(row) for row in grid.rows] == [["0 to 45", "6 of 6"], ["70 to 90", "0 of 4"]]


def _make_update_rows(n_updates: int, cases: int = 3) -> pd.DataFrame:
    """Return rows with `n_updates` updates of the target per case."""
    frame = make_rows(cases)
    for number in range(1, n_updates + 1):
        for name, value in (("range_m", 4.0), ("magnification", 1.0 + 0.01 * number), ("roll_change_deg", -2.0)):
            frame[f"update_{number}_{name}"] = value
        for name in ("azimuth_change_deg", "match_score", "stereo_score", "correction_px", "error_px"):
            frame[f"update_{number}_{name}"] = 0.9
    return frame


def test_updates_are_compared_with_table_3() -> None:
    frame = _make_update_rows(8)
    frame.loc[0, "update_8_match_score"] = 0.5
    table = read_table(updates_section(make_subject(frame, CHECKOUT_1)))
    score_row = next(index for index, row in enumerate(table) if row["Quantity"] == "NCC score")
    assert (table[score_row]["Update 8"], table[score_row]["Update 1"]) == ("0.79", "–")
    assert table[score_row + 1]["Update 8"] == "0.90 (0.50 to 0.90)"
    roll_row = next(index for index, row in enumerate(table) if row["Quantity"] == "Roll change (deg)")
    assert table[roll_row + 1]["Update 2"] == "2.00"  # absolute value, as printed in the paper
    other_campaign = read_table(updates_section(make_subject(frame, "another")))
    assert other_campaign[7]["NCC score"] == "0.90 (0.50 to 0.90)"
    assert other_campaign[7]["Roll change (deg)"] == "−2.00"
    assert updates_section(make_subject(make_rows(3))) is None


def test_stored_tables_agree_with_the_sums_and_ranges_of_the_paper() -> None:
    assert [sum(mode[name] for mode in PAPER["table_4"]) for name in ("updates", "minutes")] == [27, 66]
    assert [sum(row[name] for row in PAPER["table_2"].values()) for name in ("trials", "failures")] == [26, 2]
    printed_values = {name: list(values.values()) for name, values in PAPER["table_3"].items()}
    ranges = {"match_score": (0.79, 0.94), "magnification": (0.97, 1.04), "roll_change_deg": (0.06, 6.25)}
    assert {name: (min(printed_values[name]), max(printed_values[name])) for name in ranges} == ranges
    # text of the paper: azimuth from -3.4 to 50.1 deg; the difference is the sum of the changes
    assert sum(printed_values["azimuth_change_deg"]) == pytest.approx(53.5, abs=0.1)


def test_single_runs_are_compared_with_the_paper() -> None:
    frame = make_rows(4, target_motion_m=[0.1, 0.2, 0.3, 0.4], tracked=[True, True, True, False])
    table = {row[""]: row for row in read_table(single_run_section(make_subject(frame, "vtt-checkout-2")))}
    target_motion = table["target moved, first to last estimate (cm)"]
    assert (target_motion["Paper"], target_motion["Ours"]) == ("36", "25.0 (10.0 to 40.0)")
    assert table["tracked to the goal"]["Ours"] == "3 of 4: 75.00 %"
    assert table["maximum correction (px)"]["Ours"] == "–"
    roll_rows = make_rows(4, roll_compensated=[True, True, False, False], tracked=[True, True, True, False])
    table = {row[""]: row for row in read_table(single_run_section(make_subject(roll_rows, "vtt-roll")))}
    assert table["tracked with roll compensation"]["Ours"] == "2 of 2: 100 %"
    assert single_run_section(make_subject(frame, "another")) is None


def test_updates_and_minutes_are_listed_per_mode_of_table_4() -> None:
    legs_driven: list[dict[str, object]] = [{"motion": motion} for motion in ("stay", "turn", "back-off")]
    legs_driven += [{"motion": "back-off", "autonav": True}, {"visual_odometry": True}]
    legs_driven += [{"motion": "approach", "autonav": True}]
    frame = make_rows(2)
    # leg that ended at each update; -1: the start
    legs = [-1, 0, *[1] * 7, *[2] * 9, 3, *[4] * 4, *[5] * 4]
    for number, leg in enumerate(legs, start=1):
        frame[f"update_{number}_leg"], frame[f"update_{number}_time_s"] = float(leg), 60.0 * number
    frame.loc[1, ["update_27_leg", "update_27_time_s"]] = np.nan  # the second run ended one step earlier
    table = read_table(single_run_section(make_subject(frame, CHECKOUT_3, legs=legs_driven)), 1)
    assert [row["Updates, paper"] for row in table] == ["2", "7", "10", "4", "4"]
    assert [row["Updates, ours"] for row in table] == ["2", "7", "10", "4", "4 (3 to 4)"]
    assert [row["Minutes, ours"] for row in table[:4]] == ["2.0", "7.0", "10.0", "4.0"]


def test_terrains_list_failures_and_causes() -> None:
    frame = make_rows(20, incline=["flat ground"] * 8 + ["steep incline"] * 8 + ["a ledge"] * 4)
    frame.loc[[0, 1, 8, 9, 10], "tracked"] = False
    set_values(frame, 0, outcome="LOST", azimuth_change_max_deg=14.0, losses="MATCH_SCORE")
    set_values(frame, 1, outcome="LOST", clear_sky=False)
    set_values(frame, 8, outcome="STUCK", stuck=True, target_held=True)
    set_values(frame, 9, outcome="LOST", losses="STEREO_SCORE")
    frame.loc[15, ["selectable", "tracked"]] = False
    table = {row["Terrain"]: row for row in read_table(terrains_section(make_subject(frame, TERRAINS)))}
    assert list(table) == ["flat ground", "steep incline", "a ledge"]
    assert table["flat ground"]["Failures, paper"] == "1 of 11"
    assert table["flat ground"]["Failures, ours"] == "2 of 8: 25.00 %"
    assert table["flat ground"]["Cause, ours"] == "excessive azimuth change: 1; lighting change: 1"
    # the stuck rover is no failure of the tracker, which holds the target
    assert table["steep incline"]["Failures, ours"] == "2 of 6: 33.33 %"
    assert table["steep incline"]["Failures, all targets"] == "3 of 7: 42.86 %"
    assert set(table["steep incline"]["Cause, ours"].split("; ")) == {"stereo score: 1", "drift: 1"}
    assert table["steep incline"]["Stuck: target held"] == "1 of 1: 100 %"
    assert table["flat ground"]["Stuck: target held"] == "–"
    assert terrains_section(make_subject(frame, "another")) is None


def test_regression_runs_are_listed_by_driving_mode() -> None:
    frame = make_rows(5, visual_odometry=[False, True, False, False, True], autonav=[False, False, True, True, True])
    frame = frame.assign(map_by=["none", "none", "body", "mast", "mast"], rock_height_m=[0.09, 0.09, 0.5, 0.5, 0.5])
    set_values(frame, 3, tracked=False, outcome="NO_PATH", losses="none")
    section = regression_section(make_subject(frame, REGRESSION))
    mode_rows = [(row["Driving"], row["Rock"], row["Tracked to the goal"]) for row in read_table(section)]
    assert mode_rows == [
        ("Autonav by body cameras", "large", "1 of 1: 100 %"),
        ("Autonav by mast cameras", "large", "0 of 1: 0 %"),
        ("Autonav by mast cameras, visual odometry", "large", "1 of 1: 100 %"),
        ("blind", "small", "1 of 1: 100 %"),
        ("visual odometry", "small", "1 of 1: 100 %"),
    ]
    assert read_table(section, 1)[0]["Outcome"] == "NO_PATH"


def test_goal_statistics_are_computed_per_camera() -> None:
    n = 300
    frame = make_rows(2 * n, camera=["research-navcam"] * n + ["research-pancam"] * n)
    frame.loc[: n - 1, "position_error_m"] = np.linspace(0.0, 0.0399, n)
    set_values(frame, n, tracked=False, outcome="LOST", position_error_m=np.nan, drift_px=np.nan)
    set_values(frame, n, losses="MATCH_SCORE", lost_range_m=3.5)
    frame.loc[n + 1, "no_false_track"] = False
    navcam, pancam = summarize_cameras(frame)
    assert navcam["within"].hits == 225  # the error of case k is 0.0399 k / 299 m: 3 cm is exceeded from k = 225 on
    assert navcam["median_m"] == pytest.approx(0.01995)
    assert navcam["quantile_bound_m"] > navcam["quantile_m"]
    assert (pancam["completed"].hits, pancam["completed"].n) == (n - 1, n)
    assert (pancam["within"].hits, pancam["within"].n) == (n - 1, n - 1)
    assert pancam["false_tracks"].hits == 1
    assert np.isfinite(pancam["quantile_bound_m"])
    assert losses_grid(frame).rows == [["LOST", "match score", "1", "3.5", "3.0"]]
    set_values(frame, n, clear_sky=False)
    assert losses_grid(frame).rows == [["LOST", "match score", "1", "3.5", "3.0", "1"]]
    table = read_table(goal_section(make_subject(frame)), 1)
    assert table[1]["Position error, median (cm)"] == "0.40"
    bound = "Upper bound of the 99 % quantile (cm)"
    one_small_camera = read_table(goal_section(make_subject(frame.iloc[: n + 20])), 1)
    assert [row[bound] for row in one_small_camera] == [table[0][bound], "too few runs"]


def test_quantiles_without_enough_runs_are_omitted() -> None:
    section = goal_section(make_subject(make_rows(20)))
    assert "99 %" not in " ".join(read_table(section, 1)[0])
    assert "Too few runs" in section.blocks[-1].note


def test_other_campaigns_have_no_tracking_section() -> None:
    """Rows of other systems have no columns of tracking."""
    assert VTT in presentations().values()
    sections = [*VTT.first, *VTT.sections]
    assert len(sections) == 7
    descent = pd.DataFrame({"case": [0, 1], "outcome": "VALID", "answered": True, "velocity_error_m_s": 1.0})
    for name in ("a-campaign", TERRAINS, REGRESSION, *(facts["campaign"] for facts in PAPER["facts"])):
        assert [make_section(make_subject(descent, name)) for make_section in sections] == [None] * 7
