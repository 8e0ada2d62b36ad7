"""Test of the campaign with images whose page `make bench` measures."""

import json
from pathlib import Path

import pandas as pd
import pytest

from benchmarks import reporting
from marsyard.reports.dashboard.site import write_site


def test_rows_of_rendered_cases_are_multiplied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(*arguments: str) -> None:
        folder = Path(arguments[arguments.index("--out") + 1])
        folder.mkdir()
        pd.DataFrame({"case": range(8), "error_m": 2.0, "answered": True}).to_parquet(folder / "cases.parquet")
        (folder / "campaign.json").write_text(json.dumps({"name": "loc-light", "cases": 8}))
        (folder / "cases.sqlite").touch()

    monkeypatch.setattr(reporting, "run_marsyard", run)
    folder = reporting._write_campaign_with_images(tmp_path / "run", 300)
    rows = pd.read_parquet(folder / "cases.parquet")
    assert rows["case"].tolist() == list(range(300))
    assert rows["error_m"].nunique() == 300
    assert rows["answered"].all()
    assert json.loads((folder / "campaign.json").read_text())["cases"] == 300


def test_synthetic_campaigns_have_reports_and_a_dashboard(tmp_path: Path) -> None:
    run = reporting.synthetic_campaign(tmp_path / "of-24", 24)
    assert reporting.write_report(run).exists()
    site = write_site(reporting._copy_campaigns(tmp_path / "many", run, 3), [tmp_path / "many" / "runs"])
    assert (site.campaigns, site.problems) == (3, [])
