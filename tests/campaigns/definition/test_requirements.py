"""Tests of requirements: shipped ones, files of users, unknown columns, and margins of a case."""

import math
import re
import tomllib
from pathlib import Path

import pytest

from marsyard.campaigns.definition.campaign_file import Requirement
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.definition.margins import compute_margin
from marsyard.campaigns.definition.requirements import read_requirements, select_applicable, shipped_requirements
from marsyard.campaigns.errors import DefinitionError
from marsyard.scenarios.descent.scenario import DescentScenario
from marsyard.scenarios.systems import catalogue
from tests.campaigns.fake_campaign import write_campaign
from tests.command import run_command

#: Bounds in the units of the metrics (m/s, m, s); None: the metric is true or false.
BOUNDS = {
    "DIMES-VEL": 5.0, "DIMES-HARM": 5.0, "DIMES-AVAIL": None, "VTT-POS": 0.03, "VTT-TRACK": None, "VTT-HARM": None,
    "VTT-DRIFT": 2.5,
    "HDA-SAFE": None, "HDA-TOUCHDOWN": None, "HDA-FIND": None, "HDA-FAR": None, "HDA-MAP": 0.9, "HDA-POS": 1.21,
    "LOC-POS": 40.0, "LOC-FINAL": 40.0, "LOC-HARM": 40.0, "LOC-COARSE": 200.0, "LOC-AVAIL": None, "LOC-END": None,
}  # fmt: skip


def test_shipped_requirements_have_a_source() -> None:
    shipped = shipped_requirements()
    assert {requirement_id: requirement.bound for requirement_id, requirement in shipped.items()} == BOUNDS
    assert all(entry.kind and entry.source and entry.statement and entry.campaigns for entry in shipped.values())


def test_campaigns_of_requirements_exist() -> None:
    patterns = [pattern for requirement in shipped_requirements().values() for pattern in requirement.campaigns]
    assert set(patterns) <= set(catalogue())


def test_campaign_may_change_population_and_confidence(tmp_path: Path) -> None:
    path = write_campaign(
        tmp_path, requirement='[[requirements]]\nid = "DIMES-VEL"\npopulation = "valid and clear"\nprobability = 0.9\n'
    )
    (requirement,) = load_campaign(str(path)).definition.requirements
    assert (requirement.metric, requirement.bound, requirement.confidence) == ("velocity_error_m_s", 5.0, 0.9)
    assert (requirement.population, requirement.probability) == ("valid and clear", 0.9)


@pytest.mark.parametrize(
    ("entry", "message"),
    [('id = "DIMES-VEE"', "did you mean 'DIMES-VEL'"), ('id = "DIMES-VEL"\nbound = 9.0', "requirements[0].bound")],
)
def test_unknown_id_and_changed_bound_are_reported(tmp_path: Path, entry: str, message: str) -> None:
    path = write_campaign(tmp_path, requirement=f"[[requirements]]\n{entry}\n")
    with pytest.raises(DefinitionError) as error:
        load_campaign(str(path))
    assert message in str(error.value)


#: A requirement of a user's file, for campaigns whose names begin with dimes-.
ENTRY = (
    '[[requirements]]\nid = "A"\nmetric = "answered"\nprobability = 0.9\nconfidence = 0.9\ncampaigns = ["dimes-*"]\n'
)


def test_campaign_patterns_select_requirements(tmp_path: Path) -> None:
    path = tmp_path / "requirements.toml"
    path.write_text(ENTRY)
    (requirement,) = select_applicable(read_requirements(path), "dimes-gusev")
    assert (requirement["id"], "campaigns" in requirement) == ("A", False)
    assert select_applicable(read_requirements(path), "vtt-roll") == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("not toml", "not valid TOML"),
        (ENTRY + "bounds = 3\n", "requirements[0].bounds"),
        (ENTRY + ENTRY, "share an id: A"),
        ("", "requirements"),
    ],
)
def test_invalid_requirement_file_is_rejected(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "requirements.toml"
    path.write_text(text)
    with pytest.raises(DefinitionError) as error:
        read_requirements(path)
    assert message in str(error.value)


def test_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(DefinitionError, match="cannot be read"):
        read_requirements(tmp_path / "none.toml")


def test_requirement_texts_do_not_contain_algorithm_names() -> None:
    # the user selects the algorithm, so texts may only cite an algorithm's paper
    algorithm_name = re.compile(r"\b(DIMES|VTT|HDA|NCC)\b(?! paper)")
    for name, path in catalogue().items():
        campaign = tomllib.loads(path.read_text(encoding="utf-8"))
        statements = [requirement.get("statement", "") for requirement in campaign.get("requirements", ())]
        texts = [campaign["description"], *statements]
        assert not [text for text in texts if algorithm_name.search(text)], name
    shipped = [requirement.statement for requirement in shipped_requirements().values()]
    assert not [statement for statement in shipped if algorithm_name.search(statement)]


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
    with pytest.raises(DefinitionError) as error:
        load_campaign(str(path))
    assert f"requirements[0].{key}" in str(error.value)
    assert hint in str(error.value)
    status, output = run_command("run", path, "-n", 1, "--jobs", 1, "--out", tmp_path / "run")
    assert (status, hint in output) == (2, True)
    assert prepared_inputs == []
    assert not (tmp_path / "run").exists()


def test_score_columns_and_algorithm_columns_are_accepted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_scores.py").write_text(SCORE_MODULE)
    monkeypatch.chdir(tmp_path)
    path = _write_campaign(tmp_path, "braking_lateral_j", "valid and braking_soft")
    load_campaign(str(path), ['scores=["my_scores:braking"]'])
    with pytest.raises(DefinitionError, match="braking_lateral_j"):
        load_campaign(str(path))
    comparison = _write_campaign(tmp_path, "homography.velocity_error_m_s", "answered")
    load_campaign(str(comparison), algorithms=["dimes", "homography"])


def test_margin_of_a_scaled_sum_of_columns() -> None:
    requirement = Requirement(
        id="TIME",
        statement="An image and a map take at most 2 s on the flight processor.",
        metric="image_time_s + map_time_s",
        scale=60.0,
        bound=2.0,
        probability=0.95,
        confidence=0.9,
        population="all",
    )
    # the flight processor is 60 times slower than the workstation: 60 x 0.03 s = 1.8 s, 60 x 0.04 s = 2.4 s
    row = {"outcome": "VALID", "answered": True, "image_time_s": 0.02, "map_time_s": 0.01}
    assert compute_margin(row, requirement) == pytest.approx(0.2)
    assert compute_margin({**row, "map_time_s": 0.02}, requirement) == pytest.approx(-0.4)
    assert compute_margin({**row, "map_time_s": float("nan")}, requirement) == -math.inf
    assert compute_margin({"outcome": "VALID", "answered": True, "image_time_s": 0.02}, requirement) == -math.inf
