"""Tests of large campaigns, of which reports read all columns only for the first cases."""

from pathlib import Path

import numpy as np
import pytest

from marsyard.campaigns.studies.results import ROBUST_FOLDER
from marsyard.reports import stored
from marsyard.reports.metrics import list_metrics
from marsyard.reports.stored import read_run
from marsyard.reports.variants import read_robust_studies
from tests.reports.synthetic_run import VELOCITY, MakeRun, make_rows, write_run


@pytest.fixture
def large_run(make_run: MakeRun, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a campaign of 60 cases, of which the first 20 have all columns."""
    monkeypatch.setattr(stored, "MAX_FULL_CASES", 50)
    monkeypatch.setattr(stored, "FIRST_CASES", 20)
    frame = make_rows(60).assign(is_close=True, margin_m=np.arange(60.0))
    flag = {"id": "CLOSE", "metric": "is_close", "margin": "margin_m", "probability": 0.9, "confidence": 0.9}
    return make_run(frame, [VELOCITY, flag])


def test_margins_of_all_cases_are_read(large_run: Path) -> None:
    run = read_run(large_run)
    assert (len(run.frame), len(run.all_cases)) == (20, 60)
    assert run.all_cases["margin_m"].tolist() == list(range(60))


def test_robust_study_repeats_cases_beyond_the_first_ones(large_run: Path) -> None:
    variants = [{"name": "dark", "title": "a darker ground", "values": {"site.albedo": 0.1}}]
    study = {"kind": "robust", "variants": variants, "cases": [5, 50], "weights": [1.0, 59.0], "result": {"cases": 2}}
    write_run(large_run / ROBUST_FOLDER / "dark", make_rows(2), study=study)
    (robust,) = read_robust_studies(read_run(large_run))
    assert robust.base["case"].tolist() == [5, 50]


def test_all_cases_are_compared_between_campaigns(large_run: Path) -> None:
    frame, metrics = list_metrics(read_run(large_run))
    assert len(frame) == 60
    assert {metric.sample.values.size for metric in metrics} == {60}
