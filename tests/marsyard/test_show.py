"""Tests of `marsyard show`: dispersions, draws as table, figure and JSON, and invalid campaign files."""

import json
import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.command import marsyard

CAMPAIGN = """
name = "fake"
scenario = "tests.campaigns.fake_scenario:FakeScenario"
description = "a campaign without terrain"
cases = 25
seed = 5

[design]
kind = "latin-hypercube"
nominal = true

[parameters]
shared = 3
wind = { east_m_s = 1.0, north_m_s = 2.0 }

[dispersions]
"wind.east_m_s" = { distribution = "normal", mean = 5.0, source = "flown" }
"wind.north_m_s" = { distribution = "normal", mean = 0.0, source = "flown", unit = "m/s", description = "to the north" }
altitude_m = { distribution = "gamma", a = 3.0, loc = 1500.0, scale = "100 + 2 * terrain", truncate = [1500.0, 3000.0] }
lowest_altitude_m = { distribution = "derived", formula = "altitude_m - 100" }
terrain = { distribution = "integer", low = 0, high = "shared" }
kind = { distribution = "choice", values = ["rough", "plain"], weights = [1.0, 3.0] }
error_scale = { distribution = "grid", low = 0.5, high = 1.5, levels = 3 }
sleep_s = { distribution = "fixed", value = 0.0 }

[[correlations]]
parameters = ["wind.east_m_s", "wind.north_m_s"]
covariance = [[9.0, 3.0], [3.0, 4.0]]
source = "assumed"

[[requirements]]
id = "velocity"
statement = "the error is small"
metric = "velocity_error_m_s"
bound = 5.0
probability = 0.99
confidence = 0.9

[retain]
showcase = "worst"
"""


@pytest.fixture
def campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("COLUMNS", "160")
    path = tmp_path / "fake.toml"
    path.write_text(CAMPAIGN)
    return path


def test_every_dispersion_is_reported(campaign: Path) -> None:
    result = marsyard("show", campaign)
    assert (result.status, result.err) == (0, "")
    for text in (
        "sampling: Latin hypercube at each point of a grid over error_scale; case 0 is the nominal case",
        "normal(mean=5.0, sd=3.0)",
        "flown",
        "to the north",
        "gamma(truncate=[1500.0, 3000.0], a=3.0, loc=1500.0, scale=100 + 2 *",
        "by formula",
        "0.5 to 1.5",
        "no source",
        "covariance",
        "dispersed; nominal 2000.0",
    ):
        assert text in re.sub(r"\s+", " ", result.out.replace("│", " ")) or text in result.out, text


def test_units_and_descriptions_come_from_the_scenario() -> None:
    output = json.loads(marsyard("show", "dimes-gusev", "--json").out)
    dispersions = {dispersion["parameter"]: dispersion for dispersion in output["dispersions"]}
    sun = dispersions["sun.elevation_deg"]
    assert (sun["unit"], sun["description"], sun["bounds"]) == (
        "deg",
        "elevation of the sun above the horizon",
        [30.0, 60.0],
    )
    assert all(dispersion["source"] for dispersion in output["dispersions"])
    assert all(dispersion["description"] for dispersion in output["dispersions"])


def test_campaign_with_a_nominal_case_only_has_no_draws(tmp_path: Path) -> None:
    path = tmp_path / "nominal.toml"
    path.write_text(CAMPAIGN.partition("[dispersions]")[0].replace("latin-hypercube", "random"))
    result = marsyard("show", path, "--draw", 2)
    assert result.status == 0, result.text
    assert "Draws of 0 cases" in result.text


def test_draws_are_shown_as_table_json_and_figure(campaign: Path, tmp_path: Path) -> None:
    figure = tmp_path / "draws.svg"
    result = marsyard("show", campaign, "--draw", 25, "--figure", figure)
    assert (result.status, result.err) == (0, "")
    assert "Draws of 24 cases" in result.out
    assert "nominal" in result.out
    assert f"figure: {figure}" in result.out
    assert "<svg" in figure.read_text()
    output = json.loads(marsyard("show", campaign, "--draw", 25, "--json").out)
    assert [draw["case"] for draw in output["draws"]] == list(range(25))
    assert output["draws"][0]["values"]["wind.east_m_s"] == 1.0
    values = [draw["values"] for draw in output["draws"]]
    assert all(draw["lowest_altitude_m"] == pytest.approx(draw["altitude_m"] - 100.0) for draw in values)
    assert [draw["error_scale"] for draw in values[1:4]] == [0.5, 1.0, 1.5]
    assert f"{min(draw['altitude_m'] for draw in values[1:]):.5g}" in result.out
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--draw", "0"], "--draw 0: the campaign has 25 cases; allowed: 1 to 25"),
        (["--draw", "26"], "allowed: 1 to 25"),
        (["--figure", "x.svg"], "give the number of cases with --draw N"),
        (["--draw", "3", "--figure", "x.pdf"], "--figure x.pdf: unknown file format; allowed: .svg, .png"),
        (["--draw", "1", "--figure", "x.png"], "no parameter is drawn in 1 case"),
        (["--draw", "3", "--figure", "/no/x.png"], "/no/x.png: cannot be written"),
        (["--set", "cases=26"], "--set cases=26: cases: 25 cases after the nominal case do not fit"),
    ],
)
def test_invalid_options_are_rejected(campaign: Path, arguments: list[str], message: str) -> None:
    result = marsyard("show", campaign, *arguments)
    assert (result.status, result.out) == (2, "")
    assert "Traceback" not in result.err
    assert message in result.err


@given(text=st.binary(max_size=60) | st.text("[]{}=\"'.,abc123\n#\\", max_size=60).map(str.encode))
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_random_bytes_are_rejected_without_traceback(campaign: Path, text: bytes) -> None:
    campaign.write_bytes(text)
    result = marsyard("show", campaign)
    assert (result.status, result.out) == (2, "")
    assert str(campaign) in result.err
    assert "Traceback" not in result.err


@pytest.mark.parametrize(
    "line",
    [
        'dispersions."\\u001b[2J\\n" = {distribution = "\\u001b[31m\\n"}',
        f"seed = {'9' * 5000}",
        f"seed = {2**63}",
        f"values = {'[' * 500}{']' * 500}",
        f"dispersions.kind = {{distribution = 'choice', values = [{'[' * 400}1{']' * 400}]}}",
        "dispersions.kind = {distribution = 'choice', values = ['a', nan]}",
        "dispersions.kind = {distribution = 'fixed', value = 2020-01-01}",
        "parameters.altitude_m = 1979-05-27T07:32:00Z",
        "dispersions.altitude_m = {distribution = 'uniform', low = -1e308, high = 1e308}",
        "dispersions.altitude_m = {distribution = 'grid', low = 1.0, high = 2.0, step = 1e-9}",
        "dispersions.altitude_m = {distribution = 'derived', formula = 'altitude_m'}",
        "dispersions.altitude_m = {distribution = 'derived', formula = 'heights_m[7]'}",
        "dispersions.altitude_m = {distribution = 'derived', formula = 'kind'}",
        "dispersions.altitude_m = {distribution = 'erlang', a = 1e300, scale = 1e300}",
    ],
)
def test_extreme_values_are_rejected(campaign: Path, line: str) -> None:
    header = "name = 'fake'\nscenario = 'tests.campaigns.fake_scenario:FakeScenario'\ncases = 3\n"
    campaign.write_text(header + line)
    result = marsyard("show", campaign)
    assert (result.status, result.out) == (2, "")
    assert "Traceback" not in result.err
    assert "\x1b" not in result.err
    key = re.split(r"[ =\"]", line)[0]
    assert key.rpartition(".")[2] in result.err or "not valid TOML" in result.err
