"""Sections about landings: what they count, and the paper's numbers beside."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from marsyard.reports.campaign import write_report
from marsyard.reports.hda.classes import AtSize, curves, hazard_classes, knee
from marsyard.reports.hda.sections import (
    FAULT_OUTCOMES,
    FAULTS,
    MAP_EFFECTS,
    PAPER,
    THRESHOLD,
    TOUCHDOWN,
    map_rows,
    outcome_counts,
    run_times_section,
    site_shares,
)
from marsyard.reports.rates import PooledRate, pooled_rate
from marsyard.reports.section import Subject
from marsyard.reports.stored import StoredRun
from tests.reports.hda.made_up import landing_frame


def _subject(frame: pd.DataFrame) -> Subject:
    return Subject(StoredRun(Path("nowhere"), frame, frame, {}, ()), None, None)


def test_rates_pool_footprints_over_flights() -> None:
    frame = pd.DataFrame({"hits": [1, 0, 3, 0], "of": [10, 10, 20, 0]})
    found = pooled_rate(frame, "hits", "of")
    assert (found.hits, found.of, found.flights, found.flights_hit) == (4, 40, 3, 2)
    assert found.share == pytest.approx(0.1)
    assert found.lower < 0.1 < found.upper


def test_cases_with_one_footprint_count() -> None:
    found = pooled_rate(pd.DataFrame({"hits": [1, 0, 1, 1], "of": [1, 1, 2, 0]}), "hits", "of")
    assert (found.hits, found.of, found.flights, found.flights_hit) == (3, 4, 3, 2)


def test_interval_of_a_rate_covers_the_truth() -> None:
    """Flights differ in their rates; intervals of 90 % that took footprints as independent would cover seldom."""
    rng = np.random.default_rng(3)
    covered = 0
    for _ in range(60):
        chances = rng.beta(1.0, 9.0, 40)
        found = pooled_rate(pd.DataFrame({"hits": rng.binomial(500, chances), "of": np.full(40, 500)}), "hits", "of")
        covered += found.lower <= 0.1 <= found.upper
    assert covered >= 45


def test_no_hit_has_no_bootstrap_interval() -> None:
    found = pooled_rate(pd.DataFrame({"hits": [0, 0], "of": [10, 10]}), "hits", "of")
    assert found.share == 0.0
    assert np.isnan(found.upper)


def test_table_1_is_scaled_to_its_sum() -> None:
    section = run_times_section(_subject(landing_frame(20)))
    assert section is not None
    assert section.data["cases"] == 20
    times = section.data["stages"]
    assert sum(one["scaled_s"] for one in times) == pytest.approx(0.77)
    assert section.data["factor"] == pytest.approx(0.77 / 0.017)
    assert [one["parameters"] for one in times] == ["70 features", "60 tracks", "600 points", "19x27 terrain map"]
    assert sum(stage["seconds"] for stage in PAPER["stages"]) < 1.0  # "less than one second"


def test_table_2_next_to_landings() -> None:
    frame = landing_frame(200)
    section = TOUCHDOWN(_subject(frame))
    assert section is not None
    landed = frame[frame["landed"]]
    assert section.data["landings"] == len(landed)
    assert section.data["mean_m"]["touchdown_error_gps_m"] == pytest.approx(landed["touchdown_error_gps_m"].mean())
    assert section.data["paper_m"] == {"1": 1.21, "3": 1.20, "4": 0.89}
    assert np.mean([run["error_m"] for run in PAPER["landings"]]) == pytest.approx(1.1)
    assert TOUCHDOWN(_subject(frame.assign(landed=False))) is None


def test_sites_against_the_truth() -> None:
    frame = landing_frame(400)
    shares = site_shares(frame)
    safe = shares["chosen sites that are truly safe"]
    assert (safe.n, safe.hits) == (frame["site_reported"].sum(), (frame["site_reported"] & frame["site_safe"]).sum())
    assert shares["'no safe site', where none exists"].share == 1.0
    counts = outcome_counts(frame)
    assert sum(sum(row.values()) for row in counts.values()) == len(frame)
    assert counts["no safe site"]["no safe site"] == (frame["outcome"] == "NO_SAFE_SITE").sum()


def test_crashed_flights_are_counted_as_not_finished() -> None:
    frame = landing_frame(10)
    gone = ["site_reported", "site_safe", "no_site_reported", "answered"]
    frame = frame.astype(dict.fromkeys([*gone, "wide_site_exists"], object))
    frame.loc[0, gone] = None
    frame.loc[0, "wide_site_exists"] = True
    assert sum(row["not finished"] for row in outcome_counts(frame).values()) == 1


def test_classes_of_hazards() -> None:
    classes = hazard_classes(landing_frame(10))
    assert {one.kind for one in classes[:5]} == {"roughness"}
    assert [one.low for one in classes[:5]] == [0.0, 1.0, 1.5, 2.0, 3.0]
    assert [one.high for one in classes[:5]] == [1.0, 1.5, 2.0, 3.0, float("inf")]
    assert classes[1].called_safe.share == pytest.approx(0.03)
    assert classes[4].unflagged.share == 0.0


def test_thresholds() -> None:
    frame = landing_frame(40).assign(max_roughness_m=np.tile([0.1, 0.2], 20), false_alarms=np.tile([120, 30], 20))
    section = THRESHOLD(_subject(frame))
    assert section is not None
    low, high = section.data["thresholds"]
    assert (low["max_roughness_m"], high["max_roughness_m"]) == (0.1, 0.2)
    assert (low["false_alarms"]["share"], high["false_alarms"]["share"]) == (pytest.approx(0.2), pytest.approx(0.05))
    assert low["missed"]["share"] == pytest.approx(8 / 400)
    assert THRESHOLD(_subject(landing_frame(40))) is None


def test_faults_by_size() -> None:
    frame = landing_frame(60)
    frame["fault"] = np.repeat(["none", "laser_stuck", "laser_silent"], 20)
    frame["fault_size"] = np.concatenate([np.zeros(20), np.tile([0.05, 1.0], 10), np.ones(20)])
    rows = FAULT_OUTCOMES.records(frame, _subject(frame))
    assert [(row["fault"], row["size"], row["n"]) for row in rows] == [
        ("none", 0.0, 20),
        ("laser_silent", 1.0, 20),
        ("laser_stuck", 0.05, 10),
        ("laser_stuck", 1.0, 10),
    ]
    ends = ("safe", "refused", "unconverged", "wrong", "unfinished")
    assert all(sum(row[end] for end in ends) == row["n"] for row in rows)
    assert sum(row["wrong"] for row in rows) == (frame["site_reported"] & ~frame["site_safe"]).sum()
    assert FAULTS(_subject(landing_frame(20))) is None


def _changed(column: str, sizes: list[float], shares: list[float]) -> pd.DataFrame:
    """Flights with one change each, of a hundred features seen."""
    frame = landing_frame(len(sizes)).assign(roll_deg=0.0, pitch_deg=0.0, yaw_deg=0.0, height_change_fraction=0.0)
    frame[column] = sizes
    return frame.assign(features_in_view=100, tracks_correct=100.0 * np.array(shares), tracked_well=True)


def test_knee_stands_where_the_curve_falls_below_nine_tenths() -> None:
    (curve,) = curves(_changed("roll_deg", [0.0, 8.0, 12.0, 16.0], [1.0, 0.96, 0.92, 0.52]))
    assert curve.knee_up == pytest.approx(12.2)
    assert np.isnan(curve.knee_down)
    (curve,) = curves(_changed("height_change_fraction", [-0.4, -0.2, 0.0, 0.2], [0.4, 0.9, 1.0, 0.99]))
    assert curve.knee_down == pytest.approx(20.0)
    assert curve.knee_up == float("inf")


def test_knee_of_a_curve_that_starts_below() -> None:
    points = [AtSize(size, PooledRate(0, 1, share, 0.0, 1.0, 1, 0), 1, 0) for size, share in ((0.0, 0.5), (5.0, 1.0))]
    assert knee(points, 1.0) == 0.0


def test_changes_that_come_together_have_no_curve() -> None:
    frame = _changed("roll_deg", [0.0, 8.0, 12.0], [1.0, 0.9, 0.8]).assign(pitch_deg=5.0)
    assert curves(frame) == []


def test_map_errors_follow_their_drivers() -> None:
    rng = np.random.default_rng(4)
    n = 60
    frame = landing_frame(n).assign(
        baseline_fraction=rng.uniform(0.05, 0.5, n),
        texture=rng.uniform(0.1, 2.0, n),
        height_m=10.0,
        range_m=10.0,
        range_error_m=rng.normal(0.0, 0.1, n),
        slope_error_rms_deg=1.0,
    )
    frame["elevation_noise_m"] = 0.01 / frame["baseline_fraction"]
    frame["elevation_rms_m"] = np.abs(frame["range_error_m"])
    mapped = map_rows(_subject(frame))
    assert mapped is not None
    effects = {(one["driver"], one["error"]): one for one in MAP_EFFECTS.effects(mapped)}
    noise = effects["baseline over height", "elevation error rms without its plane (% of height)"]
    assert noise["rank_correlation"] == pytest.approx(-1.0)
    assert np.all(np.diff(noise["medians"]) < 0.0)
    scale = effects["altimeter's error (% of the range)", "elevation error rms (% of height)"]
    np.testing.assert_allclose(scale["centres"], scale["medians"])


def test_page_has_the_sections(make_run: Callable[..., Path]) -> None:
    directory = make_run(frame=landing_frame(40), requirements=[])
    page = write_report(directory)
    twin = json.loads((directory / "report.json").read_text(encoding="utf-8"))
    assert {"touchdown", "sites", "run-times"} <= set(twin["sections"])
    assert "0.89" in page.read_text(encoding="utf-8")
