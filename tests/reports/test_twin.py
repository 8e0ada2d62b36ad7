"""`report.json` keeps its layout."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import pandas as pd
import pytest

from marsyard.reports.campaign import SCHEMA, SCHEMA_FILE, write_report
from tests.reports.report_layout import Twin

Rows = Callable[..., pd.DataFrame]
MakeRun = Callable[..., Path]


def test_the_schema_next_to_the_layout_is_its_own() -> None:
    # To renew it: json.dump(Twin.model_json_schema(), file, indent=1), with a newline behind.
    kept = SCHEMA_FILE.read_text()
    assert json.loads(kept) == Twin.model_json_schema()
    assert get_args(Twin.model_fields["report_schema"].annotation) == (SCHEMA,)


@pytest.mark.parametrize(
    "options",
    [
        {"cases": 24},
        {"cases": 400, "terrains": 60},
        {"cases": 24, "crashed": 3},
        {"cases": 24, "answered": 0.0},
        {"cases": 1},
    ],
)
def test_reports_are_laid_out_so(make_rows: Rows, make_run: MakeRun, options: dict[str, float]) -> None:
    directory = make_run(make_rows(**options)[["case", "outcome", "answered", "terrain", "velocity_error_m_s"]])
    write_report(directory)
    Twin.model_validate_json((directory / "report.json").read_text(), strict=True)


def test_a_report_without_rows_or_requirements_too(make_rows: Rows, make_run: MakeRun) -> None:
    directory = make_run(make_rows(24).head(0), [])
    write_report(directory)
    found = Twin.model_validate_json((directory / "report.json").read_text(), strict=True)
    assert (found.verdict, found.verdicts) == ("NO REQUIREMENT", [])
