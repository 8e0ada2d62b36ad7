"""Tests of `report.json`: it is read into the record that it was written from."""

import json
from typing import Any

import pytest

from marsyard.reports.campaign_report import write_report
from marsyard.reports.evaluation import evaluate_run
from marsyard.reports.report_file import read_report
from tests.reports.synthetic_run import MIN_COLUMNS, MakeRun, make_rows

pytestmark = pytest.mark.usefixtures("plain_figures")


@pytest.mark.parametrize(
    "options",
    [
        {"cases": 12},
        pytest.param({"cases": 400, "terrains": 60}, marks=pytest.mark.slow),
        pytest.param({"cases": 24, "n_crashed": 3}, marks=pytest.mark.slow),
        {"cases": 12, "answer_rate": 0.0},
        {"cases": 1},
        {"cases": 0},
    ],
)
def test_report_is_read_as_written(make_run: MakeRun, options: dict[str, Any]) -> None:
    rows = make_rows(**options | {"cases": max(1, options["cases"])}).head(options["cases"])
    directory = make_run(rows[[*MIN_COLUMNS, "terrain"]])
    write_report(directory)
    text = (directory / "report.json").read_text()
    report = read_report(text)
    assert report.to_json() == json.loads(text)
    evaluation = evaluate_run(directory)
    assert repr(report.verdicts) == repr(tuple(evaluation.verdicts))  # NaN is not equal to itself
    assert report.verdict == evaluation.overall_verdict.word


@pytest.mark.parametrize(("key", "value"), [("schema", 6), ("verdicts", [{"n": 1}]), ("cases", "many")])
def test_other_layouts_are_not_read(make_run: MakeRun, key: str, value: object) -> None:
    directory = make_run(make_rows(4)[MIN_COLUMNS])
    write_report(directory)
    content = json.loads((directory / "report.json").read_text())
    assert read_report(json.dumps(content)) is not None
    assert read_report(json.dumps(content | {key: value})) is None
    assert read_report("no JSON") is None
