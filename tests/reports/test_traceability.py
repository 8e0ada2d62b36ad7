"""Tests of the verification matrix (CSV) and of the JUnit file."""

import csv
import io
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as Xml

import pytest

from marsyard.reports.campaign_report import write_report
from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.overall import combine_verdicts
from marsyard.reports.verdict_files import COLUMNS, junit_xml, requirement_evidence, verification_csv
from tests.reports.synthetic_run import MIN_COLUMNS, VELOCITY, make_rows

pytestmark = pytest.mark.usefixtures("plain_figures")
#: Text that a spreadsheet would evaluate and XML cannot contain.
HOSTILE = '=HYPERLINK("x")\x00<&>'


def test_matrix_has_one_row_per_requirement() -> None:
    frame = make_rows(40)
    requirement = {**VELOCITY, "source": "the paper", "kind": "requirement"}
    verdicts = evaluate_requirements(
        frame, [requirement, {**VELOCITY, "id": HOSTILE, "statement": HOSTILE, "metric": "no_such_column"}]
    )
    first, second = csv.DictReader(io.StringIO(verification_csv(requirement_evidence("dimes", verdicts))))
    assert tuple(first) == COLUMNS
    assert (first["requirement"], first["kind"], first["source"]) == ("DIMES-VEL", "requirement", "the paper")
    assert (first["campaign"], first["verdict"], first["bound"]) == ("dimes", str(verdicts[0].status), "5")
    assert int(first["cases"]) == verdicts[0].n
    assert float(first["lower_bound"]) == float(f"{verdicts[0].lower:.9g}")
    # a leading "=" is escaped: a spreadsheet program would evaluate it as a formula
    assert second["statement"].startswith("'=")
    assert second["lower_bound"] == ""


def _read_message(case: Xml.Element, result: str) -> str:
    """Return the message of a JUnit test case with this result, `failure` or `skipped`."""
    element = case.find(result)
    return element.get("message", "")


def test_junit_lists_failures_and_undecided_requirements() -> None:
    frame = make_rows(40, n_crashed=2, terrains=10_000)
    # 32 of 34 cases succeed (crashed cases are failures): the rate meets 94 %, its lower bound does not
    by_rate = {**VELOCITY, "id": "RATE", "probability": 0.94, "decide_by": "estimate"}
    requirements = [
        {**VELOCITY, "bound": 0.01, "id": "FAILS"},
        {**VELOCITY, "id": "UNDECIDED", "probability": 0.9999},
        {**VELOCITY, "probability": 0.5},
        by_rate,
    ]
    verdicts = evaluate_requirements(frame, requirements)
    suite = Xml.fromstring(junit_xml(HOSTILE, verdicts, combine_verdicts(verdicts, frame)))  # noqa: S314
    assert (suite.get("tests"), suite.get("failures"), suite.get("skipped")) == ("5", "2", "2")
    failing_case, undecided_case, passing_case, met_by_rate_case, completion_case = suite
    assert _read_message(met_by_rate_case, "skipped").startswith("MET BY RATE: ")
    assert failing_case.find("failure") is not None
    assert "INSUFFICIENT" in _read_message(undecided_case, "skipped")
    assert [child.tag for child in passing_case] == ["system-out"]
    assert _read_message(completion_case, "failure") == "2 cases crashed"


def test_junit_skips_the_completion_of_an_unfinished_campaign(make_run: Callable[..., Path]) -> None:
    directory = make_run(make_rows(8)[MIN_COLUMNS], [], state="interrupted")
    write_report(directory)
    (completion_case,) = Xml.parse(directory / "junit.xml").getroot()  # noqa: S314
    assert _read_message(completion_case, "skipped") == "INSUFFICIENT: the campaign is not finished"


def test_junit_states_that_no_case_gives_no_lower_bound() -> None:
    frame = make_rows(0)
    verdicts = evaluate_requirements(frame, [VELOCITY])
    suite = Xml.fromstring(junit_xml(HOSTILE, verdicts, combine_verdicts(verdicts, frame)))  # noqa: S314
    assert "0 of 0 failed; no lower bound, required 0.99" in _read_message(suite[0], "skipped")


def test_report_writes_matrix_and_junit_files(make_run: Callable[..., Path]) -> None:
    directory = make_run(make_rows(8)[MIN_COLUMNS])
    write_report(directory)
    assert (directory / "verification.csv").read_text().startswith("requirement,statement,")
    assert Xml.parse(directory / "junit.xml").getroot().get("name") == "dimes-synthetic"  # noqa: S314
