"""The shell completes commands and their options, as `marsyard --install-completion` sets it up."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from marsyard.cli.app import app


@pytest.mark.parametrize(
    ("words", "place", "completed"),
    [("marsyard con", 1, {"conformance"}), ("marsyard clean --y", 2, {"--yes"}), ("marsyard terrain l", 2, {"list"})],
)
def test_words_are_completed(words: str, place: int, completed: set[str]) -> None:
    environment = {"_MARSYARD_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(place)}
    ended = CliRunner().invoke(app, [], prog_name="marsyard", env=environment)
    assert set(ended.output.split()) == completed


def test_it_is_set_up_as_the_readme_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("typer._completion_shared._get_shell_name", lambda: "bash")
    monkeypatch.setenv("HOME", str(tmp_path))
    ended = CliRunner().invoke(app, ["--install-completion"], prog_name="marsyard")
    assert ended.exit_code == 0, ended.output
    assert "marsyard" in (tmp_path / ".bashrc").read_text()
    assert "marsyard --install-completion" in (Path(__file__).parents[2] / "docs" / "commands.md").read_text()
