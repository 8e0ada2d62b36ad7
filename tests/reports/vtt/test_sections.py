"""Sections on visual target tracking: ours beside the paper's, against rows whose numbers are known."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from marsyard.reports.presentation import presentations
from marsyard.reports.vtt.goal import GOAL, camera_runs, losses_grid
from marsyard.reports.vtt.presentation import VTT
from marsyard.reports.vtt.sections import (
    CHECKOUT_1,
    CHECKOUT_3,
    PAPER,
    REGRESSION,
    SINGLE_RUNS,
    TERRAINS,
    measured_accuracy,
    regression_section,
    step_rates,
    steps_section,
    table_1_section,
    terrains_section,
    updates_section,
)
from tests.reports.vtt.tracking_rows import put, rows, subject, table


def test_table_1_is_computed_to_the_printed_digit() -> None:
    computed = table(table_1_section(subject(rows(4))))
    for printed, ours in (computed[:2], computed[2:]):
        assert (printed.pop(""), ours.pop("")) == ("printed", "computed")
        assert ours == printed
    assert computed[0]["Designation (cm)"] == "9.7"
    assert computed[2]["Approach without tracker (cm)"] == "42.0"


def test_measured_accuracy_is_three_times_the_rms_by_camera() -> None:
    frame = rows(8, camera=["research-navcam"] * 4 + ["research-pancam"] * 4)
    frame.loc[:3, "designation_error_m"] = [0.0, 0.0, 0.0, 0.2]
    frame.loc[4:, "drift_px"] = [3.0, 4.0, 5.0, 0.0]
    navcam, pancam = measured_accuracy(frame)
    assert navcam["designation_cm"] == pytest.approx(300.0 * 0.1)
    assert navcam["disparity_px"] == pytest.approx(0.1 / 0.388)
    # Eq. 3: sqrt(0.1^2 + 0.05^2), root mean square.
    assert navcam["untracked_cm"] == pytest.approx(300.0 * np.hypot(0.1, 0.05))
    assert pancam["drift_px"] == pytest.approx(np.sqrt(12.5))
    shown = table(table_1_section(subject(frame)), 1)
    # Navcam, 2 px of drift: sqrt(1.6^2 + 0.32^2).
    assert shown[0]["Table I, the same"] == "1.6"
    # Runs from elsewhere, at unfit targets or not completed do not count.
    assert measured_accuracy(frame.assign(range_start_m=7.0)) == []
    assert measured_accuracy(frame.assign(selectable=False)) == []
    assert measured_accuracy(frame.assign(position_error_m=np.nan)) == []


def _shared(skips: int = 5) -> pd.DataFrame:
    """Two trackers, steps of 1 - 0.95^(n+1), ten targets each: pure NCC tracks fewer with every step."""
    frames = []
    for algorithm in ("vtt", "pure_ncc"):
        for skip in range(skips):
            tracked = np.arange(10) < (10 if algorithm == "vtt" else 8 - skip)
            frames.append(rows(10, algorithm=algorithm, skip=skip, step=1.0 - 0.95 ** (skip + 1), tracked=tracked))
    return pd.concat(frames, ignore_index=True)


def test_steps_stand_next_to_fig_8() -> None:
    frame = _shared()
    frame.loc[0, ["selectable", "tracked", "true_track"]] = False  # a target on the edge counts for nothing
    found = step_rates(subject(frame, legs=[{"motion": "approach", "step_fraction": 0.05}]))
    at = {(one["line"], round(one["step"])): one for one in found}
    assert (at["vtt", 5]["good"].hits, at["vtt", 5]["good"].n, at["vtt", 5]["paper_percent"]) == (9, 9, 100.0)
    assert (at["vtt", 5]["all_targets"].hits, at["vtt", 5]["all_targets"].n) == (9, 10)
    assert at["vtt", 5]["false_tracks"].hits == 0
    assert (at["pure-ncc", 23]["good"].hits, at["pure-ncc", 23]["paper_percent"]) == (4, 15.0)
    assert at["pure-ncc", 10]["paper_percent"] is None
    section = steps_section(subject(frame, legs=[{"motion": "approach"}]))
    assert section is not None
    assert "Fig. 8" in section.title


def test_steps_around_and_in_place_are_degrees() -> None:
    frame = pd.concat([rows(11, skip=k, step=5.0 * (k + 1), search_px=px) for k in range(3) for px in (200, 600)])
    frame = frame.reset_index(drop=True)
    around = step_rates(subject(frame, legs=[{"motion": "circle"}]))
    assert [(one["line"], one["step"]) for one in around[:3]] == [("200 px", 5.0), ("200 px", 10.0), ("200 px", 15.0)]
    assert around[2]["paper_percent"] == pytest.approx(100.0 * 9 / 11)
    turned = step_rates(subject(frame, legs=[{"motion": "turn"}]))
    assert {one["paper_percent"] for one in turned} == {None}
    assert steps_section(subject(rows(3))) is None


def test_oblique_targets_are_reported_apart_and_those_off_the_face_are_no_part_of_the_paper_s_share() -> None:
    """Face-on targets are tracked, oblique ones lost: the share beside the paper's is of those on the face alone."""
    face_on = rows(6, skip=0, step=5.0, obliquity_max_deg=40.0, in_view=True, on_face=True)
    oblique = rows(4, skip=0, step=5.0, obliquity_max_deg=72.0, in_view=True, on_face=False, tracked=False)
    hidden = rows(3, skip=0, step=5.0, obliquity_max_deg=80.0, in_view=False, on_face=False, tracked=False)
    run = subject(pd.concat([face_on, oblique, hidden], ignore_index=True), legs=[{"motion": "circle"}])
    (cell,) = step_rates(run)
    assert (cell["good"].hits, cell["good"].n, cell["all_targets"].n) == (6, 6, 13)
    section = steps_section(run)
    assert section is not None
    grid = section.blocks[-1].grid
    assert grid is not None
    assert [list(row) for row in grid.rows] == [["0 to 45", "6 of 6"], ["70 to 90", "0 of 4"]]


def _with_updates(numbers: int, cases: int = 3) -> pd.DataFrame:
    frame = rows(cases)
    for n in range(1, numbers + 1):
        for name, value in (("range_m", 4.0), ("magnification", 1.0 + 0.01 * n), ("roll_change_deg", -2.0)):
            frame[f"update_{n}_{name}"] = value
        for name in ("azimuth_change_deg", "match_score", "stereo_score", "correction_px", "error_px"):
            frame[f"update_{n}_{name}"] = 0.9
    return frame


def test_table_iii_stands_next_to_ours() -> None:
    frame = _with_updates(8)
    frame.loc[0, "update_8_match_score"] = 0.5
    shown = table(updates_section(subject(frame, CHECKOUT_1)))
    scores = next(k for k, row in enumerate(shown) if row["Parameter"] == "NCC score")
    assert (shown[scores]["8"], shown[scores]["1"]) == ("0.79", "–")
    assert shown[scores + 1]["8"] == "0.90 (0.50 to 0.90)"
    rolls = next(k for k, row in enumerate(shown) if row["Parameter"] == "Roll change (deg)")
    assert shown[rolls + 1]["2"] == "2.00"  # without its sign, as the paper prints it
    other = table(updates_section(subject(frame, "another")))
    assert other[7]["NCC score"] == "0.90 (0.50 to 0.90)"
    assert other[7]["Roll change (deg)"] == "−2.00"
    assert updates_section(subject(rows(3))) is None


def test_table_iii_is_as_printed() -> None:
    """What the paper's text says of its table holds of ours."""
    printed = {name: list(values.values()) for name, values in PAPER["table_3"].items()}
    ends = {"match_score": (0.79, 0.94), "magnification": (0.97, 1.04), "roll_change_deg": (0.06, 6.25)}
    assert {name: (min(printed[name]), max(printed[name])) for name in ends} == ends
    # From -3.4 to 50.1 deg; the table's own changes come to as much.
    assert sum(printed["azimuth_change_deg"]) == pytest.approx(53.5, abs=0.1)


def test_facts_of_single_runs() -> None:
    frame = rows(4, target_motion_m=[0.1, 0.2, 0.3, 0.4], tracked=[True, True, True, False])
    shown = {row[""]: row for row in table(SINGLE_RUNS(subject(frame, "vtt-checkout-2")))}
    moved = shown["target moved, first to last estimate (cm)"]
    assert (moved["Paper"], moved["Ours"]) == ("36", "25.0 (10.0 to 40.0)")
    assert shown["tracked to the goal"]["Ours"] == "3 of 4: 75.00 %"
    assert shown["maximum correction (px)"]["Ours"] == "–"
    roll = rows(4, roll_compensated=[True, True, False, False], tracked=[True, True, True, False])
    shown = {row[""]: row for row in table(SINGLE_RUNS(subject(roll, "vtt-roll")))}
    assert shown["tracked with compensation"]["Ours"] == "2 of 2: 100 %"
    assert SINGLE_RUNS(subject(frame, "another")) is None


def test_table_iv_by_mode() -> None:
    driven: list[dict[str, object]] = [{"motion": motion} for motion in ("stay", "turn", "back-off")]
    driven += [{"motion": "back-off", "autonav": True}, {"visual_odometry": True}]
    driven += [{"motion": "approach", "autonav": True}]
    frame = rows(2)
    legs = [-1, 0, *[1] * 7, *[2] * 9, 3, *[4] * 4, *[5] * 4]
    for n, leg in enumerate(legs, start=1):
        frame[f"update_{n}_leg"], frame[f"update_{n}_time_s"] = float(leg), 60.0 * n
    frame.loc[1, ["update_27_leg", "update_27_time_s"]] = np.nan  # ended a step early
    shown = table(SINGLE_RUNS(subject(frame, CHECKOUT_3, legs=driven)), 1)
    assert [row["Updates, paper"] for row in shown] == ["2", "7", "10", "4", "4"]
    assert [row["Updates, ours"] for row in shown] == ["2", "7", "10", "4", "4 (3 to 4)"]
    assert [row["Minutes, ours"] for row in shown[:4]] == ["2.0", "7.0", "10.0", "4.0"]


def test_table_iv_is_as_printed() -> None:
    assert sum(mode["updates"] for mode in PAPER["table_4"]) == 27
    assert sum(mode["minutes"] for mode in PAPER["table_4"]) == 66


def test_terrains_tell_failures_and_causes() -> None:
    frame = rows(20, incline=["flat ground"] * 8 + ["steep incline"] * 8 + ["a ledge"] * 4)
    frame.loc[[0, 1, 8, 9, 10], "tracked"] = False
    put(frame, 0, outcome="LOST", azimuth_change_max_deg=14.0, losses="MATCH_SCORE")
    put(frame, 1, outcome="LOST", clear_sky=False)
    frame.loc[8, "outcome"] = "STUCK"
    put(frame, 9, outcome="LOST", losses="STEREO_SCORE")
    frame.loc[15, ["selectable", "tracked"]] = False
    shown = {row["Terrain"]: row for row in table(terrains_section(subject(frame, TERRAINS)))}
    assert list(shown) == ["flat ground", "steep incline", "a ledge"]
    assert shown["flat ground"]["Failures, paper"] == "1 of 11"
    assert shown["flat ground"]["Failures, ours"] == "2 of 8: 25.00 %"
    assert shown["flat ground"]["Cause, ours"] == "excessive azimuth change: 1; lighting change: 1"
    assert shown["steep incline"]["Failures, ours"] == "3 of 7: 42.86 %"
    assert shown["steep incline"]["Failures, all targets"] == "4 of 8: 50.00 %"
    assert set(shown["steep incline"]["Cause, ours"].split("; ")) == {"stuck: 1", "stereo score: 1", "drift: 1"}
    assert terrains_section(subject(frame, "another")) is None


def test_table_ii_is_as_printed() -> None:
    assert sum(row["trials"] for row in PAPER["table_2"].values()) == 26
    assert sum(row["failures"] for row in PAPER["table_2"].values()) == 2


def test_regression_runs_one_by_one() -> None:
    frame = rows(4, visual_odometry=[False, True, False, False], autonav=[False, False, True, True])
    frame = frame.assign(map_by=["none", "none", "body", "mast"], rock_height_m=[0.09, 0.09, 0.5, 0.5])
    put(frame, 3, tracked=False, outcome="NO_PATH", losses="none")
    section = regression_section(subject(frame, REGRESSION))
    shown = [(row["Driving"], row["Rock"], row["Tracked to the goal"]) for row in table(section)]
    assert shown == [
        ("Autonav by body cameras", "large", "1 of 1: 100 %"),
        ("Autonav by mast cameras", "large", "0 of 1: 0 %"),
        ("blind", "small", "1 of 1: 100 %"),
        ("visual odometry", "small", "1 of 1: 100 %"),
    ]
    assert table(section, 1)[0]["Outcome"] == "NO_PATH"


def test_goal_by_camera() -> None:
    n = 300
    frame = rows(2 * n, camera=["research-navcam"] * n + ["research-pancam"] * n)
    frame.loc[: n - 1, "position_error_m"] = np.linspace(0.0, 0.0399, n)
    put(frame, n, tracked=False, outcome="LOST", position_error_m=np.nan, drift_px=np.nan)
    put(frame, n, losses="MATCH_SCORE", lost_range_m=3.5)
    frame.loc[n + 1, "true_track"] = False
    navcam, pancam = camera_runs(frame)
    assert navcam["within"].hits == 225  # 0.0399 k / 299 stays within 3 cm up to k = 224
    assert navcam["median_m"] == pytest.approx(0.01995)
    assert navcam["quantile_bound_m"] > navcam["quantile_m"]
    assert (pancam["completed"].hits, pancam["completed"].n) == (n - 1, n)
    assert (pancam["within"].hits, pancam["within"].n) == (n - 1, n - 1)
    assert pancam["false_tracks"].hits == 1
    assert np.isfinite(pancam["quantile_bound_m"])
    assert losses_grid(frame).rows == [["LOST", "match score", "1", "3.5 to 3.5", "3.0", "0"]]
    shown = table(GOAL(subject(frame)), 1)
    assert shown[1]["Median (mm)"] == "4.000"
    few = table(GOAL(subject(frame.iloc[:20])), 1)
    assert few[0]["Its bound (mm)"] == "n too small"


def test_other_rows_have_no_section_of_tracking() -> None:
    """Rows of another system hold none of its columns; rows of crashed cases alone have no numbers."""
    assert VTT in presentations()
    ours = [*VTT.first, *VTT.sections]
    assert len(ours) == 7
    descent = pd.DataFrame({"case": [0, 1], "outcome": "VALID", "answered": True, "velocity_error_m_s": 1.0})
    for name in ("a-campaign", TERRAINS, REGRESSION, *(one["campaign"] for one in PAPER["facts"])):
        assert [make(subject(descent, name)) for make in ours] == [None] * 7
