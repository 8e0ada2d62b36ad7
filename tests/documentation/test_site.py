"""Tests of the documentation site: no warnings, no broken links, and attributes with a common description apart."""

import os
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

#: The build takes a minute.
pytestmark = pytest.mark.slow

DOCS = Path(__file__).parents[2] / "docs"
#: Minimum number of pages of the site; fewer pages mean that the build skipped some.
MIN_PAGES = 40


class PageParser(HTMLParser):
    """Parser that collects links, loaded files and anchors of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.resources: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = {name: value or "" for name, value in attrs}
        self.anchors.update(attributes[name] for name in ("id", "name") if name in attributes)
        if tag == "a" and "href" in attributes:
            self.links.append(attributes["href"])
        elif tag in ("script", "img") and "src" in attributes:
            self.resources.append(attributes["src"])
        elif tag == "link" and attributes.get("rel") == "stylesheet":
            self.resources.append(attributes["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, PageParser]:
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-E", "-b", "html", "-d", str(out / "trees")]
    result = subprocess.run([*command, str(DOCS), str(out / "html")], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    pages = {path: PageParser(path.read_text(encoding="utf-8")) for path in (out / "html").rglob("*.html")}
    assert len(pages) >= MIN_PAGES
    return pages


def _select_local(targets: list[str]) -> Iterator[tuple[str, str]]:
    """Yield path and fragment of each target without scheme and host, which is a file of the site."""
    for target in targets:
        parts = urlsplit(target)
        if not parts.scheme and not parts.netloc:
            yield unquote(parts.path), unquote(parts.fragment)


def test_links_have_targets(site: dict[Path, PageParser]) -> None:
    broken = []
    for path, page in site.items():
        for target, fragment in _select_local(page.links):
            file = (path.parent / target).resolve() if target else path
            if not file.exists() or (fragment and file in site and fragment not in site[file].anchors):
                broken.append(f"{path.name} -> {target}#{fragment}")
    assert not broken


def test_pages_load_only_files_of_the_site(site: dict[Path, PageParser]) -> None:
    resources = [target for page in site.values() for target in page.resources]
    assert [target for target in resources if urlsplit(target).netloc] == []
    missing = [
        target
        for path, page in site.items()
        for target, _ in _select_local(page.resources)
        if target and not (path.parent / target).exists()
    ]
    assert not missing


def test_every_scenario_has_a_parameter_page(site: dict[Path, PageParser]) -> None:
    from marsyard.scenarios.systems import scenario_names

    names = {path.stem for path in site}
    assert {f"{page}-{name}" for page in ("parameters", "columns") for name in scenario_names()} <= names


#: Module with one description for three attributes, in two lines.
MODULE = '''
class Mean:
    """A mean.

    Attributes
    ----------
    mean, lower, upper
        Mean and its interval,
        both in metres.
    n
        Values.
    """
'''


def test_attributes_in_one_line_are_rendered_separately(tmp_path: Path) -> None:
    source = tmp_path / "docs"
    source.mkdir()
    (tmp_path / "sample_module.py").write_text(MODULE)
    conf = (DOCS / "conf.py").read_text()
    # use the configuration of the site, but do not generate its pages and figures
    for call in ("    write_pages()\n", '    draw_figures(Path(__file__).parent / "generated")\n'):
        assert call in conf
        conf = conf.replace(call, "")
    (source / "conf.py").write_text(conf.replace("Path(__file__).parent))", f"Path({str(DOCS)!r})))"))
    (source / "index.md").write_text("# Index\n\n```{eval-rst}\n.. automodule:: sample_module\n```\n")
    # in a separate process, because pytest would turn the warnings of Sphinx into errors
    command = [sys.executable, "-m", "sphinx", "-q", "-b", "text", str(source), str(tmp_path / "out")]
    subprocess.run(command, check=True, env={**os.environ, "PYTHONPATH": str(tmp_path)}, timeout=120)
    text = (tmp_path / "out" / "index.txt").read_text()
    for name in ("mean", "lower", "upper"):
        assert f"* **{name}** -- Mean and its interval, both in metres." in " ".join(text.split())
    assert "* **n** -- Values." in text
