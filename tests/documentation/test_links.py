"""Tests that links, code, keys and commands of the pages exist; `test_site` checks the built site."""

import pydoc
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from docs import pages
from marsyard.scenarios.imports import import_object
from marsyard.scenarios.systems import scenario_names, systems
from tests.marsyard.test_commands import list_commands

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
#: Pages that the build of the site generates.
GENERATED = ROOT / "docs" / "reference" / "generated"
#: Groups of entry points, whose names are no modules.
ENTRY_POINT_GROUPS = {f"marsyard.{group}" for group in ("dynamics", "instruments", "scores", "systems")}


def _read_prose(path: Path) -> str:
    """Read a page without its code blocks."""
    return re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def _find_anchors(text: str) -> set[str]:
    """Return the anchors of a page: headings in lower case, with hyphens for spaces, numbered if they repeat."""
    anchors: set[str] = set()
    for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE):
        title = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading.strip().lower())
        name = re.sub(r"[^\w\- ]", "", title).replace(" ", "-")
        anchors.add(next(text for text in (name, *(f"{name}-{n}" for n in range(1, 100))) if text not in anchors))
    return anchors


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(page: Path) -> None:
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`]*`", "", _read_prose(page))):
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        if "://" in target or path.is_relative_to(GENERATED) or path.parent.name == "generated":
            continue
        has_anchor = (
            not anchor or path.suffix != ".md" or not path.exists() or anchor in _find_anchors(_read_prose(path))
        )
        if not path.exists() or not has_anchor:
            broken.append(target)
    assert broken == []


def test_architecture_names_existing_code() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    # modules of a system are relative to `scenarios`
    paths = re.findall(r"`(\w+/[\w/]+(?:\.py)?)`", text)
    assert len(paths) > 10
    assert [path for path in paths if not any((ROOT / parent / path).exists() for parent in (".", "scenarios"))] == []


def test_modules_and_objects_of_pages_exist() -> None:
    """Decision records are left out: they name the code of their time."""
    texts = [page.read_text(encoding="utf-8") for page in PAGES if page.parent.name not in ("adr", "generated")]
    names = {name for text in texts for name in re.findall(r"\bmarsyard(?:\.[A-Za-z]\w*)+", text)} - ENTRY_POINT_GROUPS
    assert len(names) > 80
    assert [name for name in names if pydoc.locate(name) is None] == []


#: Keys of the modules and files that pages use as examples, and of the campaign itself.
EXAMPLE_KEYS = ("flight.options.", "dispersions.")


def read_keys(name: str) -> set[str]:
    return set(re.findall(r"^\| `([^`]+)`", pages.format_parameters(name), re.MULTILINE))


def test_options_of_algorithms_are_listed_with_their_descriptions() -> None:
    rows = {line.split("`")[1]: line for line in pages.format_parameters("landing").splitlines() if "| `hda." in line}
    assert rows["hda.track_seed"].startswith(
        "| `hda.track_seed` | `unchanged` or `poses` | `unchanged` | Start of the "
    )
    # two options with one description
    for name, default in (("max_tilt_change_rad", "0.349066"), ("max_roll_change_rad", "0.174533")):
        assert rows[f"hda.{name}"].startswith(f"| `hda.{name}` | number | `{default}` | Limits of the image pairs: ")
    # options within options
    assert "lvs.imu.gyro_bias_deg_h" in read_keys("localisation")


@pytest.mark.parametrize("name", scenario_names())
def test_types_of_parameters_are_words(name: str) -> None:
    """A class name in the column of types means that the keys of its table are missing."""
    assert re.findall(r"^\| `[^`]+` \| `[A-Z]\w*[a-z]\w*`", pages.format_parameters(name), re.MULTILINE) == []


def test_keys_of_commands_exist() -> None:
    named = {
        key
        for page in PAGES
        for key in re.findall(r"--set ['\"]?([a-z_][\w.]*)=", page.read_text(encoding="utf-8"))
        if not key.startswith(EXAMPLE_KEYS)
    }
    assert len(named) > 15
    assert named - {key for name in scenario_names() for key in read_keys(name)} == set()


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
