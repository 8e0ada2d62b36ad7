from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from marsyard.campaigns.definition.loading import catalogue, load_campaign
from marsyard.campaigns.definition.requirements import read_requirements, select_applicable, shipped_requirements
from marsyard.campaigns.errors import ConfigurationError
from tests.campaigns.fake_campaign import write_campaign

NAMED = {
    "DIMES-VEL": 5.0, "DIMES-HARM": 5.0, "DIMES-AVAIL": None, "VTT-POS": 0.03, "VTT-TRACK": None, "VTT-HARM": None,
    "HDA-SAFE": None, "HDA-POS": 2.0, "HDA-TIME": 2.0,
}  # fmt: skip


def test_shipped_requirements_state_their_source() -> None:
    # Issue 8 names these, and their bounds.
    shipped = shipped_requirements()
    assert {name: one.bound for name, one in shipped.items()} == NAMED
    assert all(one.kind and one.source and one.statement and one.campaigns for one in shipped.values())


def test_every_campaign_that_a_requirement_names_is_there() -> None:
    patterns = [pattern for one in shipped_requirements().values() for pattern in one.campaigns]
    assert set(patterns) <= set(catalogue())


@pytest.mark.parametrize("name", catalogue())
def test_campaigns_state_every_requirement_that_names_them(name: str) -> None:
    """Both ways: a requirement's list of campaigns, and the campaigns' lists of requirements."""
    shipped = shipped_requirements()
    asked = {one.id for one in load_campaign(name).configuration.requirements if one.id in shipped}
    assert asked == {one["id"] for one in select_applicable(list(shipped.values()), name)}


@pytest.mark.parametrize("name", catalogue())
def test_campaigns_state_known_requirements(name: str) -> None:
    for asked in load_campaign(name).configuration.requirements:
        stated = shipped_requirements().get(asked.id)
        if stated is not None:
            assert (asked.metric, asked.bound, asked.kind) == (stated.metric, stated.bound, stated.kind)
            assert select_applicable([stated], name)


def test_a_campaign_may_change_population_and_confidence(tmp_path: Path) -> None:
    path = write_campaign(
        tmp_path, requirement='[[requirements]]\nid = "DIMES-VEL"\npopulation = "valid and clear"\nprobability = 0.9\n'
    )
    (asked,) = load_campaign(str(path)).configuration.requirements
    assert (asked.metric, asked.bound, asked.confidence) == ("velocity_error_m_s", 5.0, 0.9)
    assert (asked.population, asked.probability) == ("valid and clear", 0.9)


@pytest.mark.parametrize(
    ("entry", "message"),
    [('id = "DIMES-VEE"', "did you mean 'DIMES-VEL'"), ('id = "DIMES-VEL"\nbound = 9.0', "requirements[0].bound")],
)
def test_unknown_requirement_names_are_reported(tmp_path: Path, entry: str, message: str) -> None:
    path = write_campaign(tmp_path, requirement=f"[[requirements]]\n{entry}\n")
    with pytest.raises(ConfigurationError) as raised:
        load_campaign(str(path))
    assert message in str(raised.value)


ONE = '[[requirements]]\nid = "A"\nmetric = "answered"\nprobability = 0.9\nconfidence = 0.9\ncampaigns = ["dimes-*"]\n'


def test_requirements_apply_by_patterns(tmp_path: Path) -> None:
    path = tmp_path / "asked.toml"
    path.write_text(ONE)
    (asked,) = select_applicable(read_requirements(path), "dimes-gusev")
    assert (asked["id"], "campaigns" in asked) == ("A", False)
    assert select_applicable(read_requirements(path), "vtt-roll") == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("not toml", "not valid TOML"),
        (ONE + "bounds = 3\n", "requirements[0].bounds"),
        (ONE + ONE, "share an id: A"),
        ("", "requirements"),
    ],
)
def test_a_file_that_states_no_requirements_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "asked.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as raised:
        read_requirements(path)
    assert message in str(raised.value)


def test_a_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="cannot be read"):
        read_requirements(tmp_path / "none.toml")


def test_texts_of_requirements_name_no_algorithm() -> None:
    # the algorithm that is judged is the user's choice: the reports name it
    named = re.compile(r"\b(DIMES|VTT|HDA|NCC)\b(?! paper)")
    for name, path in catalogue().items():
        campaign = tomllib.loads(path.read_text(encoding="utf-8"))
        texts = [campaign["description"], *(one.get("statement", "") for one in campaign.get("requirements", ()))]
        assert not [text for text in texts if named.search(text)], name
    assert not [one.statement for one in shipped_requirements().values() if named.search(one.statement)]
