"""`marsyard new` writes campaigns that run as they are written; `marsyard clean` and the lists as JSON."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.cli.app import app
from marsyard.cli.outcome import evidence_limits
from marsyard.reports.sampling_design import sampled
from marsyard.reports.verdicts import Status, judge_campaign

#: EuRoC's first camera (its sensor.yaml), of the fields that are read.
EUROC = """resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375]
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def reported(*words: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, list(words))
    return result.exit_code, result.output


@pytest.mark.parametrize(
    ("system", "scenario", "bound"),
    [("velocity", "descent", 4.0), ("landing", "landing", 0.95), ("tracking", "rover", 0.05)],
)
def test_a_new_campaign_is_one(here: Path, system: str, scenario: str, bound: float) -> None:
    status, output = reported("new", "mine", "--system", system, "--bound", str(bound), "-n", "30")
    assert status == 0, output
    configuration = load_campaign("mine.toml").configuration
    assert (configuration.name, configuration.scenario, configuration.cases) == ("mine", scenario, 30)
    (asked,) = configuration.requirements
    assert bound in (asked.bound, asked.probability)
    # what it disperses says where that is from, and every table has a comment before it
    assert all(one.source for one in configuration.dispersions.values())
    lines = (here / "mine.toml").read_text().splitlines()
    assert sum(line.startswith("#") for line in lines) >= 8
    assert load_campaign("mine.toml").draws(3)


@pytest.mark.parametrize("system", ["velocity", "landing", "tracking"])
def test_each_case_of_a_new_campaign_has_a_terrain_of_its_own(here: Path, system: str) -> None:
    """A bank of 2 terrains kept the verdict of any number of cases INSUFFICIENT."""
    status, output = reported("new", "mine", "--system", system, "-n", "1000")
    assert (status, "note:" in output) == (0, False), output
    campaign = load_campaign("mine.toml")
    path = "world.terrain" if system == "tracking" else "location.terrain"
    assert len({campaign.draws(case)[path] for case in range(0, 1000, 7)}) == len(range(0, 1000, 7))


def test_a_new_campaign_without_failures_passes(here: Path) -> None:
    """230 cases show 99 % at 90 % confidence, on the terrains that the campaign draws."""
    assert reported("new", "mine", "--system", "velocity", "--site", "gusev", "-n", "230")[0] == 0
    campaign = load_campaign("mine.toml")
    terrains = [campaign.draws(case)["location.terrain"] for case in range(230)]
    frame = pd.DataFrame({"case": range(230), "terrain": terrains, "answered": True, "velocity_error_m_s": 1.0})
    plain = campaign.configuration.model_dump(mode="json")
    (verdict,) = judge_campaign(frame.assign(outcome="VALID"), plain["requirements"], sampled(plain))
    assert (verdict.status, verdict.n, verdict.terrains) == (Status.PASS, 230, 230)


def test_what_limits_the_evidence_is_printed_before_a_run(here: Path) -> None:
    """`new` and `--dry-run` name too few cases, too few terrains, and designs that are no random draws."""
    assert "takes at least 230 cases without a failure, and 24 are asked for" in reported("new", "few")[1]
    assert evidence_limits(load_campaign("few.toml", cases=230)) == []
    cases, terrains = evidence_limits(load_campaign("dimes-smoke"))
    assert cases.startswith("DIMES-VEL: 99 % at 90 % confidence takes at least 230 cases")
    assert "draws from 8 terrains (location.bank = 8)" in terrains
    assert "--set location.bank=2300 -n 254" in terrains
    advised = load_campaign("dimes-smoke", ["location.bank=2300"], 254)
    assert evidence_limits(advised) == []
    # more cases on the same terrains do not help
    (terrains,) = evidence_limits(load_campaign("dimes-smoke", cases=1000))
    assert "draws from 8 terrains" in terrains
    grid = evidence_limits(load_campaign("dimes-smoke", ["design.kind=sobol"], 32))
    assert 'Set design.kind = "random", and run it again.' in grid[0]


def test_own_files_are_named_in_it(here: Path) -> None:
    (here / "cam.yaml").write_text(EUROC)
    status, output = reported("new", "mine", "--system", "velocity", "--camera", "cam.yaml")
    assert status == 0, output
    tables = tomllib.loads((here / "mine.toml").read_text())
    assert tables["parameters"]["camera"]["model"] == "cam.yaml"
    parameters = load_campaign("mine.toml").configuration.parameters
    assert parameters["camera"]["model"]["columns"] == 752
    assert parameters["detector"]["rows_summed"] == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--system", "velocity", "--site", "venus"), "venus"),
        (
            ("--system", "velocty"),
            "unknown system 'velocty' (did you mean 'velocity'?); allowed: landing, tracking, velocity",
        ),
        (("--system", "velocity", "--camera", "absent.yaml"), "absent.yaml: file: cannot be read"),
        (("--system", "tracking", "--camera", "cam.yaml"), "see camera.preset"),
        (("--system", "landing", "--flight", "flight.csv"), "only descents fly"),
    ],
)
def test_what_cannot_run_is_not_written(here: Path, words: tuple[str, ...], message: str) -> None:
    status, output = reported("new", "mine", *words)
    assert status == 2
    assert message in output
    assert not (here / "mine.toml").exists()


def test_answers_of_the_dialogue_are_refused_at_once(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("marsyard.cli.new._is_terminal", lambda: True)
    answers = ["velocty", "velocity", "venus", "meridiani", "absent.yaml", "", "absent.csv", "", "-3", "many", "4"]
    result = CliRunner().invoke(app, ["new", "mine"], input="\n".join(answers) + "\n")
    assert result.exit_code == 0, result.output
    text = " ".join(result.output.split())
    for message in (
        "unknown answer 'velocty' (did you mean 'velocity'?); allowed: landing, tracking, velocity",
        "unknown answer 'venus'; allowed: ",
        "absent.yaml",
        "absent.csv: no such file; allowed: the path of a file, or nothing",
        "'-3' is not allowed; allowed: a number above 0",
        "'many' is not allowed",
    ):
        assert message in text
    assert load_campaign("mine.toml").configuration.requirements[0].bound == 4.0


def test_files_that_are_there_stay(here: Path) -> None:
    (here / "mine.toml").write_text("precious")
    status, output = reported("new", "mine", "--system", "tracking")
    assert status == 2
    assert "mine.toml: there already; --overwrite" in output
    assert reported("new", "mine", "--system", "tracking", "--site", "venus", "--overwrite")[0] == 2
    assert (here / "mine.toml").read_text() == "precious"


def test_clean_shows_and_then_removes(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MARSYARD_CACHE", str(here / "cache"))
    monkeypatch.setenv("MARSYARD_CACHE_GB", "2")
    folder = here / "cache" / "terrain"
    folder.mkdir(parents=True)
    (folder / "one.npy").write_bytes(b"\0" * 3000)
    (folder / "half.part").write_bytes(b"\0" * 500)
    status, output = reported("clean")
    assert status == 0
    assert "3.5 kB" in output
    assert "2 GB" in output, "the limit of the cache"
    assert "nothing was removed" in output
    assert (folder / "one.npy").exists()
    status, output = reported("clean", "terrain", "--yes", "--json")
    assert json.loads(output)["removed_bytes"] == 3000
    assert not (folder / "one.npy").exists()
    # what another process writes just now stays
    assert (folder / "half.part").exists()
    status, output = reported("clean", "terrains")
    assert status == 2
    assert "did you mean 'terrain'" in output


def test_lists_as_json() -> None:
    campaigns = {one["name"]: one for one in json.loads(reported("list", "--json")[1])}
    assert campaigns["dimes-smoke"]["cases"] == 24
    sites = {one["name"]: one for one in json.loads(reported("terrain", "list", "--json")[1])}
    assert sites["gusev"]["planet"] == "Mars"
    assert "descent" in sites["gusev"]["terrain"]
