"""End-to-end test of the advice of an undecided campaign: the printed command decides it."""

import re
import shlex
from pathlib import Path

import pytest

from tests.campaigns.fake_campaign import TOP_LEVEL_KEYS, write_campaign
from tests.command import marsyard
from tests.inline_workers import inline_workers_fixture

#: 99 % at 90 % confidence: 230 answers without a failure at one look, 297 if 24 answers were evaluated before.
REQUIREMENT = """
[[requirements]]
id = "VELOCITY"
statement = "The error is small."
metric = "velocity_error_m_s"
bound = 1000.0
probability = 0.99
confidence = 0.9
population = "POPULATION"
"""
DISPERSIONS = '[dispersions]\nterrain = {distribution = "in-turn", low = 0, high = 99999}'


_inline_workers = inline_workers_fixture()
pytestmark = pytest.mark.usefixtures("_working_folder")


@pytest.fixture
def _working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def write_small_campaign(folder: Path, population: str, unanswered: range, dispersions: str = DISPERSIONS) -> Path:
    return write_campaign(
        folder,
        f"unanswered_cases = {list(unanswered)}",
        top_level_keys=TOP_LEVEL_KEYS.replace("cases = 12", "cases = 24"),
        dispersions=dispersions,
        requirement=REQUIREMENT.replace("POPULATION", population),
    )


@pytest.mark.parametrize(
    ("population", "unanswered", "needed", "appended"),
    [
        ("all", range(0), 273, 273),
        # 24 of 24 answered: at 99 % confidence at least 0.01^(1/24) = 82.5 % of the cases have one; 273 / 0.825 = 331
        pytest.param("valid", range(24, 370, 14), 273, 331, marks=pytest.mark.slow),
    ],
)
def test_printed_command_decides_the_campaign(
    tmp_path: Path, population: str, unanswered: range, needed: int, appended: int
) -> None:
    path = write_small_campaign(tmp_path, population, unanswered)
    status, output, _ = marsyard("run", path, "--out", "run", "--jobs", 2)
    assert status == 3
    assert f"24 cases are too few to decide the requirement. {needed} additional cases" in output
    (command,) = re.findall(r"^to decide: (.+)$", output, re.MULTILINE)
    assert command == f"marsyard append run {appended}"
    status, output, _ = marsyard(*shlex.split(command)[1:])
    assert (status, "verdict: PASS" in output, "to decide:" in output) == (0, True, False), output


@pytest.mark.slow
@pytest.mark.parametrize(("terrains", "condition"), [("99999", ""), ("11", ", and a terrain for each case,")])
def test_new_campaign_of_the_stated_size_is_decided(tmp_path: Path, terrains: str, condition: str) -> None:
    """A campaign with 230 cases has one look and needs fewer cases than the extended one.

    Cases on shared terrains need more: a new campaign without shared terrains is named.
    """
    path = write_small_campaign(tmp_path, "all", range(0), DISPERSIONS.replace("99999", terrains))
    _, output, _ = marsyard("run", path, "--out", "run")
    (cases,) = re.findall(rf"with a new seed{condition} needs only \d+ cases \(-n (\d+)\)", output)
    assert cases == "230"
    path = write_small_campaign(tmp_path, "all", range(0))
    assert marsyard("run", path, "-n", cases, "--seed", 6, "--out", "new")[0] == 0


def test_campaign_with_a_failure_is_not_repeated(tmp_path: Path) -> None:
    """After a failure, only additional cases are advised: a new campaign would discard the failure."""
    path = write_small_campaign(tmp_path, "all", range(5, 6))
    status, output, _ = marsyard("run", path, "--out", "run", "--jobs", 2)
    assert status == 3
    assert "A new campaign" not in output
    # one failure, first look at 24 cases: 573 cases (docs/explanation/statistics.md)
    assert "to decide: marsyard append run 549" in output


@pytest.mark.slow
def test_new_campaign_has_a_terrain_for_each_case(tmp_path: Path) -> None:
    """Cases on shared terrains need more: a new campaign without shared terrains is named, and is decided."""
    shared = DISPERSIONS.replace("99999", "11")
    _, output, _ = marsyard("run", write_small_campaign(tmp_path, "all", range(0), shared), "--out", "run")
    (cases,) = re.findall(r"with a new seed, and a terrain for each case, needs only \d+ cases \(-n (\d+)\)", output)
    assert cases == "230"
    path = write_small_campaign(tmp_path, "all", range(0))
    assert marsyard("run", str(path), "-n", cases, "--seed", "6", "--out", "new", "--jobs", "2")[0] == 0
