"""Tests of all commands: help texts, JSON options, exit statuses and commands of the documentation, completion."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from typer.core import TyperCommand, TyperGroup
from typer.testing import CliRunner

from marsyard.cli.app import app
from marsyard.cli.errors import Exit

PAGE = (Path(__file__).parents[2] / "docs" / "commands.md").read_text(encoding="utf-8")

#: Commands that only print, and commands that write files. Each command is in one of the two sets.
PRINTING = {
    "list", "show", "clean", "conformance", "confirmations", "doctor", "compare", "terrain list", "terrain stats",
}  # fmt: skip
WRITING = {
    "run", "resume", "append", "merge", "replay", "report", "dashboard", "nightly", "gallery", "render", "dataset",
    "new", "ingest", "export", "score", "compile", "rare", "search", "budget", "robust", "assure",
}  # fmt: skip


def walk_commands(group: TyperGroup, prefix: str = "") -> Iterator[tuple[str, TyperCommand]]:
    for name in group.list_commands(typer.Context(group)):
        command = group.get_command(typer.Context(group), name)
        if isinstance(command, TyperGroup):
            yield from walk_commands(command, f"{prefix}{name} ")
        elif isinstance(command, TyperCommand):
            yield prefix + name, command


def list_commands() -> dict[str, TyperCommand]:
    root = typer.main.get_command(app)
    assert isinstance(root, TyperGroup)
    return dict(walk_commands(root))


def test_printing_commands_have_a_json_option() -> None:
    commands = list_commands()
    assert set(commands) == PRINTING | WRITING
    with_json = {
        name for name, command in commands.items() if any("--json" in option.opts for option in command.params)
    }
    assert with_json == PRINTING


def test_every_command_has_a_help_text() -> None:
    assert [name for name, command in list_commands().items() if not command.help] == []


def test_help_and_page_state_every_exit_status() -> None:
    assert app.info.epilog is not None
    statuses = {str(int(status)) for status in Exit}
    assert set(re.findall(r"\b\d+\b", app.info.epilog)) == statuses
    assert set(re.findall(r"^\| (\d+) \|", PAGE, re.MULTILINE)) == statuses


def test_page_has_an_example_of_every_command() -> None:
    named = set(re.findall(r"`marsyard (terrain \w+|\w+)", PAGE))
    # `terrain list` has no table row of its own: `terrain stats` stands for both
    assert set(list_commands()) - named == {"terrain list"}


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
    assert "marsyard --install-completion" in PAGE
