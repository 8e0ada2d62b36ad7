"""Tests of `marsyard new` and `marsyard clean`, and of the JSON output of lists."""

import json
import shlex
import tomllib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from typer.testing import CliRunner

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.sampling.design import Design
from marsyard.cli.app import app
from marsyard.cli.estimate import evidence_limits
from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.statistics.sequential import SequentialTest
from marsyard.reports.verdicts import Status
from marsyard.scenarios.template import toml_environment
from tests.command import run_command

#: Fields of EuRoC's sensor.yaml for the first camera.
EUROC = """resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375]
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""


TERRAIN = 'dispersions."location.terrain"'


@pytest.mark.parametrize("text", ["cam 1.cahvor", "caméra.txt", "\U0001f680.csv", 'a "b" \\ c', "del \x7f"])
def test_texts_of_new_campaigns_are_valid_toml(text: str) -> None:
    template = toml_environment().from_string("file = {{ file | toml }}")
    assert tomllib.loads(template.render(file=text)) == {"file": text}


@pytest.fixture
def working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("system", "scenario", "bound", "terrain"),
    [
        ("velocity", "descent", 4.0, "location.terrain"),
        ("landing", "landing", 0.95, "location.terrain"),
        ("tracking", "rover", 0.05, "world.terrain"),
    ],
)
def test_new_campaign_is_valid(working_folder: Path, system: str, scenario: str, bound: float, terrain: str) -> None:
    """Each of 1000 cases has its own terrain: with few terrains the verdict stays INSUFFICIENT."""
    status, output = run_command("new", "mine", "--system", system, "--bound", str(bound), "-n", "1000")
    assert (status, "note:" in output) == (0, False), output
    campaign = load_campaign("mine.toml")
    definition = campaign.definition
    assert (definition.name, definition.scenario, definition.cases) == ("mine", scenario, 1000)
    requirement, availability = definition.requirements
    assert bound in (requirement.bound, requirement.probability)
    # an algorithm that refuses every answer fails the second requirement
    assert availability.metric in ("answered", "site_reported")
    # every dispersion has a source and every table a comment
    assert all(dispersion.source for dispersion in definition.dispersions.values())
    lines = (working_folder / "mine.toml").read_text().splitlines()
    assert sum(line.startswith("#") for line in lines) >= 8
    assert len({campaign.draws(case)[terrain] for case in range(0, 1000, 7)}) == len(range(0, 1000, 7))


def test_new_campaign_without_failures_passes(working_folder: Path) -> None:
    """230 cases without failure show 99 % at 90 % confidence if each has its own terrain."""
    assert run_command("new", "mine", "--system", "velocity", "--site", "gusev", "-n", "230")[0] == 0
    campaign = load_campaign("mine.toml")
    terrains = [campaign.draws(case)["location.terrain"] for case in range(230)]
    frame = pd.DataFrame({"case": range(230), "terrain": terrains, "answered": True, "velocity_error_m_s": 1.0})
    definition = campaign.definition.model_dump(mode="json")
    verdicts = evaluate_requirements(
        frame.assign(outcome="VALID"), definition["requirements"], read_sampling_design(definition)
    )
    assert [(item.status, item.n, item.terrains) for item in verdicts] == 2 * [(Status.PASS, 230, 230)]


def test_limits_of_the_evidence_are_reported_before_a_run(working_folder: Path) -> None:
    """`new` and `--dry-run` report too few cases, too few terrains and designs without independent draws."""
    assert "takes at least 230 cases without a failure; the campaign has 24" in run_command("new", "few")[1]
    assert evidence_limits(load_campaign("few.toml", cases=230)) == []
    (cases,) = evidence_limits(load_campaign("dimes-smoke"))
    assert cases.startswith("DIMES-VEL: 99 % at 90 % confidence takes at least 230 cases")
    assert evidence_limits(load_campaign("dimes-smoke", cases=230)) == []


@pytest.mark.parametrize(
    ("name", "overrides", "supply"),
    [
        ("dimes-smoke", ["location.bank=8"], "has only 8 terrains (location.bank = 8)"),
        ("dimes-smoke", ["location.bank=8", f'{TERRAIN}.distribution="integer"'], "8 terrains (location.bank = 8)"),
        ("dimes-smoke", ["location.terrain=3"], "has only 1 terrain (location.terrain = 1)"),
        ("vtt-terrains", ['dispersions."world.terrain"={low=2,high=5}'], '(dispersions."world.terrain" = 4)'),
    ],
)
def test_advice_about_terrains_can_be_followed_literally(name: str, overrides: list[str], supply: str) -> None:
    """More cases on the same terrains do not add evidence; the options of the advice do."""
    (advice,) = evidence_limits(load_campaign(name, overrides, 1000))
    assert supply in advice
    options = shlex.split(advice.rpartition(": ")[2].removesuffix("."))
    assert options[-2] == "-n"
    further_overrides = [value for option, value in pairwise(options) if option == "--set"]
    campaign = load_campaign(name, [*overrides, *further_overrides], int(options[-1]))
    assert evidence_limits(campaign) == []
    path = "world.terrain" if name == "vtt-terrains" else "location.terrain"
    assert len({campaign.draws(case)[path] for case in range(int(options[-1]))}) == int(options[-1])


@pytest.mark.parametrize(
    ("changes", "min_cases"),
    [
        ({}, 230),
        ({"design": Design(nominal=True)}, 231),
        ({"max_cases": 200}, 299),  # the last look has half of the risk: log(0.05) / log(0.99) = 298.1
        ({"appended": (1,)}, SequentialTest(0.01, 0.1, 199).cases_needed(199, 0)),
    ],
)
def test_minimum_number_of_cases_is_that_of_the_verdict(changes: dict[str, Any], min_cases: int) -> None:
    """A nominal case is no evidence; looks before the last one, and after the first one, cost confidence."""
    campaign = load_campaign("dimes-smoke", cases=199)
    campaign = replace(campaign, definition=campaign.definition.model_copy(update=changes))
    assert f"takes at least {min_cases} cases without a failure" in evidence_limits(campaign)[0]


def test_designs_without_independent_draws_are_reported() -> None:
    sobol_limits = evidence_limits(load_campaign("dimes-smoke", ["design.kind=sobol"], 32))
    assert 'Set design.kind = "random", and run it again.' in sobol_limits[0]


def test_camera_file_is_used_in_the_new_campaign(working_folder: Path) -> None:
    (working_folder / "cam.yaml").write_text(EUROC)
    status, output = run_command("new", "mine", "--system", "velocity", "--camera", "cam.yaml")
    assert status == 0, output
    tables = tomllib.loads((working_folder / "mine.toml").read_text())
    assert tables["parameters"]["camera"]["model"] == "cam.yaml"
    parameters = load_campaign("mine.toml").definition.parameters
    assert parameters["camera"]["model"]["columns"] == 752
    assert parameters["detector"]["rows_summed"] == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--system", "velocity", "--site", "venus"), "venus"),
        (("--system", "velocty"), "unknown system 'velocty' (did you mean 'velocity'?); allowed: landing, tracking"),
        (("--system", "velocity", "--camera", "absent.yaml"), "absent.yaml: file: cannot be read"),
        (("--system", "tracking", "--camera", "cam.yaml"), "see camera.preset"),
        (("--system", "velocity", "--bound", "nan"), "--bound: 'nan' is not allowed; allowed: a number above 0"),
        (("--system", "landing", "--bound", "inf"), "--bound: 'inf' is not allowed; allowed: a number above 0 and"),
        (("--system", "velocity", "--bound", "-5"), "--bound: '-5' is not allowed; allowed: a number above 0"),
        (("--system", "landing", "--flight", "flight.csv"), "only descents accept"),
    ],
)
def test_invalid_options_write_no_campaign(working_folder: Path, arguments: tuple[str, ...], message: str) -> None:
    status, output = run_command("new", "mine", *arguments)
    assert status == 2
    assert message in output
    assert not (working_folder / "mine.toml").exists()


def test_invalid_answers_are_rejected_in_the_dialogue(working_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("marsyard.cli.new._is_terminal", lambda: True)
    # system, site, camera, flight file and bound; invalid answers are asked again
    answers = ["velocty", "velocity", "venus", "meridiani", "absent.yaml", "", "absent.csv", "", "-3", "many", "4"]
    result = CliRunner().invoke(app, ["new", "mine"], input="\n".join(answers) + "\n")
    assert result.exit_code == 0, result.output
    text = " ".join(result.output.split())
    for message in (
        "unknown answer 'velocty' (did you mean 'velocity'?); allowed: landing, tracking, velocity",
        "unknown answer 'venus'; allowed: ",
        "absent.yaml",
        "absent.csv: no such file; allowed: the path of a file, or an empty answer",
        "'-3' is not allowed; allowed: a number above 0",
        "'many' is not allowed",
    ):
        assert message in text
    assert load_campaign("mine.toml").definition.requirements[0].bound == 4.0


def test_existing_campaign_file_is_kept(working_folder: Path) -> None:
    (working_folder / "mine.toml").write_text("existing text")
    status, output = run_command("new", "mine", "--system", "tracking")
    assert status == 2
    assert "mine.toml: the file exists; use --overwrite" in output
    assert run_command("new", "mine", "--system", "tracking", "--site", "venus", "--overwrite")[0] == 2
    assert (working_folder / "mine.toml").read_text() == "existing text"


def test_clean_lists_and_then_removes_files(working_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MARSYARD_CACHE", str(working_folder / "cache"))
    monkeypatch.setenv("MARSYARD_CACHE_GB", "2")
    folder = working_folder / "cache" / "terrain"
    folder.mkdir(parents=True)
    (folder / "one.npy").write_bytes(b"\0" * 3000)
    (folder / "half.part").write_bytes(b"\0" * 500)
    status, output = run_command("clean")
    assert status == 0
    assert "3.5 kB" in output
    assert "2 GB" in output, "the limit of the cache"
    assert "nothing was removed" in output
    assert (folder / "one.npy").exists()
    status, output = run_command("clean", "terrain", "--yes", "--json")
    assert json.loads(output)["removed_bytes"] == 3000
    assert not (folder / "one.npy").exists()
    # a partial file may belong to a running process
    assert (folder / "half.part").exists()
    status, output = run_command("clean", "terrains")
    assert status == 2
    assert "did you mean 'terrain'" in output


def test_lists_are_printed_as_json() -> None:
    campaigns = {entry["name"]: entry for entry in json.loads(run_command("list", "--json")[1])}
    assert campaigns["dimes-smoke"]["cases"] == 24
    sites = {entry["name"]: entry for entry in json.loads(run_command("terrain", "list", "--json")[1])}
    assert sites["gusev"]["planet"] == "Mars"
    assert "descent" in sites["gusev"]["terrain"]
