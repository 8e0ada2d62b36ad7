"""Tests of `report.json` against its models in `report_layout` and its JSON schema."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import pandas as pd
import pytest

from marsyard.reports.campaign import SCHEMA, SCHEMA_FILE, write_report
from tests.reports.report_layout import CampaignReport

Rows = Callable[..., pd.DataFrame]
MakeRun = Callable[..., Path]


def test_stored_schema_equals_the_layout() -> None:
    # to update the file: json.dump(CampaignReport.model_json_schema(), file, indent=1), followed by a newline
    schema_text = SCHEMA_FILE.read_text()
    assert json.loads(schema_text) == CampaignReport.model_json_schema()
    assert get_args(CampaignReport.model_fields["report_schema"].annotation) == (SCHEMA,)


@pytest.mark.parametrize(
    "options",
    [
        {"cases": 24},
        {"cases": 400, "terrains": 60},
        {"cases": 24, "n_crashed": 3},
        {"cases": 24, "answer_rate": 0.0},
        {"cases": 1},
    ],
)
def test_reports_follow_the_layout(make_rows: Rows, make_run: MakeRun, options: dict[str, float]) -> None:
    directory = make_run(make_rows(**options)[["case", "outcome", "answered", "terrain", "velocity_error_m_s"]])
    write_report(directory)
    CampaignReport.model_validate_json((directory / "report.json").read_text(), strict=True)


def test_empty_report_follows_the_layout(make_rows: Rows, make_run: MakeRun) -> None:
    directory = make_run(make_rows(24).head(0), [])
    write_report(directory)
    report = CampaignReport.model_validate_json((directory / "report.json").read_text(), strict=True)
    assert (report.verdict, report.verdicts) == ("NO REQUIREMENT", [])
