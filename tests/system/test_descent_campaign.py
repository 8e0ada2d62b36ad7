"""A rendered descent campaign as a user runs it: the command line, worker processes, files, replay."""

import json
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner, Result

from marsyard.cli.app import app

pytestmark = [
    pytest.mark.filterwarnings("ignore:Failed to kill subprocesses"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:matplotlib"),
]

#: The smoke campaign over a small world, with fewer dispersions.
CAMPAIGN = """
name = "small-descents"
scenario = "descent"
cases = 5
seed = 11

[parameters.terrain]
samples = 1024
spacing_m = 3.0

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


def _marsyard(*words: str, cwd: Path) -> Result:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(cwd)
        patch.setattr(sys, "path", [*sys.path])  # commands add their folder, which holds misleading modules here
        return CliRunner().invoke(app, words)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the campaign's file and its runs A (one worker) and B (two workers)."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "small.toml").write_text(CAMPAIGN)
    # a user's own files by the names of Marsyard's folders are no part of it
    (folder / "sim.py").write_text("raise ImportError('the wrong module')\n")
    for name in ("reports", "tests"):
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text("raise ImportError('the wrong module')\n")
    words = [sys.executable, "-m", "marsyard", "run", "small.toml", "--jobs", "1", "--out", "A"]
    alone = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=300)
    assert alone.returncode == 3, alone.stdout + alone.stderr
    in_process = _marsyard("run", "small.toml", "--jobs", "2", "--out", "B", cwd=folder)
    assert in_process.exit_code == 3, in_process.output
    for output in (alone.stdout, in_process.stdout):
        assert "INSUFFICIENT" in output
        assert "report.html" in output
    return folder


def _rows(folder: Path) -> pd.DataFrame:
    rows = pd.read_parquet(folder / "cases.parquet")
    return rows[[name for name in rows.columns if "time" not in name]]


def test_rows_do_not_depend_on_the_number_of_workers(runs: Path) -> None:
    one, two = _rows(runs / "A"), _rows(runs / "B")
    pd.testing.assert_frame_equal(one, two, check_exact=True)
    assert one["case"].tolist() == [0, 1, 2, 3, 4]
    assert one["image_hash"].nunique() == 5


def test_velocities_are_scored_against_truth(runs: Path) -> None:
    rows = _rows(runs / "A")
    valid = rows[rows["outcome"] == "VALID"]
    assert len(valid) >= 4
    # ten times what instruments of this class leave: a frame or a sign wrong gives tens of metres per second
    assert (valid["velocity_error_m_s"] < 3.0).all()
    assert valid["velocity_true_x_m_s"].abs().max() > 5.0


def test_drawn_values_were_applied(runs: Path) -> None:
    """The dispersed values show in what was simulated."""
    rows = _rows(runs / "A")
    assert set(rows["terrain"]) == {0, 1}
    assert rows["location_east_m"].between(0.0, 3000.0).all()
    assert rows["location_east_m"].nunique() == 5
    assert rows["attitude_rate_max_deg_s"].nunique() == 5


def test_a_replayed_case_is_the_stored_one(runs: Path) -> None:
    done = _marsyard("replay", "A", "3", "--out", "replayed", cwd=runs)
    assert done.exit_code == 0, done.output
    assert any((runs / "replayed").iterdir())


def test_a_row_that_differs_is_named(runs: Path, tmp_path: Path) -> None:
    changed = tmp_path / "changed"
    changed.mkdir()
    (changed / "campaign.json").write_text((runs / "A" / "campaign.json").read_text())
    rows = pd.read_parquet(runs / "A" / "cases.parquet")
    rows["velocity_true_x_m_s"] += 1e-9 * (rows.index == 2)
    rows.to_parquet(changed / "cases.parquet")
    done = _marsyard("replay", str(changed), "2", "--out", str(tmp_path / "again"), cwd=tmp_path)
    assert done.exit_code == 1
    assert "velocity_true_x_m_s" in done.output


def test_the_run_says_what_it_was(runs: Path) -> None:
    record = json.loads((runs / "A" / "campaign.json").read_text())
    text = json.dumps(record)
    assert record["state"] == "finished"
    for needed in ("small-descents", "numpy", "pyrender2", "descent.wind_east_m_s"):
        assert needed in text
    rows = pd.read_parquet(runs / "A" / "cases.parquet")
    assert {"gl_backend", "gl_version", "processor_features"} <= set(rows.columns)
    assert rows["gl_version"].str.contains("Mesa|NVIDIA").all()
    assert "changed its worker process" not in (runs / "A" / "run.log").read_text()


def test_an_existing_campaign_is_not_overwritten(runs: Path) -> None:
    before = (runs / "A" / "cases.parquet").read_bytes()
    done = _marsyard("run", "small.toml", "--out", "A", cwd=runs)
    assert done.exit_code == 2
    assert "A" in done.stderr
    assert (runs / "A" / "cases.parquet").read_bytes() == before


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("run", "small.toml", "--set", "descent.altitud_first_m=1500"), "altitud_first_m"),
        (("run", "small.toml", "--set", "descent.altitude_first_m=-5"), "altitude_first_m"),
        (("run", "small.toml", "--set", "render.backend=vulkan"), "osmesa"),
        (("run", "nowhere.toml"), "nowhere.toml"),
        (("run", "dimes-smok"), "dimes-smoke"),
        (("run", "small.toml", "-n", "0"), "-n"),
        (("replay", "A", "99"), "99"),
        (("report", "nowhere"), "nowhere"),
    ],
)
def test_bad_input_is_named_with_exit_code_2(runs: Path, words: tuple[str, ...], says: str) -> None:
    done = _marsyard(*words, cwd=runs)
    assert done.exit_code == 2, done.output
    assert says in done.stderr
    assert "Traceback" not in done.output
