"""Fixtures of the tests of commands: repositories with confirmations."""

from pathlib import Path

import pytest

from tests.marsyard.confirmation_project import Command, confirm, copy_project, create_project, make_command


@pytest.fixture
def marsyard(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Command:
    """Create a repository with a campaign of 10 cases, and return a function that runs the command line in it."""
    create_project(tmp_path)
    return make_command(monkeypatch, tmp_path)


@pytest.fixture(scope="session")
def _confirmed_project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("confirmed")
    create_project(folder)
    with pytest.MonkeyPatch.context() as patch:
        assert confirm(make_command(patch, folder), "run-1") == (0, ["PASS"])
    return folder


@pytest.fixture
def confirmed(_confirmed_project: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Command:
    """Like `marsyard`, with a confirmation `run-1` that passed; its record is not committed."""
    copy_project(_confirmed_project, tmp_path)
    return make_command(monkeypatch, tmp_path)
