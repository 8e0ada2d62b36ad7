"""Functions for the tests of campaigns: write and run campaign files of the fake scenario."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import append_cases, resume_campaign, run_campaign
from marsyard.campaigns.store import record
from marsyard.campaigns.store.origin import describe_origin
from marsyard.campaigns.store.table import read_rows

#: Writes a campaign file, see `write_campaign`; the folder is given.
CampaignFile = Callable[..., Path]
TOP_LEVEL_KEYS = """
name = "fake"
scenario = "tests.campaigns.fake_scenario:FakeScenario"
description = "a campaign without terrain"
cases = 12
seed = 5
"""
DISPERSIONS = """
[dispersions]
"wind.east_m_s" = {distribution = "uniform", low = -30, high = 30, source = "test"}
altitude_m = {distribution = "normal", mean = 2000, sd = 100, truncate = [1700, 2200]}
terrain = {distribution = "integer", low = 0, high = 3}
kind = {distribution = "choice", values = ["rough", "plain"], weights = [1, 3]}
"heights_m.1" = {distribution = "normal", mean = 3, sd = 1}
"""
REQUIREMENT = """
[[requirements]]
id = "velocity"
statement = "the error is small"
metric = "velocity_error_m_s"
bound = 5.0
probability = 0.99
confidence = 0.9
"""
#: Case 3 raises, case 5 aborts its process, case 2 has no answer.
FAILING_CASES = "raising_cases = [3]\naborting_cases = [5]\nunanswered_cases = [2]"


def write_campaign(
    folder: Path,
    parameters: str = "",
    *,
    top_level_keys: str = TOP_LEVEL_KEYS,
    dispersions: str = DISPERSIONS,
    requirement: str = REQUIREMENT,
    extra_tables: str = "",
) -> Path:
    """Write a campaign file; the arguments are its TOML texts, in the order of the file. Return its path."""
    path = folder / "fake.toml"
    path.write_text(f"{top_level_keys}\n[parameters]\n{parameters}\n{dispersions}\n{requirement}\n{extra_tables}\n")
    return path


class RecordingWatch:
    """A progress watch that records stages, steps and notes without printing."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.steps: dict[str, int] = {}
        self._stage = ""

    def begin(self, stage: str, total: int) -> None:
        self._stage = stage
        self.steps[stage] = 0

    def step(self) -> None:
        self.steps[self._stage] += 1

    def note(self, text: str) -> None:
        self.notes.append(text)


def run(path: Path, directory: Path, watch: RecordingWatch, *overrides: str, jobs: int = 1) -> Path:
    """Run a campaign file with overrides of its keys; return the campaign folder."""
    run_campaign(load_campaign(str(path), overrides), directory, ExecutorConfig(jobs), watch)
    return directory


def sign_folder(directory: Path) -> None:
    """Make a folder, whose record a test has changed, one that was created here."""
    record.update(directory, {"origin": describe_origin(record.stored_definition(directory))})


def read_case_rows(directory: Path) -> list[dict[str, Any]]:
    return read_rows(directory / "cases.parquet")


def to_toml(value: object) -> str:
    """Format a value as TOML on one line; each character of a text is escaped."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{to_toml(str(key))} = {to_toml(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(to_toml, value)) + "]"
    if isinstance(value, str):
        return '"' + "".join(f"\\U{ord(character):08x}" for character in value) + '"'
    return str(value).lower()


def campaign_fixture(text: str) -> Any:
    """Return a fixture that writes a campaign file with this text and returns its path."""

    @pytest.fixture
    def campaign_path(tmp_path: Path) -> Path:
        path = tmp_path / "campaign.toml"
        path.write_text(text)
        return path

    return campaign_path


def continuing_commands(directory: Path, watch: RecordingWatch) -> list[Callable[[], None]]:
    """Return the commands that continue a campaign: `resume`, and `append` with one case."""
    executor = ExecutorConfig(1)
    return [lambda: resume_campaign(directory, executor, watch), lambda: append_cases(directory, 1, executor, watch)]
