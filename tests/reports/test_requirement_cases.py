"""Tests of the lists of violations by requirement, of their causes, and of the summaries of cases."""

import base64
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest

from marsyard.campaigns.definition.campaign_file import Requirement
from marsyard.campaigns.definition.margins import compute_margin
from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.dimes.presentation import DIMES
from marsyard.reports.evaluation import evaluate_run
from marsyard.reports.fieldtest.presentation import FIELD_TEST
from marsyard.reports.gallery import MAX_SHOWN_VIOLATIONS, gallery_cases
from marsyard.reports.hda.presentation import HDA
from marsyard.reports.images import thumbnail
from marsyard.reports.localisation.presentation import LOCALISATION
from marsyard.reports.populations import compute_margins
from marsyard.reports.presentation import Cause, Presentation
from marsyard.reports.requirement_cases import MAX_NEAREST, MAX_VIOLATIONS, CaseFinder
from marsyard.reports.vtt.presentation import VTT
from marsyard.reports.wording import label
from tests.reports.hda import synthetic_landing
from tests.reports.synthetic_run import VELOCITY, MakeRun, make_rows

ATTITUDE = {
    "velocity_error_m_s": 5.2,
    "attitude_error_common_deg": 0.1,
    "altitude_error_common": 0.0,
    "descent_rate_m_s": 75.0,
    "horizontal_speed_m_s": 20.0,
}
#: A triple of the field test: the attitude error changes between its images.
TRIPLE = {
    "velocity_error_m_s": 5.2,
    "attitude_velocity_error_m_s": 4.0,
    "altitude_2_m": 1700.0,
    "altitude_3_m": 1400.0,
    "altitude_error_2_m": 6.0,
    "altitude_error_3_m": 8.0,
    "velocity_true_x_m_s": 20.0,
    "velocity_true_y_m_s": 0.0,
}
#: Limits of the lander, and of an algorithm with a small threshold of roughness.
LIMITS = {"lander.max_slope_deg": 15.0, "lander.max_roughness_m": 0.2, "max_slope_deg": 15.0, "max_roughness_m": 0.05}
TOUCHDOWN = {"touchdown_slope_deg": 6.0, "touchdown_roughness_m": 0.3, "touchdown_error_m": 1.0}
AVAILABLE: Mapping[str, Any] = {"id": "A", "metric": "answered", "probability": 0.5, "confidence": 0.5}


def _make_finder(make_run: MakeRun, frame: pd.DataFrame, *requirements: Mapping[str, Any]) -> CaseFinder:
    evaluation = evaluate_run(make_run(frame, requirements))
    return CaseFinder(evaluation.run, evaluation.verdicts)


def test_stored_cases_have_a_preview_in_each_list(make_run: MakeRun, dimes_products: dict[str, Any]) -> None:
    frame = make_rows(6, answer_rate=0.0)
    evaluation = evaluate_run(make_run(frame, [AVAILABLE, {**AVAILABLE, "id": "B"}], products=dimes_products))
    for entry in CaseFinder(evaluation.run, evaluation.verdicts).requirement_cases():
        previews = {listed.case: listed.thumbnail for listed in entry.violations}
        assert previews == dict.fromkeys(range(6), "") | {3: thumbnail(dimes_products)}


def test_rows_without_numbers_have_no_listed_violations(make_run: MakeRun) -> None:
    finder = _make_finder(make_run, make_rows(30, answer_rate=0.5).drop(columns="case"), AVAILABLE)
    assert finder.violating_cases == finder.worst_violations(2) == finder.violations("A") == []


@pytest.mark.parametrize(
    "changes",
    [
        {"metric": "error_m", "bound": 1.5, "population": "valid"},
        {"metric": "error_m", "bound": 1.5, "scale": 2.0},
        {"metric": "error_m + other_m", "bound": 1.0, "population": "valid and flag"},
        {"metric": "flag", "margin": "margin"},
        {"metric": "flag", "population": "completed and answered"},
        {"metric": "answered"},
    ],
)
def test_margins_equal_those_of_the_engine(changes: Mapping[str, Any]) -> None:
    rng = np.random.default_rng(3)
    n = 200
    frame = pd.DataFrame(
        {
            "case": np.arange(n),
            "outcome": rng.choice(["VALID", "REFUSED", "CRASHED", "TIMED_OUT"], n),
            "answered": rng.random(n) < 0.7,
            "error_m": np.where(rng.random(n) < 0.2, np.nan, rng.normal(0.0, 1.5, n)),
            "other_m": rng.normal(0.0, 1.0, n),
            "flag": pd.Series([(True, False, None)[index] for index in rng.integers(0, 3, n)], dtype=object),
            "margin": np.where(rng.random(n) < 0.2, np.nan, rng.normal(0.0, 1.0, n)),
        }
    )
    requirement = {"id": "R", "probability": 0.9, "confidence": 0.9, **changes}
    (verdict,) = evaluate_requirements(frame, [requirement])
    margins = compute_margins(frame, verdict, changes.get("margin"))
    assert margins is not None
    rows: list[Any] = frame.astype(object).where(frame.notna(), None).to_dict("records")
    expected = [compute_margin(row, Requirement.model_validate(requirement)) for row in rows]
    np.testing.assert_allclose(margins, expected, atol=1e-11)
    assert min(expected) < 0.0 < max(expected)


def test_violations_are_listed_by_margin_with_the_nearest_cases(make_run: MakeRun) -> None:
    frame = make_rows(60, error_scale=4.0, n_crashed=1)
    (entry,) = _make_finder(make_run, frame, VELOCITY).requirement_cases()
    errors = frame["velocity_error_m_s"]
    violations = errors[errors > 5.0].sort_values(ascending=False)
    # the crashed case has no margin and precedes all others
    assert entry.n_violations == len(violations) + 1
    assert [listed.case for listed in entry.violations] == [59, *violations.index][:MAX_VIOLATIONS]
    nearest = errors[errors <= 5.0].sort_values(ascending=False).index[:MAX_NEAREST]
    assert [listed.case for listed in entry.nearest] == nearest.tolist()
    assert "the context is lost" in entry.violations[0].sentence
    worst = entry.violations[1]
    assert "limit 5 m/s" in worst.sentence
    assert worst.sentence.startswith("Velocity error ")
    assert not entry.nearest[0].violates


def test_equal_lists_are_not_repeated(make_run: MakeRun) -> None:
    stricter = {**VELOCITY, "id": "STRICT", "probability": 0.999}
    first, second, third = _make_finder(
        make_run, make_rows(60, error_scale=4.0), VELOCITY, stricter, AVAILABLE
    ).requirement_cases()
    assert (first.same_as, second.same_as, third.same_as) == ("", "DIMES-VEL", "")
    assert second.title.endswith("the same cases as DIMES-VEL")


def test_violations_are_grouped_by_outcome_and_cause(make_run: MakeRun) -> None:
    frame = make_rows(80, answer_rate=0.5)
    (entry,) = _make_finder(make_run, frame, AVAILABLE).requirement_cases()
    counts = frame.loc[~frame["answered"], "outcome"].value_counts()
    assert {row[0]: int(row[2]) for row in entry.groups.rows} == counts.to_dict()
    assert [int(row[2]) for row in entry.groups.rows] == sorted(counts, reverse=True)


def test_summary_has_results_percentiles_and_neighbours(make_run: MakeRun) -> None:
    frame = make_rows(60, error_scale=4.0)
    frame.loc[30, "off_nadir_max_deg"] = 50.0
    frame.loc[30, "outcome"] = "VALID"
    frame.loc[30, "answered"] = True
    frame.loc[30, "velocity_error_m_s"] = 7.5
    finder = _make_finder(make_run, frame, VELOCITY, AVAILABLE)
    summary = finder.summary(30)
    assert [(status.requirement_id, status.word) for status in summary.statuses] == [
        ("DIMES-VEL", "violated"),
        ("A", "met"),
    ]
    assert summary.statuses[0].margin == "−2.500 m/s"
    driver = summary.drivers[0]
    assert driver.value == "50.00"
    assert driver.percentile == pytest.approx(59.5 / 60)
    cases = finder.violating_cases
    position = cases.index(30)
    assert (summary.previous, summary.following) == (cases[position - 1], cases[position + 1])
    assert 30 not in summary.similar
    assert set(summary.similar) <= set(cases)
    assert finder.summary(1000) is None


def test_conditions_of_a_landing_contain_no_results(make_run: MakeRun) -> None:
    frame = synthetic_landing.landing_frame(30).assign(answered=True)
    rng = np.random.default_rng(1)
    results = ["footprints_roughness_below_1_unflagged", "gross_hazards_unflagged", "tracks", "points", "inliers"]
    conditions = ["sun_elevation_deg", "pose_tilt_error_deg", "image_contrast"]
    frame = frame.assign(**{name: rng.random(len(frame)) for name in (*results, *conditions)})
    evaluation = evaluate_run(make_run(frame, [AVAILABLE], definition={"scenario": "landing"}, scenario="landing"))
    summary = CaseFinder(evaluation.run, evaluation.verdicts).summary(0)
    assert {driver.name for driver in summary.drivers} >= {label(name) for name in conditions}
    results += [str(name) for name in frame if str(name).startswith(("footprints", "gross"))]
    assert not {driver.name for driver in summary.drivers} & {label(name) for name in results}
    # the other sections and the explorer use the same selection
    assert set(evaluation.run.driver_columns("", 1000)) <= {name for name in frame if name not in results}


def test_percentiles_exist_in_runs_of_few_cases(make_run: MakeRun) -> None:
    frame = make_rows(8)
    frame["off_nadir_max_deg"] = [3.0, 1.0, 2.0, 7.0, 4.0, 5.0, 6.0, 8.0]
    finder = _make_finder(make_run, frame, VELOCITY)
    summaries = [finder.summary(case) for case in range(8)]
    texts = [
        next(driver.percentile_text for driver in summary.drivers if driver.name == label("off_nadir_max_deg"))
        for summary in summaries
        if summary is not None
    ]
    # mid-ranks of 8 values: (rank - 0.5) / 8
    assert texts == ["31", "6", "19", "81", "44", "56", "69", "94"]
    assert {summary.cases for summary in summaries if summary is not None} == {8}
    # no value of so few cases is outside of the central 95 %
    assert not [
        listed for entry in finder.requirement_cases() for listed in entry.nearest if "cases)" in listed.sentence
    ]


def test_similar_violations_have_the_nearest_conditions(make_run: MakeRun) -> None:
    frame = make_rows(60)
    frame["velocity_error_m_s"] = 1.0
    frame["answered"] = True
    drivers = ["sun_elevation_deg", "horizontal_speed_m_s", "altitude_1_m", "off_nadir_max_deg"]
    for case, value in ((10, 1.0), (20, 1.001), (40, 1e3)):
        for driver in drivers:
            frame.loc[case, driver] = value
        frame.loc[case, "velocity_error_m_s"] = 9.0
    summary = _make_finder(make_run, frame, VELOCITY).summary(10)
    assert list(summary.similar) == [20, 40]


def test_violations_precede_other_cases_of_the_gallery(make_run: MakeRun) -> None:
    evaluation = evaluate_run(make_run(make_rows(60, error_scale=4.0), [VELOCITY]))
    run = replace(evaluation.run, stored_cases=tuple(range(60)))
    violations = CaseFinder(run, evaluation.verdicts).worst_violations(2)
    assert len(violations) == 2
    assert gallery_cases(run, violations)[:2] == violations


def test_gallery_with_the_maximum_of_violations_adds_only_the_shown_case(make_run: MakeRun) -> None:
    evaluation = evaluate_run(make_run(make_rows(60, error_scale=4.0), [VELOCITY]))
    run = replace(evaluation.run, stored_cases=(7, *(case for case in range(60) if case != 7)))
    assert run.shown_case == 7
    violations = list(range(10, 10 + MAX_SHOWN_VIOLATIONS))
    assert gallery_cases(run, violations) == [*violations, 7]
    assert len(gallery_cases(run, violations[1:])) > len(violations)


def test_thumbnail_shows_the_last_image() -> None:
    image = np.zeros((100, 200), dtype=np.uint16)
    image[:, 100:] = 4000
    data = thumbnail({"image_1": image[:, ::-1], "image_2": image, "map": np.zeros((90, 90)), "text": "a"})
    head, encoded = data.split(",")
    assert head == "data:image/jpeg;base64"
    grey = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    assert grey[:, :40].mean() < 20.0
    assert grey[:, 60:].mean() > 235.0
    assert thumbnail({"heights": np.zeros((100, 100))}) == ""


@pytest.mark.parametrize(
    ("presentation", "row", "metric", "name"),
    [
        (DIMES, {**ATTITUDE, "attitude_error_common_deg": 4.0}, "velocity_error_m_s", "attitude error"),
        (DIMES, {**ATTITUDE, "altitude_error_common": 0.2}, "velocity_error_m_s", "altitude error"),
        (DIMES, ATTITUDE, "velocity_error_m_s", "images"),
        (DIMES, {"velocity_error_m_s": math.nan}, "velocity_error_m_s", None),
        (DIMES, {}, "answered", None),
        (HDA, {**LIMITS, "site_slope_deg": 16.0, "site_roughness_m": 0.1}, "site_safe", "slope"),
        (HDA, {**LIMITS, **TOUCHDOWN}, "touchdown_safe", "roughness"),
        (HDA, {"site_slope_deg": math.nan}, "site_safe", None),
        (HDA, {"converged": False, "tracks": 3, "features": 80}, "converged", "few tracks"),
        (DIMES, {**ATTITUDE, "descent_rate_m_s": np.nan}, "velocity_error_m_s", None),
        # the propagation to the firing removes a part of an attitude error's effect
        (DIMES, {**ATTITUDE, "firing_velocity_error_m_s": 0.2}, "firing_velocity_error_m_s", None),
        (FIELD_TEST, TRIPLE, "velocity_error_m_s", "attitude error"),
        (FIELD_TEST, {**TRIPLE, "attitude_velocity_error_m_s": 1.0}, "velocity_error_m_s", "images"),
        (
            FIELD_TEST,
            {**TRIPLE, "attitude_velocity_error_m_s": 1.0, "altitude_error_2_m": 600.0},
            "velocity_error_m_s",
            "altitude error",
        ),
        (FIELD_TEST, {"velocity_error_m_s": 5.2}, "velocity_error_m_s", None),
        (HDA, {"converged": True}, "site_reported", None),
        (VTT, {"range_error_m": -0.04, "cross_error_m": 0.01, "drift_px": 1.0}, "position_error_m", "range"),
        (VTT, {"range_error_m": 0.01, "cross_error_m": -0.04, "drift_px": 1.0}, "position_error_m", "direction"),
        (VTT, {"rover_shadow_on_target": True, "obliquity_max_deg": 70.0}, "answered", "shadow of the mast"),
        (VTT, {"obliquity_max_deg": 70.0, "slip_max": 0.1}, "no_false_track", "oblique face"),
        (VTT, {"obliquity_max_deg": 40.0, "slip_max": 0.1}, "answered", "not identified"),
        (VTT, {}, "handed", None),
        (LOCALISATION, {"inliers_median": 5.0, "sun_difference_deg": 50.0}, "position_error_m", "few landmarks"),
        (LOCALISATION, {"inliers_median": 80.0, "sun_difference_deg": 50.0}, "position_error_m", "biased landmarks"),
        (LOCALISATION, {}, "image_time_max_s", None),
    ],
)
def test_causes_follow_from_the_rows(
    presentation: Presentation, row: Mapping[str, Any], metric: str, name: str | None
) -> None:
    assert presentation.explain is not None
    cause = presentation.explain(row, metric)
    assert (None if cause is None else cause.name) == name
    assert cause is None or (isinstance(cause, Cause) and cause.detail)


@pytest.mark.parametrize(("sampled", "name"), [({}, "slope"), ({"lander.max_slope_deg": 30.0}, "roughness")])
def test_cause_of_an_unsafe_site_follows_from_the_lander_limits(
    make_run: MakeRun, sampled: Mapping[str, float], name: str
) -> None:
    """The slope is twice the lander's limit in the file, the roughness 1.5 times; the algorithm's ratio is reversed."""
    frame = synthetic_landing.landing_frame(100).assign(
        site_slope_deg=16.0, site_roughness_m=0.45, max_slope_deg=20.0, max_roughness_m=0.05, **sampled
    )
    safe = {"id": "S", "metric": "site_safe", "probability": 0.5, "confidence": 0.5, "population": "site_reported"}
    parameters = {"lander": {"max_slope_deg": 8.0, "max_roughness_m": 0.3}}
    definition = {"name": "hda-threshold", "scenario": "landing", "requirements": [safe], "parameters": parameters}
    evaluation = evaluate_run(make_run(frame, [safe], definition=definition, scenario="landing"))
    (entry,) = CaseFinder(evaluation.run, evaluation.verdicts).requirement_cases()
    assert entry.n_violations > 0
    assert {row[1] for row in entry.groups.rows} == {name}
