"""The documentation's site builds without a warning, and every link in it leads somewhere."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

DOCS = Path(__file__).parents[2] / "docs"
MIN_PAGES = 40


class Page(HTMLParser):
    """What a page links to, what it loads, and the anchors that it has."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.anchors.update(given[name] for name in ("id", "name") if name in given)
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        elif tag in ("script", "img") and "src" in given:
            self.loads.append(given["src"])
        elif tag == "link" and given.get("rel") == "stylesheet":
            self.loads.append(given["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Page]:
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-E", "-b", "html", "-d", str(out / "trees")]
    done = subprocess.run([*command, str(DOCS), str(out / "html")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in (out / "html").rglob("*.html")}
    assert len(pages) >= MIN_PAGES
    return pages


def _local(targets: list[str]) -> Iterator[tuple[str, str]]:
    """Path and fragment of each target that is no address elsewhere."""
    for target in targets:
        parts = urlsplit(target)
        if not parts.scheme and not parts.netloc:
            yield unquote(parts.path), unquote(parts.fragment)


def test_every_link_leads_somewhere(site: dict[Path, Page]) -> None:
    broken = []
    for path, page in site.items():
        for target, fragment in _local(page.links):
            file = (path.parent / target).resolve() if target else path
            if not file.exists() or (fragment and file in site and fragment not in site[file].anchors):
                broken.append(f"{path.name} -> {target}#{fragment}")
    assert not broken


def test_pages_load_nothing_from_elsewhere(site: dict[Path, Page]) -> None:
    loaded = [one for page in site.values() for one in page.loads]
    assert [one for one in loaded if urlsplit(one).netloc] == []
    missing = [
        one for path, page in site.items() for one, _ in _local(page.loads) if one and not (path.parent / one).exists()
    ]
    assert not missing


def test_every_scenario_has_a_page_of_its_keys(site: dict[Path, Page]) -> None:
    from marsyard.scenarios.systems import scenario_names

    names = {path.stem for path in site}
    assert {f"parameters-{name}" for name in scenario_names()} <= names
