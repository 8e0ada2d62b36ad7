"""Tests of the columns in requirements: unknown ones in metric or population are reported before terrain is built."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import ConfigurationError
from marsyard.cli.app import app
from marsyard.scenarios.descent.scenario import DescentScenario
from marsyard.scenarios.systems import catalogue

#: A user's score function: its results are additional columns of a case.
SCORE_MODULE = """
def braking(case):
    return {"lateral_j": 1.0, "soft": True}
"""
REQUIREMENT = """
[[requirements]]
id = "CUSTOM"
metric = "{metric}"
{bound}
probability = 0.9
confidence = 0.9
population = "{population}"
"""


def _write_campaign(folder: Path, metric: str, population: str = "valid", bound: str = "bound = 5.0") -> Path:
    """Write the campaign dimes-smoke with one custom requirement instead of its requirements."""
    text = catalogue()["dimes-smoke"].read_text(encoding="utf-8").partition("[[requirements]]")[0]
    path = folder / "custom.toml"
    path.write_text(text + REQUIREMENT.format(metric=metric, population=population, bound=bound))
    return path


@pytest.mark.parametrize(
    ("metric", "population", "bound", "key", "hint"),
    [
        ("velocity_eror_m_s", "valid", "bound = 5.0", "metric", "did you mean 'velocity_error_m_s'?"),
        ("velocity_error_m_s + wind_m", "valid", "bound = 5.0", "metric", "unknown column of numbers 'wind_m'"),
        ("answerd", "valid", "", "metric", "did you mean 'answered'?"),
        ("velocity_error_m_s", "valid and in_time_asumed", "bound = 5.0", "population", "mean 'in_time_assumed'?"),
        ("feasible_overlap", "valid", "bound = 5.0", "metric", "unknown column of numbers 'feasible_overlap'"),
    ],
)
def test_misspelt_columns_are_reported_before_terrain_is_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, metric: str, population: str, bound: str, key: str, hint: str
) -> None:
    prepared_inputs: list[int] = []
    # preparing a case builds its terrain
    monkeypatch.setattr(DescentScenario, "prepare", lambda _, __, number: prepared_inputs.append(number))
    path = _write_campaign(tmp_path, metric, population, bound)
    with pytest.raises(ConfigurationError) as error:
        load_campaign(str(path))
    assert f"requirements[0].{key}" in str(error.value)
    assert hint in str(error.value)
    result = CliRunner().invoke(app, ["run", str(path), "-n", "1", "--jobs", "1", "--out", str(tmp_path / "run")])
    assert result.exit_code == 2
    assert hint in result.output
    assert prepared_inputs == []
    assert not (tmp_path / "run").exists()


def test_score_columns_and_algorithm_columns_are_accepted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_scores.py").write_text(SCORE_MODULE)
    monkeypatch.chdir(tmp_path)
    path = _write_campaign(tmp_path, "braking_lateral_j", "valid and braking_soft")
    load_campaign(str(path), ['scores=["my_scores:braking"]'])
    with pytest.raises(ConfigurationError, match="braking_lateral_j"):
        load_campaign(str(path))
    comparison = _write_campaign(tmp_path, "homography.velocity_error_m_s", "answered")
    load_campaign(str(comparison), algorithms=["dimes", "homography"])
