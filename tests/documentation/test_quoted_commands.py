"""Tests that the commands in the pages, and their options, exist, and that the page on algorithms names all of them."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from marsyard.scenarios.imports import import_object
from marsyard.scenarios.systems import systems
from tests.documentation.test_links import GENERATED, PAGES, ROOT
from tests.marsyard.test_commands import list_commands

#: A command with its arguments: a line of a code block, or inline code.
LINE = re.compile(r"^(?:\$ | {4})?(marsyard [a-z][^\n]*(?:\\\n[^\n]*)*)|`(marsyard [a-z][^`]*)`", re.MULTILINE)
OPTION = re.compile(r"(?<=\s)--?[a-z][a-z-]*")


def find_commands(text: str) -> Iterator[str]:
    """Yield commands without comments and quoted arguments."""
    for match in LINE.finditer(text):
        yield re.sub(r"'[^']*'|\"[^\"]*\"|\s#.*", "", " ".join((match[1] or match[2]).replace("\\\n", " ").split()))


@pytest.mark.parametrize("page", [page for page in PAGES if page.parent != GENERATED], ids=lambda page: page.name)
def test_commands_and_options_exist(page: Path) -> None:
    commands = list_commands()
    unknown = []
    for text in find_commands(page.read_text(encoding="utf-8")):
        words = text.split()[1:]
        name = " ".join(words[:2]) if words[0] == "terrain" else words[0]
        allowed = (
            {option for parameter in commands[name].params for option in parameter.opts} if name in commands else None
        )
        if allowed is None or not {*OPTION.findall(text)} <= allowed:
            unknown.append(text)
    assert unknown == []


def test_commands_are_found() -> None:
    text = "Run `marsyard run mine.toml\n--jobs 2` and\n\n    marsyard list --sort   # not --json\n    $ ls\n"
    assert list(find_commands(text)) == ["marsyard run mine.toml --jobs 2", "marsyard list --sort"]


def test_page_names_every_included_algorithm() -> None:
    page = (ROOT / "docs" / "custom-algorithms.md").read_text(encoding="utf-8")
    tasks = [import_object(task) for system in systems() for task in system.tasks]
    names = {name for task in tasks for name in task.shipped if not name.endswith(("-plus", "-custom"))}
    assert len(names) > 10
    assert names - set(re.findall(r"`([a-z-]+)`", page)) == set()
