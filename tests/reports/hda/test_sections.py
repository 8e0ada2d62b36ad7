"""Tests of the report sections on landings with rows of known statistics."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from marsyard.reports.campaign_report import write_report
from marsyard.reports.effects import estimate_effects
from marsyard.reports.hda.landing_cases import PAPER
from marsyard.reports.hda.limits_section import SizeResult, find_knee, tracking_curves
from marsyard.reports.hda.paper_sections import run_times_section, touchdown_section
from marsyard.reports.hda.sections import (
    FAULT_OUTCOMES,
    MAP_CONDITIONS,
    MAP_ERRORS,
    faults_section,
    map_rows,
    map_section,
    threshold_section,
)
from marsyard.reports.hda.sites_section import (
    count_hazard_classes,
    create_class_blocks,
    distance_grid,
    hazard_distances,
    outcome_counts,
    site_fractions,
)
from marsyard.reports.rates import PooledRate, pooled_rate
from marsyard.reports.section import drop_empty_columns
from tests.reports.hda.synthetic_landing import landing_frame
from tests.reports.synthetic_run import make_subject


def test_rates_pool_footprints_over_flights() -> None:
    frame = pd.DataFrame({"hazardous": [1, 0, 3, 0], "footprints": [10, 10, 20, 0]})
    rate = pooled_rate(frame, "hazardous", "footprints")
    assert (rate.hits, rate.total, rate.flights, rate.flights_hit) == (4, 40, 3, 2)
    assert rate.fraction == pytest.approx(0.1)
    assert rate.lower < 0.1 < rate.upper


def test_pooled_rate_interval_covers_the_true_rate() -> None:
    """90 % intervals cover the true rate of 10 %, although flights have different rates."""
    rng = np.random.default_rng(3)
    n_covering = 0
    for _ in range(60):
        rates = rng.beta(1.0, 9.0, 40)
        frame = pd.DataFrame({"hazardous": rng.binomial(500, rates), "footprints": np.full(40, 500)})
        rate = pooled_rate(frame, "hazardous", "footprints")
        n_covering += rate.lower <= 0.1 <= rate.upper
    assert n_covering >= 45  # binomial(60, 0.9): mean 54, standard deviation 2.3


def test_rate_of_zero_has_no_bootstrap_interval() -> None:
    rate = pooled_rate(pd.DataFrame({"hazardous": [0, 0], "footprints": [10, 10]}), "hazardous", "footprints")
    assert rate.fraction == 0.0
    assert np.isnan(rate.upper)


def test_run_times_are_scaled_to_the_sum_of_table_1() -> None:
    section = run_times_section(make_subject(landing_frame(20)))
    assert section.data["cases"] == 20
    times = section.data["stages"]
    # Table 1 of the paper: 0.77 s in total
    assert sum(entry["scaled_s"] for entry in times) == pytest.approx(0.77)
    # the stages of the synthetic rows take 6 + 4 + 6 + 1 ms
    assert section.data["factor"] == pytest.approx(0.77 / 0.017)
    assert [entry["parameters"] for entry in times] == ["70 features", "60 tracks", "600 points", "19x27 terrain map"]
    assert sum(stage["seconds"] for stage in PAPER["stages"]) < 1.0  # "less than one second"


def test_touchdown_errors_are_compared_with_table_2() -> None:
    frame = landing_frame(200)
    section = touchdown_section(make_subject(frame))
    landings = frame[frame["landed"]]
    assert section.data["landings"] == len(landings)
    assert section.data["mean_m"]["touchdown_error_gps_m"] == pytest.approx(landings["touchdown_error_gps_m"].mean())
    # landings 1, 3 and 4 of Table 2
    assert section.data["paper_m"] == {"1": 1.21, "3": 1.20, "4": 0.89}
    assert any(
        "Fit, not validation: fitted to these data are averaging_after_s" in block.note for block in section.blocks
    )
    assert np.mean([run["error_m"] for run in PAPER["landings"]]) == pytest.approx(1.1)
    assert touchdown_section(make_subject(frame.assign(landed=False))) is None


def test_reported_sites_are_scored_against_the_truth() -> None:
    frame = landing_frame(400)
    rates = site_fractions(frame)
    safe = rates["reported sites that are truly safe"]
    assert (safe.n, safe.hits) == (frame["site_reported"].sum(), (frame["site_reported"] & frame["site_safe"]).sum())
    assert rates["answer 'no safe site' if no safe site exists"].fraction == 1.0
    counts = outcome_counts(frame)
    assert sum(sum(row.values()) for row in counts.values()) == len(frame)
    assert counts["no safe site"]["'no safe site'"] == (frame["outcome"] == "NO_SAFE_SITE").sum()


def test_crashed_flights_are_counted_as_not_finished() -> None:
    frame = landing_frame(10)
    unknown_columns = ["site_reported", "site_safe", "no_site_reported", "answered"]
    frame = frame.astype(dict.fromkeys([*unknown_columns, "wide_site_exists"], object))
    frame.loc[0, unknown_columns] = None
    frame.loc[0, "wide_site_exists"] = True
    assert sum(row["crashed"] for row in outcome_counts(frame).values()) == 1


def test_hazard_classes_have_their_limits_and_rates() -> None:
    classes = count_hazard_classes(landing_frame(10))
    assert {hazard_class.kind for hazard_class in classes[:5]} == {"roughness"}
    assert [hazard_class.low for hazard_class in classes[:5]] == [0.0, 1.0, 1.5, 2.0, 3.0]
    assert [hazard_class.high for hazard_class in classes[:5]] == [1.0, 1.5, 2.0, 3.0, float("inf")]
    # 3 of 100 footprints of the class are reported as safe
    assert classes[1].called_safe.fraction == pytest.approx(0.03)
    assert classes[4].unflagged.fraction == 0.0


def test_distance_to_hazards_is_0_on_unsafe_ground() -> None:
    """Positions without a hazard in the area count as farther than all distances."""
    frame = landing_frame(4).assign(site_reported=[True, True, True, False], landed=True)
    frame = frame.assign(site_safe=[True, False, True, False], touchdown_safe=[False, True, True, True])
    frame["site_hazard_distance_m"] = [0.5, 0.08, np.inf, np.nan]
    frame["touchdown_hazard_distance_m"] = [0.04, 0.3, np.inf, np.nan]
    distances = hazard_distances(frame)
    np.testing.assert_array_equal(distances["reported site"].distances_m, [0.5, 0.0, np.inf])
    np.testing.assert_array_equal(distances["true touchdown"].distances_m, [0.0, 0.3, np.inf])
    grid = drop_empty_columns(distance_grid(distances))
    # three values have no quantiles
    assert [row[1:] for row in grid.rows] == [["3", "1", "1", "0"], ["3", "1", "1", "0"]]


def test_bound_of_the_distance_to_hazards_allows_for_shared_terrains() -> None:
    frame = landing_frame(60).assign(landed=True, site_reported=True, site_safe=True, touchdown_safe=True)
    frame["site_hazard_distance_m"] = np.linspace(1.0, 2.0, 60)
    frame["touchdown_hazard_distance_m"] = np.nan
    # 60 values have a lower bound of the 5 % quantile at 90 % confidence: 0.95^60 = 0.05; two terrains have none
    bounds = [
        distance_grid(hazard_distances(frame.assign(terrain=terrains))).rows[0][-1]
        for terrains in (np.arange(60), np.arange(60) % 2)
    ]
    assert bounds == ["1.000", "–"]


def test_only_hazards_are_in_the_table_of_missed_hazards() -> None:
    frame = landing_frame(10)
    blocks = create_class_blocks(frame)
    assert [row[1] for row in blocks[0].grid.rows] == 2 * ["1 to 1.5", "1.5 to 2", "2 to 3", "> 3"]
    # 400 of 1000 footprints are classified as safe, 2 of them are unsafe; 600 are truly safe
    rightly_safe = blocks[-1].data["rates"]["truly safe footprints that are classified as safe"]
    assert (rightly_safe.hits, rightly_safe.total) == (3980, 6000)
    assert blocks[0].figures
    hits = [str(name) for name in frame if str(name).endswith(("_safe", "_unflagged"))]
    assert not create_class_blocks(frame.assign(**dict.fromkeys(hits, 0)))[0].figures


def test_rates_are_reported_per_roughness_threshold() -> None:
    frame = landing_frame(40).assign(max_roughness_m=np.tile([0.1, 0.2], 20), false_alarms=np.tile([120, 30], 20))
    section = threshold_section(make_subject(frame))
    low, high = section.data["thresholds"]
    assert (low["max_roughness_m"], high["max_roughness_m"]) == (0.1, 0.2)
    assert (low["false_alarms"].fraction, high["false_alarms"].fraction) == (pytest.approx(0.2), pytest.approx(0.05))
    assert low["missed"].fraction == pytest.approx(8 / 400)
    assert threshold_section(make_subject(landing_frame(40))) is None


def test_faults_are_grouped_by_kind_and_size() -> None:
    frame = landing_frame(60)
    frame["fault"] = np.repeat(["none", "laser_stuck", "laser_silent"], 20)
    frame["fault_size"] = np.concatenate([np.zeros(20), np.tile([0.05, 1.0], 10), np.ones(20)])
    rows = FAULT_OUTCOMES.records(frame)
    assert [(row["fault"], row["size"], row["n"]) for row in rows] == [
        ("none", 0.0, 20),
        ("laser_silent", 1.0, 20),
        ("laser_stuck", 0.05, 10),
        ("laser_stuck", 1.0, 10),
    ]
    result_columns = ("safe", "refused", "unconverged", "wrong", "unfinished")
    assert all(sum(row[column] for column in result_columns) == row["n"] for row in rows)
    assert sum(row["wrong"] for row in rows) == (frame["site_reported"] & ~frame["site_safe"]).sum()
    assert faults_section(make_subject(landing_frame(20))) is None


def _make_motion_rows(column: str, sizes: list[float], fractions: list[float]) -> pd.DataFrame:
    """Return flights with one motion change each; `fractions` of their 100 visible features are tracked.

    The knee of the curve is the change at which the fraction falls to 90 % of that without change.
    """
    frame = landing_frame(len(sizes)).assign(roll_deg=0.0, pitch_deg=0.0, yaw_deg=0.0, height_change_fraction=0.0)
    frame[column] = sizes
    return frame.assign(features_in_view=100, tracks_correct=100.0 * np.array(fractions), tracked_well=True)


def test_knee_is_at_90_percent_of_the_curve() -> None:
    (curve,) = tracking_curves(_make_motion_rows("roll_deg", [0.0, 8.0, 12.0, 16.0], [1.0, 0.96, 0.92, 0.52]))
    # linear interpolation between 0.92 at 12 deg and 0.52 at 16 deg
    assert curve.knee_up == pytest.approx(12.2)
    assert np.isnan(curve.knee_down)
    (curve,) = tracking_curves(
        _make_motion_rows("height_change_fraction", [-0.4, -0.2, 0.0, 0.2], [0.4, 0.9, 1.0, 0.99])
    )
    assert curve.knee_down == pytest.approx(20.0)
    assert curve.knee_up == float("inf")


def test_knee_is_0_if_the_curve_starts_below_90_percent() -> None:
    points = [
        SizeResult(size, PooledRate(0, 1, fraction, 0.0, 1.0, 1, 0), 1, 0)
        for size, fraction in ((0.0, 0.5), (5.0, 1.0))
    ]
    assert find_knee(points, 1.0) == 0.0


def test_combined_changes_have_no_curve() -> None:
    frame = _make_motion_rows("roll_deg", [0.0, 8.0, 12.0], [1.0, 0.9, 0.8]).assign(pitch_deg=5.0)
    assert tracking_curves(frame) == []


def test_map_errors_have_the_expected_rank_correlations() -> None:
    rng = np.random.default_rng(4)
    cases = 60
    frame = landing_frame(cases).assign(
        baseline_fraction=rng.uniform(0.05, 0.5, cases),
        texture=rng.uniform(0.1, 2.0, cases),
        height_m=10.0,
        range_m=10.0,
        range_error_m=rng.normal(0.0, 0.1, cases),
        slope_error_rms_deg=1.0,
    )
    frame["elevation_noise_m"] = 0.01 / frame["baseline_fraction"]
    frame["elevation_rms_m"] = np.abs(frame["range_error_m"])
    mapped_rows = map_rows(make_subject(frame))
    assert mapped_rows is not None
    effects = {
        (effect.condition, effect.response): effect
        for effect in estimate_effects(mapped_rows, MAP_CONDITIONS, MAP_ERRORS)
    }
    noise = effects["baseline / height", "elevation noise (% of height)"]
    assert noise.rank_correlation == pytest.approx(-1.0)
    assert np.all(np.diff(noise.medians) < 0.0)
    scale_error = effects["|altimeter error| (% of range)", "elevation error (% of height)"]
    np.testing.assert_allclose(scale_error.centres, scale_error.medians)


@pytest.mark.parametrize(("maps", "has_statistics"), [(12, False), (40, True)])
def test_quantiles_and_correlations_need_20_maps(maps: int, has_statistics: bool) -> None:
    rng = np.random.default_rng(4)
    columns = ("baseline_fraction", "texture", "elevation_noise_m", "elevation_rms_m", "slope_error_rms_deg")
    values = {name: rng.uniform(0.1, 1.0, maps) for name in columns}
    section = map_section(make_subject(landing_frame(maps).assign(height_m=10.0, **values)))
    errors, effects = section.blocks
    assert list(errors.grid.head[1:]) == (
        ["Minimum", "5 %", "Median", "95 %", "Maximum"] if has_statistics else ["Minimum", "Median", "Maximum"]
    )
    assert (effects.grid is not None) == has_statistics
    assert ("Lines are medians" in effects.figures[0].caption) == has_statistics


@pytest.mark.usefixtures("plain_figures")
def test_page_and_json_have_the_sections(make_run: Callable[..., Path]) -> None:
    directory = make_run(frame=landing_frame(40), requirements=[])
    page = write_report(directory)
    report = json.loads((directory / "report.json").read_text(encoding="utf-8"))
    assert {"touchdown", "sites", "run-times"} <= set(report["sections"])
    assert "0.89" in page.read_text(encoding="utf-8")
