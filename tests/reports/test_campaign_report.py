from __future__ import annotations

import json
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from marsyard.campaigns.errors import StoreError
from marsyard.reports.campaign import write_report
from marsyard.reports.sections import script_hash

Rows = Callable[..., pd.DataFrame]
MakeRun = Callable[..., Path]
VOID = {"meta", "link", "br", "img", "input", "hr", "path", "use", "circle", "line", "rect"}
#: Columns enough for most of a report; fewer figures are drawn of them.
BARE = ["case", "outcome", "answered", "velocity_error_m_s"]
HOSTILE = "<script>alert('x')</script><img src=x onerror=alert(1)>\"'&{{ 7*7 }}"


class Page(HTMLParser):
    """What a browser would make of a page: its elements, identifiers and references."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.handlers: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag not in VOID:
            self.open.append(tag)
        self._note(attrs)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self._note(attrs)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open, f"</{tag}> closes nothing"
            assert self.open.pop() == tag

    def _note(self, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in ("src", "href", "xlink:href", "action", "data", "srcset", "poster"):
                self.references.append(value or "")
            if name.startswith("on"):
                self.handlers.append(name)


def _read(directory: Path) -> tuple[str, Page, dict[str, Any]]:
    path = write_report(directory)
    assert path == directory / "report.html"
    text = path.read_text(encoding="utf-8")
    return text, Page(text), json.loads((directory / "report.json").read_text(encoding="utf-8"))


def _check(text: str, page: Page) -> None:
    """What holds for every page: well-formed, on its own, nothing that runs but ours, every link leads somewhere."""
    assert page.open == []
    assert len(page.ids) == len(set(page.ids))
    # Data, and the one script that the page's policy names by its hash.
    running = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    assert page.tags.count("script") == 2 * len(running) <= 2
    for script in running:
        assert f"script-src '{script_hash(script)}'" in text
    assert ("script-src" in text) == bool(running)
    assert "link" not in page.tags
    assert "iframe" not in page.tags
    assert page.handlers == []
    for reference in page.references:
        assert reference.startswith(("#", "data:image/png;base64,"))
        assert not reference.startswith("#") or reference[1:] in page.ids
    for target in re.findall(r"url\(([^)]*)\)", text):
        assert target.strip("'\"")[1:] in page.ids
    assert "@import" not in text
    assert "default-src 'none'" in text


#: Columns of a whole report, with one driver only.
CORE = [*BARE, "velocity_error_x_m_s", "velocity_error_y_m_s", "terrain", "off_nadir_max_deg", "error", "traceback"]
RUNS: dict[str, Callable[[Rows], pd.DataFrame]] = {
    "small": lambda rows: rows(24)[CORE],
    "large": lambda rows: rows(2000, spread=1.5, terrains=60)[CORE],
    "crashed": lambda rows: rows(24, crashed=3)[CORE],
    "only crashed": lambda rows: rows(4, crashed=4)[CORE],
    "no answer": lambda rows: rows(24, answered=0.0)[CORE],
    "one case": lambda rows: rows(1, answered=1.0)[CORE],
    "no rows": lambda rows: rows(24).head(0),
    "exact": lambda rows: rows(24, answered=1.0, spread=0.0)[CORE],
    "few columns": lambda rows: rows(24)[["case", "outcome"]],
    "only cases": lambda rows: rows(24)[["case"]],
    "wild": lambda rows: rows(24)[CORE].assign(velocity_error_m_s=np.geomspace(1e-9, 1e9, 24)),
    "infinite": lambda rows: rows(24)[CORE].assign(velocity_error_x_m_s=np.inf),
}


@pytest.mark.parametrize("kind", RUNS)
def test_report_of_any_run(make_rows: Rows, make_run: MakeRun, kind: str) -> None:
    text, page, twin = _read(make_run(RUNS[kind](make_rows)))
    _check(text, page)
    assert twin["schema"] == 4
    assert twin["verdict"] in text
    assert len(text) < 1_000_000


def test_small_report_says_what_a_board_asks(
    make_rows: Rows, make_run: MakeRun, dimes_products: dict[str, Any]
) -> None:
    directory = make_run(make_rows(24, crashed=1), products=dimes_products)
    text, page, twin = _read(directory)
    _check(text, page)
    plain = " ".join(re.sub(r"<[^>]+>", " ", text).split())
    for message in (
        "INSUFFICIENT",
        "DIMES-VEL",
        "share 4 terrains",
        "1 case crashed",
        "RuntimeError: the context is lost",
        f"marsyard replay {directory} 23",
        "marsyard run dimes-synthetic -n 24 --seed 7",
        "0123456789abcdef0123456789abcdef01234567",
        "uniform(low=20.0, high=60.0)",
        "landing season",
        "+14.10 m/s east",
    ):
        assert message in plain, message
    assert "case-3" in page.ids
    assert page.tags.count("svg") > 8
    assert twin["exit_code"] == 1
    assert twin["verdicts"][0]["clustered"]["terrains"] == 4
    assert len(text) < 2_000_000


def test_report_without_requirements(make_rows: Rows, make_run: MakeRun) -> None:
    text, page, twin = _read(make_run(make_rows(24)[CORE], []))
    _check(text, page)
    assert "asks for no requirement" in text
    assert (twin["exit_code"], twin["verdicts"]) == (0, [])
    assert "velocity error (m/s)" in text


def test_a_rate_that_is_met_has_its_own_word_colour_and_sign(
    make_rows: Rows, make_run: MakeRun, velocity: dict[str, Any]
) -> None:
    rate = {**velocity, "probability": 0.9, "confidence": 0.999, "decide_by": "estimate"}
    directory = make_run(make_rows(24)[BARE], [rate])
    text, _, twin = _read(directory)
    assert '<div class="headline status-met-by-rate">' in text
    assert ".status-met-by-rate { --status: var(--rate)" in text
    assert "(decided by rate)." in text
    diamond = "M12 1L23 12 12 23 1 12z"
    assert diamond in text.split("<span>MET BY RATE</span>")[0].rsplit("<svg", 1)[1]
    assert (twin["verdict"], twin["exit_code"]) == ("MET BY RATE", 3)


def test_four_terrains_show_little_however_many_cases_they_bear(make_rows: Rows, make_run: MakeRun) -> None:
    text, _, twin = _read(make_run(make_rows(400, answered=1.0, spread=0.1)[[*BARE, "terrain"]]))
    assert (twin["verdict"], twin["verdicts"][0]["plain_status"]) == ("INSUFFICIENT", "PASS")
    assert "400 cases share 4 terrains and so are not independent" in text


def test_everything_from_files_is_shown_as_text(
    make_rows: Rows, make_run: MakeRun, velocity: dict[str, Any], dimes_products: dict[str, Any]
) -> None:
    frame = make_rows(24, crashed=2)[CORE]
    frame["outcome"] = frame["outcome"].replace("VALID", HOSTILE)
    frame = frame.assign(error=HOSTILE, traceback=HOSTILE, site=[HOSTILE, "b"] * 12, gl_version=HOSTILE)
    frame[f"{HOSTILE}_deg"] = np.arange(24.0)
    products = {**dimes_products, "tracks_columns": [*dimes_products["tracks_columns"][:-1], HOSTILE]}
    directory = make_run(
        frame,
        [{**velocity, "id": HOSTILE, "statement": HOSTILE}, {**velocity, "metric": HOSTILE, "population": HOSTILE}],
        products=products,
        name=HOSTILE.replace("/", "_"),
        description=HOSTILE,
        seed=HOSTILE,
        versions={HOSTILE: HOSTILE},
        environment={HOSTILE: {HOSTILE: HOSTILE}},
        dispersions={HOSTILE: {"distribution": HOSTILE, "source": HOSTILE, HOSTILE: HOSTILE}},
        git_commit=HOSTILE,
        state=HOSTILE,
        showcase_differs=[HOSTILE],
    )
    text, page, _ = _read(directory)
    _check(text, page)
    assert "img" not in page.tags
    assert "&lt;script&gt;" in text
    assert "49" not in re.findall(r"alert\(1\)&gt;&#34;&#39;&amp;(\S+)", text)


@pytest.mark.parametrize(
    "record",
    [
        "",
        "[]",
        "null",
        "{not json",
        '{"requirements": "all", "configuration": 7, "dispersions": [1], "versions": null, "showcase": "x"}',
        '{"requirements": [1, null, {}], "environment": "x", "configuration": {"dispersions": {"a": 1}}}',
        '{"name": "\\ud800", "seed": [1], "description": {"a": "b"}}',
    ],
)
def test_damaged_record(make_rows: Rows, make_run: MakeRun, record: str) -> None:
    directory = make_run(make_rows(6)[BARE])
    (directory / "campaign.json").write_text(record, encoding="utf-8")
    text, page, _ = _read(directory)
    _check(text, page)


def test_missing_record_and_damaged_products(make_rows: Rows, make_run: MakeRun) -> None:
    directory = make_run(make_rows(6)[BARE], products={"image_1": np.zeros((4, 4))})
    (directory / "campaign.json").unlink()
    (directory / "cases" / "3" / "products.npz").write_bytes(b"not an archive")
    (directory / "cases" / "not-a-number").mkdir()
    text, page, _ = _read(directory)
    _check(text, page)


def test_interrupted_campaign_says_so(make_rows: Rows, make_run: MakeRun) -> None:
    text, _, twin = _read(make_run(make_rows(6)[BARE], state="interrupted", cases=24))
    assert "Not finished." in text
    assert twin["state"] == "interrupted"


def test_folder_without_rows_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"cases\.parquet"):
        write_report(tmp_path)
    (tmp_path / "cases.parquet").write_bytes(b"not a table")
    with pytest.raises(StoreError, match="cannot be read"):
        write_report(tmp_path)


def test_same_files_same_page(make_rows: Rows, make_run: MakeRun) -> None:
    directory = make_run(make_rows(24)[[*BARE, "off_nadir_max_deg", "terrain"]])
    first = write_report(directory).read_bytes()
    assert write_report(directory).read_bytes() == first
