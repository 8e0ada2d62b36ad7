"""What holds for the command line as a whole."""

from __future__ import annotations

from collections.abc import Iterator

import typer
from typer.core import TyperCommand, TyperGroup

from marsyard.cli.app import app

#: Commands that list, show or examine, and those that make something: each command is one or the other.
LISTING = {"list", "show", "clean", "conformance", "doctor", "compare", "terrain list", "terrain stats"}
MAKING = {
    "run", "resume", "append", "replay", "report", "dashboard", "nightly", "gallery", "render", "dataset", "new",
    "ingest", "export", "score", "compile",
}  # fmt: skip


def commands(group: TyperGroup, prefix: str = "") -> Iterator[tuple[str, TyperCommand]]:
    for name, command in group.commands.items():
        if isinstance(command, TyperGroup):
            yield from commands(command, f"{prefix}{name} ")
        elif isinstance(command, TyperCommand):
            yield prefix + name, command


def all_commands() -> dict[str, TyperCommand]:
    root = typer.main.get_command(app)
    assert isinstance(root, TyperGroup)
    return dict(commands(root))


def test_every_command_that_lists_has_json() -> None:
    found = all_commands()
    assert set(found) == LISTING | MAKING
    given = {name for name, command in found.items() if any("--json" in one.opts for one in command.params)}
    assert given == LISTING


def test_every_command_says_what_it_does() -> None:
    assert [name for name, command in all_commands().items() if not command.help] == []
