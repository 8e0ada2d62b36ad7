"""Tests of verdicts for sampling designs: only independent random draws give probability statements."""

import io
import json
import math
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from marsyard.reports.campaign_report import write_report
from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.overall import combine_verdicts, compute_exit_code
from marsyard.reports.sampling_design import INDEPENDENT, SamplingDesign, read_sampling_design
from marsyard.reports.terminal_tables import verdict_table
from marsyard.reports.verdicts import Status
from tests.reports.synthetic_run import VELOCITY, MakeRun, make_rows

GRID = {"a": {"distribution": "grid", "values": [1, 2]}, "b": {"distribution": "uniform", "low": 0, "high": 1}}
IN_TURN = {"distribution": "in-turn", "low": 0, "high": "a.bank - 1", "source": "a.terrain is a number"}
DESIGNS = [
    ({"design": {"kind": "latin-hypercube"}}, "the design is Latin hypercube, and only independent random samples"),
    ({"design": {"kind": "sobol"}}, "the design is scrambled Sobol, and only"),
    ({"dispersions": GRID}, "the design is random draws at each point of a grid over a, and only"),
    ({"dispersions": {"k": IN_TURN}}, "the design is random draws with values in turn of k, and only"),
    (
        {"dispersions": {"a.terrain": IN_TURN, "b": {"distribution": "derived", "formula": "2 * a.terrain"}}},
        "values in turn of a.terrain, and only",
    ),
]


@pytest.mark.parametrize(
    "values", [{}, {"design": None}, {"design": 3}, {"design": {"kind": None, "nominal": "x"}}, {"dispersions": [1]}]
)
def test_default_design_is_independent_draws(values: dict[str, Any]) -> None:
    assert read_sampling_design(values) == INDEPENDENT
    assert INDEPENDENT.no_probability_reason == ""


def test_terrains_in_turn_are_independent_draws() -> None:
    dispersions = {"a.terrain": IN_TURN, "b": {"distribution": "derived", "formula": "2 * a.terrain_size"}}
    assert read_sampling_design({"dispersions": dispersions}).independent


@pytest.mark.parametrize(("definition", "message"), DESIGNS)
def test_designs_without_independent_draws_have_no_confidence(definition: dict[str, Any], message: str) -> None:
    frame, design = make_rows(400), read_sampling_design(definition)
    requirements = [{**VELOCITY, "probability": probability} for probability in (0.5, VELOCITY["probability"])]
    for verdict, reference in zip(
        evaluate_requirements(frame, requirements, design), evaluate_requirements(frame, requirements), strict=True
    ):
        assert verdict.status is Status.INSUFFICIENT
        assert (verdict.n, verdict.failures, verdict.estimate) == (reference.n, reference.failures, reference.estimate)
        assert math.isnan(verdict.lower)
        assert math.isnan(verdict.upper)
        assert verdict.additional_cases is None
        assert message in verdict.note
    verdicts = evaluate_requirements(frame, requirements, design)
    summary = combine_verdicts(verdicts, frame, design)
    assert (summary.word, message in summary.sentence) == ("INSUFFICIENT", True)
    assert compute_exit_code(verdicts, crashed=False) == 3
    assert compute_exit_code(verdicts, crashed=True) == 1
    output = io.StringIO()
    Console(file=output, width=200).print(verdict_table(verdicts))
    assert output.getvalue().count("No probability statement") == 1
    assert "Clopper" not in output.getvalue()


@pytest.mark.parametrize(("definition", "message"), DESIGNS)
def test_rate_decides_for_designs_without_independent_draws(definition: dict[str, Any], message: str) -> None:
    """A rate of 0.98 in 1000 cases meets 0.98 but not 0.99; the verdict has no bounds."""
    frame, design = make_rows(1000), read_sampling_design(definition)
    frame["answered"], frame["velocity_error_m_s"] = True, np.where(np.arange(1000) % 50, 0.1, 99.0)
    requirements = [{**VELOCITY, "probability": min_rate, "decide_by": "estimate"} for min_rate in (0.98, 0.99)]
    met_verdict, failed_verdict = evaluate_requirements(frame, requirements, design)
    assert (met_verdict.status, failed_verdict.status) == (Status.MET_BY_RATE, Status.FAIL)
    assert (met_verdict.n, met_verdict.failures, met_verdict.estimate) == (1000, 20, 0.98)
    assert math.isnan(met_verdict.lower)
    assert met_verdict.note.startswith("Evaluated by the observed rate of these cases. No probability statement: ")
    assert message in met_verdict.note
    assert compute_exit_code([met_verdict], crashed=False) == 3
    assert compute_exit_code([met_verdict, failed_verdict], crashed=False) == 1
    summary = combine_verdicts([met_verdict, failed_verdict], frame, design)
    assert summary.word == "FAIL"
    assert summary.sentence.startswith("1 of 2 requirements met by the rate of these cases. No probability statement: ")
    empty_population = evaluate_requirements(
        frame.assign(answered=False), [{**requirements[0], "population": "valid"}], design
    )
    assert empty_population[0].status is Status.INSUFFICIENT
    assert not combine_verdicts(empty_population, frame, design).sentence.startswith("0 of")


def test_nominal_case_is_excluded_from_verdicts() -> None:
    frame = make_rows(231)
    frame["velocity_error_m_s"] = 1.0
    frame["answered"] = True
    frame["terrain"] = range(231)
    frame.loc[0, "velocity_error_m_s"] = 9.0
    (without_nominal,) = evaluate_requirements(frame, [VELOCITY], SamplingDesign(nominal=True))
    assert (without_nominal.status, without_nominal.n, without_nominal.failures) == (Status.PASS, 230, 0)
    (with_nominal,) = evaluate_requirements(frame, [VELOCITY])
    assert (with_nominal.n, with_nominal.failures) == (231, 1)


@pytest.mark.slow
def test_page_and_json_describe_the_design(make_run: MakeRun) -> None:
    frame = make_rows(60)
    frame.loc[0, "velocity_error_m_s"] = 77.0
    directory = make_run(frame)
    record = json.loads((directory / "campaign.json").read_text())
    record["definition"]["design"] = {"kind": "latin-hypercube", "nominal": True}
    (directory / "campaign.json").write_text(json.dumps(record))
    page = write_report(directory).read_text()
    report = json.loads((directory / "report.json").read_text())
    for text in (
        "The cases are not independent random samples: Latin hypercube; case 0 is the nominal case.",
        "velocity error (m/s) 77.0",
        "No probability statement: the design is Latin hypercube",
        "% observed",
    ):
        assert text in page, text
    assert "Additional cases needed</th>" in page
    assert report["sampling"] == {
        "design": "latin-hypercube",
        "grids": [],
        "nominal": True,
        "max_cases": None,
        "first_look": None,
        "terrains": None,
        "independent": False,
        "text": "Latin hypercube; case 0 is the nominal case",
    }
    assert (report["cases"], report["exit_code"]) == (60, 3)
    assert 0 not in [int(case) for case in report["worst_cases"]]
    assert report["statistics"]["velocity error (m/s)"]["largest"] < 77.0
