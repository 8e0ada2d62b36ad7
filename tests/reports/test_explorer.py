"""Tests of the explorer (the interactive scatter plot), of the gallery (cases on the page) and of its candidates."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from marsyard.reports.explorer import MAX_POINTS, ExploredRequirement, choose_points, explorer_data
from marsyard.reports.gallery import gallery_candidates, gallery_cases
from marsyard.reports.page_environment import embed_json
from marsyard.reports.stored import read_run
from tests.reports.synthetic_run import make_rows

METRIC = "velocity_error_m_s"


def test_points_include_worst_unanswered_and_crashed_cases() -> None:
    frame = make_rows(12_000, n_crashed=3)
    points = choose_points(frame, METRIC)
    assert points.size == MAX_POINTS
    assert np.all(np.diff(points) > 0)
    assert int(np.nanargmax(frame[METRIC])) in points
    assert {11_997, 11_998, 11_999} <= set(points.tolist())
    assert frame.iloc[points]["outcome"].nunique() == frame["outcome"].nunique()
    # violations are kept, also if they are neither large nor among the first cases
    is_violation = np.arange(len(frame)) == 9_000
    assert 9_000 in choose_points(frame, METRIC, is_violation)
    assert 9_000 not in points
    assert choose_points(frame.head(50), METRIC).tolist() == list(range(50))


def test_explorer_data_contain_labels_outcomes_and_values(make_run: Callable[..., Path]) -> None:
    frame = make_rows(30, n_crashed=1)
    run = read_run(make_run(frame))
    status = np.where(np.arange(30) == 4, 1, 0)
    requirement = ExploredRequirement("DIMES-VEL", METRIC, 5.0, status)
    data = explorer_data(run, METRIC, [requirement], ["3"])
    assert [data["labels"][index] for index in data["axes"][0]] == [
        "east velocity error (m/s)",
        "north velocity error (m/s)",
    ]
    assert (data["cases"], data["with_images"], data["shown"], data["all"]) == (list(range(30)), [3], 30, 30)
    # every column of varying numbers is explored
    assert {"sun elevation (deg)", "off nadir max (deg)", "wall time (s)"} & set(data["labels"])
    (explored,) = data["requirements"]
    assert (explored["column"], explored["bound"], explored["status"]) == (data["metric"], 5.0, status.tolist())
    assert data["outcomes"][data["outcome"][29]] == "CRASHED"
    assert data["columns"][data["metric"]][29] is None
    first_error = frame[METRIC].iloc[0]
    assert data["columns"][data["metric"]][0] == (None if np.isnan(first_error) else float(f"{first_error:.4g}"))


def test_embedded_data_are_escaped() -> None:
    hostile = {"</script><script>alert(1)//": "<!--\u2028&"}
    text = str(embed_json(hostile))
    assert not set("<>&\u2028") & set(text)
    assert json.loads(text) == hostile


def test_gallery_candidates_are_worst_unanswered_and_random_cases(make_run: Callable[..., Path]) -> None:
    frame = make_rows(60, n_crashed=2)
    cases = gallery_candidates(read_run(make_run(frame)))
    errors = frame["velocity_error_m_s"]
    assert cases[:2] == errors.nlargest(2).index.tolist()
    unanswered_cases = frame.index[errors.isna() & ~frame["outcome"].eq("CRASHED")].tolist()
    assert cases[2:4] == unanswered_cases[:2]
    # two worst, two unanswered and two random cases
    assert len(cases) == len(set(cases)) == 6
    assert not set(cases) & set(frame.index[frame["outcome"].eq("CRASHED")])
    assert gallery_candidates(read_run(make_run(frame.head(0), name="none"))) == []


def test_gallery_starts_with_first_worst_and_unanswered_cases(make_run: Callable[..., Path]) -> None:
    frame = make_rows(40)
    run = replace(read_run(make_run(frame)), stored_cases=(7, *(case for case in range(40) if case != 7)))
    cases = gallery_cases(run)
    assert cases[0] == 7
    # the selected case, two worst, two unanswered and two random cases
    assert len(cases) == len(set(cases)) == 7
    worst_cases = frame[METRIC].drop(7).sort_values(ascending=False).index[:2]
    assert cases[1:3] == worst_cases.tolist()
    assert frame[METRIC].iloc[cases[3:5]].isna().all()
    assert gallery_cases(replace(run, stored_cases=(7,))) == [7]
    assert gallery_cases(replace(run, stored_cases=())) == []
