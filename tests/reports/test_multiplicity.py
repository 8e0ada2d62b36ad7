"""Tests of the statement on several requirements: expected number of false PASSes, and where it is shown."""

from pathlib import Path

import pytest
from rich.console import Console

from marsyard.cli.outcome import evaluate_and_report
from marsyard.reports.dashboard.site import write_site
from marsyard.reports.overall import multiplicity_text
from marsyard.reports.verdicts import Verdict
from tests.reports.synthetic_run import MIN_COLUMNS, VELOCITY, MakeRun, make_rows


def _make_verdict(confidence: float, decide_by: str = "confidence", n: int = 100) -> Verdict:
    return Verdict("R", "", "error_m", 1.0, 0.95, confidence, "all", decide_by=decide_by, n=n)


def test_risks_of_requirements_are_added() -> None:
    assert multiplicity_text([]) == multiplicity_text([_make_verdict(0.9)]) == ""
    text = multiplicity_text([_make_verdict(0.9), _make_verdict(0.9), _make_verdict(0.95)])
    assert text.startswith("3 requirements are decided at a confidence: if none is met, up to 0.25 false PASSes")
    assert text.endswith("Their PASSes hold together with at least 75 % confidence.")
    # requirements without a verdict at a confidence have no risk of a false PASS
    others = [_make_verdict(0.9, "estimate"), _make_verdict(0.9, n=0), _make_verdict(float("nan")), _make_verdict(1.5)]
    assert multiplicity_text([*others, _make_verdict(0.9)]) == ""
    assert multiplicity_text([*others, _make_verdict(0.9), _make_verdict(0.9)]).startswith("2 requirements")
    assert multiplicity_text([_make_verdict(0.9)] * 10).endswith("A single PASS of these is weak evidence.")


@pytest.mark.parametrize("requirements", [pytest.param(1, marks=pytest.mark.slow), 2])
@pytest.mark.usefixtures("plain_figures")
def test_statement_is_printed_and_shown(make_run: MakeRun, tmp_path: Path, requirements: int) -> None:
    second = {**VELOCITY, "id": "SECOND", "bound": 9.0}
    directory = make_run(make_rows(12)[MIN_COLUMNS], [VELOCITY, second][:requirements])
    console = Console(record=True, width=200)
    evaluate_and_report(directory, console)
    write_site(tmp_path / "site", [directory])
    texts = [console.export_text(), (directory / "report.html").read_text()]
    texts += [page.read_text() for page in (tmp_path / "site").rglob("index.html")]
    assert len(texts) == 4
    statement = "2 requirements are decided at a confidence: if none is met, up to 0.2 false PASSes"
    assert [statement in text for text in texts] == [requirements == 2] * 4
