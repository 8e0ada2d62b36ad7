"""Tests of the domain of validity: cases outside of the checked conditions, and missed checks next to the verdict."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from marsyard.reports import validation_rows, validity
from marsyard.reports.campaign_report import write_report
from marsyard.reports.evaluation import evaluate_run
from marsyard.reports.report_file import read_report
from marsyard.reports.validation_rows import Conditions, RowKind, ValidationRow, read_checks
from marsyard.sim.terrain import sites
from tests.command import marsyard
from tests.reports.synthetic_run import MIN_COLUMNS, MakeRun, make_rows

_SLOPE_DEG = sites()["gusev"].terrain("descent").rms_slope_deg
#: A met verification, a met comparison with fitted data, and a missed comparison with other data.
CHECKED = Conditions(
    systems=("dimes",), site=("gusev",), camera=("mer-descent-flown",), sun_elevation_deg=(30.0, 45.0),
    slope_deg=(_SLOPE_DEG, _SLOPE_DEG), optical_depth=(0.9, 0.9), range_m=(1900.0, 2100.0),
)  # fmt: skip
VERIFIED = ValidationRow("ranges", 1.0, "px", 2.0, "at most", "rays", CHECKED)
FITTED = replace(
    VERIFIED,
    claim="contrast",
    kind=RowKind.FIT,
    conditions=replace(CHECKED, data="spirit-descent", sun_elevation_deg=(56.9, 56.9)),
)
MISSED = replace(
    VERIFIED,
    claim="width",
    measured=3.0,
    kind=RowKind.VALIDATION,
    conditions=replace(CHECKED, data="dimes-templates", sun_elevation_deg=(0.0, 90.0)),
)


@pytest.fixture(autouse=True)
def _rows(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [VERIFIED, FITTED, MISSED]
    monkeypatch.setattr(validity, "rows_of_system", lambda name: [row for row in rows if row.concerns(name)])


@pytest.fixture
def run(make_run: MakeRun) -> Path:
    """Write a run of 40 cases over Gusev with the sun at 20, 21 ... 59 deg."""
    frame = make_rows(40)[MIN_COLUMNS]
    frame["sun_elevation_deg"] = 20.0 + np.arange(40)
    frame["altitude_1_m"] = 2000.0
    frame["site"] = "gusev"
    return make_run(frame)


def read_validity(directory: Path) -> validity.Validity:
    return evaluate_run(directory).validity


def test_cases_outside_of_checked_sun_elevations_are_counted(run: Path) -> None:
    verification, comparison = read_validity(run).domains
    coverage = {item.quantity: item for item in verification.coverage}
    # 16 of the elevations 20 to 59 deg are 30 to 45 deg
    assert (coverage["sun_elevation_deg"].outside, verification.outside) == (24, 24)
    assert coverage["sun_elevation_deg"].checked == (30.0, 45.0)
    assert coverage["site"].outside == coverage["camera"].outside == coverage["range_m"].outside == 0
    # the missed row, which would cover all elevations, does not extend the comparison with data at 56.9 deg
    assert comparison.outside == 40


def test_other_sites_slopes_and_cameras_are_outside(run: Path, make_run: MakeRun) -> None:
    frame = pd.read_parquet(run / "cases.parquet")
    frame.loc[:9, "site"] = "meridiani"
    definition = json.loads((run / "campaign.json").read_text())["definition"]
    parameters = {"camera": {"model": {"file": "mine.cahvor"}}, "dust_opacity": 1.5}
    other = make_run(frame, name="other", definition=definition | {"parameters": parameters})
    coverage = {item.quantity: item for item in read_validity(other).domains[0].coverage}
    assert coverage["site"].outside == 10
    assert coverage["slope_deg"].outside == 10  # 1.8 deg at Meridiani
    assert coverage["camera"].cases == ("mine.cahvor",)
    assert coverage["camera"].outside == coverage["optical_depth"].outside == 40


def test_values_that_are_missing_are_not_outside(run: Path, make_run: MakeRun) -> None:
    frame = pd.read_parquet(run / "cases.parquet")
    frame.loc[:29, "sun_elevation_deg"] = np.nan
    coverage = {item.quantity: item for item in read_validity(make_run(frame, name="other")).domains[0].coverage}
    # the remaining elevations are 50 to 59 deg
    assert coverage["sun_elevation_deg"].outside == 10


def test_quantity_without_a_check_is_outside(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = replace(VERIFIED, conditions=replace(CHECKED, optical_depth=None))
    monkeypatch.setattr(validity, "rows_of_system", lambda name: [row])
    result = read_validity(run)
    coverage = {item.quantity: item for item in result.domains[0].coverage}
    assert (coverage["optical_depth"].checked, coverage["optical_depth"].outside) == (None, 40)
    assert "optical depth 100 % (in no check)" in result.sentences[0]
    assert result.sentences[1] == "No check compares the simulation of this system with flight or test data."


def test_rows_of_other_systems_are_ignored(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = replace(MISSED, conditions=replace(CHECKED, systems=("vtt",)))
    monkeypatch.setattr(
        validation_rows, "read_checks", lambda: {"a": validation_rows.ValidationCheck("", {}, (other,))}
    )
    rows_of_system = validation_rows.rows_of_system.__wrapped__
    assert rows_of_system("dimes") == []
    assert rows_of_system("vtt") == [other]


@pytest.mark.usefixtures("plain_figures")
def test_terminal_report_and_json_state_the_domain_and_missed_checks(run: Path) -> None:
    _, out, _ = marsyard("report", run)
    outside = (
        "24 of 40 cases (60.00 %) are outside of the conditions in which the simulation was compared with independent"
    )
    missed = "Missed check (validation): width: 3 px, limit at most 2 px."
    assert f"validity: {outside}" in out
    assert f"validity: {missed}" in out
    page = (run / "report.html").read_text()
    assert outside in page
    assert missed in page
    assert 'id="validity"' in page
    report = read_report((run / "report.json").read_text())
    assert [domain.outside for domain in report.validity.domains] == [24, 40]
    assert [item.kind for item in report.validity.missed] == [RowKind.VALIDATION]


@pytest.mark.usefixtures("plain_figures")
def test_system_of_another_package_has_no_domain(make_run: MakeRun) -> None:
    definition = {"name": "other", "scenario": "mine:Scenario", "requirements": []}
    directory = make_run(make_rows(8)[MIN_COLUMNS], requirements=[], definition=definition, scenario="mine:Scenario")
    write_report(directory)
    assert read_validity(directory) == validity.Validity()


@pytest.mark.parametrize(
    ("changes", "is_met"),
    [({}, True), ({"measured": 2.1}, False), ({"measured": float("nan")}, False), ({"limit": None}, None),
     ({"sense": "at least"}, False)],
)  # fmt: skip
def test_limit_decides(changes: dict[str, Any], is_met: bool | None) -> None:
    assert replace(VERIFIED, **changes).is_met is is_met


def test_packaged_rows_contain_fits_and_predictions() -> None:
    rows = [row for check in read_checks().values() for row in check.rows]
    kinds = {row.claim: row.kind for row in rows}
    assert kinds["patchiness, descent over gusev"] is RowKind.FIT
    assert kinds["refused templates"] is RowKind.VALIDATION
    assert kinds["shadows as Mitsuba's: gusev from 300 m, sun at 35 deg"] is RowKind.VERIFICATION
