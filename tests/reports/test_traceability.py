from __future__ import annotations

import csv
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import pandas as pd

from marsyard.reports.campaign import write_report
from marsyard.reports.evaluation import overall
from marsyard.reports.traceability import COLUMNS, evidence_of, junit_xml, verification_csv
from marsyard.reports.verdicts import judge_campaign

Rows = Callable[..., pd.DataFrame]
HOSTILE = '=HYPERLINK("x")\x00<&>'


def _undecided(velocity: dict[str, Any]) -> dict[str, Any]:
    return {**velocity, "id": "UNDECIDED", "probability": 0.9999}


def test_matrix_has_a_row_for_each_requirement(make_rows: Rows, velocity: dict[str, Any]) -> None:
    frame = make_rows(40)
    stated = {**velocity, "source": "the paper", "kind": "requirement"}
    verdicts = judge_campaign(frame, [stated, {**velocity, "id": HOSTILE, "statement": HOSTILE, "metric": "nonesuch"}])
    first, second = csv.DictReader(io.StringIO(verification_csv(evidence_of("dimes", verdicts))))
    assert tuple(first) == COLUMNS
    assert (first["requirement"], first["kind"], first["source"]) == ("DIMES-VEL", "requirement", "the paper")
    assert (first["campaign"], first["verdict"], first["bound"]) == ("dimes", str(verdicts[0].status), "5")
    assert int(first["cases"]) == verdicts[0].n
    assert float(first["lower_bound"]) == float(f"{verdicts[0].lower:.9g}")
    # What a spreadsheet would take for a formula is a text.
    assert second["statement"].startswith("'=")
    assert second["lower_bound"] == ""


def _message(case: Xml.Element, result: str) -> str:
    found = case.find(result)
    assert found is not None
    return found.get("message", "")


def test_junit_tells_failures_and_what_is_open(make_rows: Rows, velocity: dict[str, Any]) -> None:
    frame = make_rows(40, crashed=2, terrains=10_000)
    # 32 of 34, with the crashed cases as failures, still reach the rate, and no bound does
    by_rate = {**velocity, "id": "RATE", "probability": 0.94, "decide_by": "estimate"}
    asked = [
        {**velocity, "bound": 0.01, "id": "FAILS"},
        _undecided(velocity),
        {**velocity, "probability": 0.5},
        by_rate,
    ]
    verdicts = judge_campaign(frame, asked)
    suite = Xml.fromstring(junit_xml(HOSTILE, verdicts, overall(verdicts, frame)))  # noqa: S314
    assert (suite.get("tests"), suite.get("failures"), suite.get("skipped")) == ("5", "2", "2")
    fails, undecided, passes, met, ended = suite
    assert _message(met, "skipped").startswith("MET BY RATE: ")
    assert fails.find("failure") is not None
    assert "INSUFFICIENT" in _message(undecided, "skipped")
    assert [child.tag for child in passes] == ["system-out"]
    assert _message(ended, "failure") == "2 cases crashed"


def test_a_report_leaves_its_twins(make_rows: Rows, make_run: Callable[..., Path]) -> None:
    directory = make_run(make_rows(24)[["case", "outcome", "answered", "velocity_error_m_s"]])
    write_report(directory)
    assert (directory / "verification.csv").read_text().startswith("requirement,statement,")
    assert Xml.parse(directory / "junit.xml").getroot().get("name") == "dimes-synthetic"  # noqa: S314
