"""Test that links in the Markdown pages, and code that they name, exist; `test_site` checks the built site."""

import pydoc
import re
from pathlib import Path

import pytest

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
