"""System test of a rendered descent campaign: command line, worker processes, files and replay."""

import json
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner, Result

from marsyard.cli.app import app
from tests.inline_workers import use_inline_workers

#: Exit code of a campaign with too few cases for a verdict.
EXIT_INSUFFICIENT = 3
#: The smoke campaign on small terrain with fewer dispersions.
CAMPAIGN = """
name = "small-descents"
scenario = "descent"
cases = 3
seed = 11

[parameters.terrain]
samples = 512
spacing_m = 6.0

[parameters.location]
bank = 2

[dispersions]
"location.terrain" = { distribution = "integer", low = 0, high = 1 }
"location.east_m" = { distribution = "uniform", low = 0.0, high = 3000.0 }
"descent.wind_east_m_s" = { distribution = "uniform", low = -20.0, high = 20.0 }
"descent.cone_angle_deg" = { distribution = "uniform", low = 0.0, high = 20.0 }
"descent.nod_rate_deg_s" = { distribution = "uniform", low = 0.0, high = 60.0 }

[[requirements]]
id = "DIMES-VEL"
statement = "The horizontal velocity that DIMES reports is within 5 m/s of the true one."
metric = "velocity_error_m_s"
bound = 5.0
probability = 0.99
confidence = 0.90
population = "valid"
"""


def _run_marsyard(*arguments: str, cwd: Path) -> Result:
    """Run a command with its cases in the process of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        use_inline_workers(patch)
        patch.chdir(cwd)
        patch.setattr(sys, "path", [*sys.path])  # Commands add the folder to the path; the context restores it.
        return CliRunner().invoke(app, arguments)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the campaign as a program with two workers (folder A), and in the process of the tests (folder B)."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "small.toml").write_text(CAMPAIGN)
    # Marsyard must not import user modules that have the names of its packages.
    (folder / "sim.py").write_text("raise ImportError('the wrong module')\n")
    for name in ("reports", "tests"):
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text("raise ImportError('the wrong module')\n")
    arguments = [sys.executable, "-m", "marsyard", "run", "small.toml", "--jobs", "2", "--out", "A"]
    subprocess_run = subprocess.run(arguments, cwd=folder, capture_output=True, text=True, timeout=300)
    assert subprocess_run.returncode == EXIT_INSUFFICIENT, subprocess_run.stdout + subprocess_run.stderr
    in_process_run = _run_marsyard("run", "small.toml", "--set", "retain.showcase=none", "--out", "B", cwd=folder)
    assert in_process_run.exit_code == EXIT_INSUFFICIENT, in_process_run.output
    for output in (subprocess_run.stdout, in_process_run.stdout):
        assert "INSUFFICIENT" in output
        assert "report.html" in output
    return folder


def _read_rows(folder: Path) -> pd.DataFrame:
    rows = pd.read_parquet(folder / "cases.parquet")
    return rows[[name for name in rows.columns if "time" not in name]]


def test_rows_do_not_depend_on_the_process(runs: Path) -> None:
    rows_of_workers, rows_of_this_process = _read_rows(runs / "A"), _read_rows(runs / "B")
    pd.testing.assert_frame_equal(rows_of_workers, rows_of_this_process, check_exact=True)
    assert rows_of_workers["case"].tolist() == [0, 1, 2]
    assert rows_of_workers["image_hash"].nunique() == 3


def test_dispersed_values_are_simulated(runs: Path) -> None:
    rows = _read_rows(runs / "A")
    assert set(rows["terrain"]) == {0, 1}
    assert rows["location.east_m"].between(0.0, 3000.0).all()
    assert rows["location.east_m"].nunique() == 3
    assert rows["attitude_rate_max_deg_s"].nunique() == 3


def test_replayed_case_equals_the_stored_row(runs: Path) -> None:
    result = _run_marsyard("replay", "A", "2", "--out", "replayed", cwd=runs)
    assert result.exit_code == 0, result.output
    assert any((runs / "replayed").iterdir())


def test_record_describes_the_run(runs: Path) -> None:
    record = json.loads((runs / "A" / "campaign.json").read_text())
    text = json.dumps(record)
    assert record["state"] == "finished"
    for text_part in ("small-descents", "numpy", "pyrender2", "descent.wind_east_m_s"):
        assert text_part in text
    rows = pd.read_parquet(runs / "A" / "cases.parquet")
    assert {"gl_backend", "gl_version", "processor_features"} <= set(rows.columns)
    assert rows["gl_version"].str.contains("Mesa|NVIDIA").all()
    assert "changed its worker process" not in (runs / "A" / "run.log").read_text()
