"""Tests of shell completion and of `marsyard --install-completion`."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from marsyard.cli.app import app


@pytest.mark.parametrize(
    ("command_line", "word_index", "completions"),
    [("marsyard confo", 1, {"conformance"}), ("marsyard clean --y", 2, {"--yes"}), ("marsyard terrain l", 2, {"list"})],
)
def test_words_are_completed(command_line: str, word_index: int, completions: set[str]) -> None:
    environment = {"_MARSYARD_COMPLETE": "complete_bash", "COMP_WORDS": command_line, "COMP_CWORD": str(word_index)}
    result = CliRunner().invoke(app, [], prog_name="marsyard", env=environment)
    assert set(result.output.split()) == completions


def test_installation_writes_the_shell_configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("typer._completion_shared._get_shell_name", lambda: "bash")
    monkeypatch.setenv("HOME", str(tmp_path))
    result = CliRunner().invoke(app, ["--install-completion"], prog_name="marsyard")
    assert result.exit_code == 0, result.output
    assert "marsyard" in (tmp_path / ".bashrc").read_text()
    assert "marsyard --install-completion" in (Path(__file__).parents[2] / "docs" / "commands.md").read_text()
