"""Tests that all commands have a help text, and that commands which only print have a JSON option."""

from collections.abc import Iterator

import typer
from typer.core import TyperCommand, TyperGroup

from marsyard.cli.app import app

#: Commands that only print, and commands that write files. Each command is in one of the two sets.
PRINTING = {
    "list", "show", "clean", "conformance", "confirmations", "doctor", "compare", "terrain list", "terrain stats",
}  # fmt: skip
WRITING = {
    "run", "resume", "append", "merge", "replay", "report", "dashboard", "nightly", "gallery", "render", "dataset",
    "new", "ingest", "export", "score", "compile", "rare", "search", "budget", "robust", "assure",
}  # fmt: skip


def walk_commands(group: TyperGroup, prefix: str = "") -> Iterator[tuple[str, TyperCommand]]:
    for name, command in group.commands.items():
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
