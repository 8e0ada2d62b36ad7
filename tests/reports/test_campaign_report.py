"""Tests of the report page: valid markup, content, escaping of texts and damaged runs."""

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
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.hidden_folders import hide_folders
from marsyard.campaigns.store.record import describe_machine
from marsyard.reports.campaign_report import create_subject, write_report
from marsyard.reports.common_sections import answer_fractions
from marsyard.reports.evaluation import evaluate_run
from marsyard.reports.page_environment import script_hash
from marsyard.reports.report_file import SCHEMA
from tests.reports.synthetic_run import MIN_COLUMNS, VELOCITY, MakeRun, make_rows

VOID_ELEMENTS = {"meta", "link", "br", "img", "input", "hr", "path", "use", "circle", "line", "rect"}
#: Text that would run a script or a template if it were not escaped.
HOSTILE = "<script>alert('x')</script><img src=x onerror=alert(1)>\"'&{{ 7*7 }}"


class PageParser(HTMLParser):
    """Parser that collects a page's elements, identifiers, references and event handlers."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.handlers: list[str] = []
        self.open_tags: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag not in VOID_ELEMENTS:
            self.open_tags.append(tag)
        self._record_attributes(attrs)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self._record_attributes(attrs)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID_ELEMENTS:
            assert self.open_tags, f"</{tag}> closes nothing"
            assert self.open_tags.pop() == tag

    def _record_attributes(self, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in ("src", "href", "xlink:href", "action", "data", "srcset", "poster"):
                self.references.append(value or "")
            if name.startswith("on"):
                self.handlers.append(name)


def _write_and_read(directory: Path) -> tuple[str, PageParser, dict[str, Any]]:
    path = write_report(directory)
    assert path == directory / "report.html"
    text = path.read_text(encoding="utf-8")
    return text, PageParser(text), json.loads((directory / "report.json").read_text(encoding="utf-8"))


def _check_page(text: str, page: PageParser) -> None:
    """Check that a page is well formed and self-contained, and that its links have targets."""
    assert page.open_tags == []
    assert len(page.ids) == len(set(page.ids))
    # one data element per script; the content security policy names the script by its hash
    scripts = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    assert page.tags.count("script") == 2 * len(scripts) <= 2
    for script in scripts:
        assert f"script-src '{script_hash(script)}'" in text
    assert ("script-src" in text) == bool(scripts)
    assert "link" not in page.tags
    assert "iframe" not in page.tags
    assert page.handlers == []
    for reference in page.references:
        assert reference.startswith(("#", "data:image/png;base64,", "data:image/webp;base64,"))
        assert not reference.startswith("#") or reference[1:] in page.ids
    for target in re.findall(r"url\(([^)]*)\)", text):
        assert target.strip("'\"")[1:] in page.ids
    assert "@import" not in text
    assert "default-src 'none'" in text


#: Columns of a full report with one driver.
FULL_COLUMNS = [*MIN_COLUMNS, "velocity_error_x_m_s", "velocity_error_y_m_s", "terrain", "off_nadir_max_deg"]
FULL_COLUMNS += ["error", "traceback"]
RUNS: dict[str, Callable[[], pd.DataFrame]] = {
    "small": lambda: make_rows(24)[FULL_COLUMNS],
    "large": lambda: make_rows(2000, error_scale=1.5, terrains=60)[FULL_COLUMNS],
    "crashed": lambda: make_rows(24, n_crashed=3)[FULL_COLUMNS],
    "only crashed": lambda: make_rows(4, n_crashed=4)[FULL_COLUMNS],
    "no answer": lambda: make_rows(24, answer_rate=0.0)[FULL_COLUMNS],
    "one case": lambda: make_rows(1, answer_rate=1.0)[FULL_COLUMNS],
    "no rows": lambda: make_rows(24).head(0),
    "exact": lambda: make_rows(24, answer_rate=1.0, error_scale=0.0)[FULL_COLUMNS],
    "no errors": lambda: make_rows(24)[["case", "outcome"]],
    "only cases": lambda: make_rows(24)[["case"]],
    "wide range": lambda: make_rows(24)[FULL_COLUMNS].assign(velocity_error_m_s=np.geomspace(1e-9, 1e9, 24)),
    "infinite": lambda: make_rows(24)[FULL_COLUMNS].assign(velocity_error_x_m_s=np.inf),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", RUNS)
def test_report_is_valid_for_any_run(make_run: MakeRun, kind: str) -> None:
    text, page, report = _write_and_read(make_run(RUNS[kind]()))
    _check_page(text, page)
    assert report["schema"] == SCHEMA
    assert report["verdict"] in text
    assert len(text) < 1_000_000


def test_small_report_contains_the_main_results(make_run: MakeRun, dimes_products: dict[str, Any]) -> None:
    directory = make_run(make_rows(24, n_crashed=1)[FULL_COLUMNS], products=dimes_products)
    text, page, report = _write_and_read(directory)
    _check_page(text, page)
    visible_text = " ".join(re.sub(r"<[^>]+>", " ", text).split())
    for message in (
        "INSUFFICIENT",
        "DIMES-VEL",
        "lie on 4 terrains, of which",
        "1 case crashed",
        "RuntimeError: the context is lost",
        f"marsyard replay {directory} 23",
        "marsyard run dimes-synthetic -n 24 --seed 7",
        "0123456789abcdef0123456789abcdef01234567",
        "uniform, 20.0 to 60.0",
        "landing season",
        "+14.10 m/s east",
    ):
        assert message in visible_text, message
    assert "case-3" in page.ids
    assert page.tags.count("svg") > 8
    assert report["exit_code"] == 1
    assert report["verdicts"][0]["clustered"]["terrains"] == 4
    assert len(text) < 2_000_000


@pytest.mark.usefixtures("plain_figures")
def test_requirement_met_by_rate_has_its_own_symbol(make_run: MakeRun) -> None:
    requirement = {**VELOCITY, "probability": 0.9, "confidence": 0.999, "decide_by": "estimate"}
    directory = make_run(make_rows(24)[MIN_COLUMNS], [requirement])
    text, _, report = _write_and_read(directory)
    assert '<div class="headline status-met-by-rate">' in text
    assert ".status-met-by-rate { --status: var(--rate)" in text
    assert "evaluated by the observed rate, with bounds at" in text
    diamond_path = "M12 1L23 12 12 23 1 12z"
    assert diamond_path in text.split("<span>MET BY RATE</span>")[0].rsplit("<svg", 1)[1]
    assert (report["verdict"], report["exit_code"]) == ("MET BY RATE", 3)


def test_texts_from_files_are_escaped(make_run: MakeRun, dimes_products: dict[str, Any]) -> None:
    frame = make_rows(24, n_crashed=2)[FULL_COLUMNS]
    frame["outcome"] = frame["outcome"].replace("VALID", HOSTILE)
    frame = frame.assign(error=HOSTILE, traceback=HOSTILE, site=[HOSTILE, "b"] * 12, gl_version=HOSTILE)
    frame[f"{HOSTILE}_deg"] = np.arange(24.0)
    products = {**dimes_products, "tracks_columns": [*dimes_products["tracks_columns"][:-1], HOSTILE]}
    directory = make_run(
        frame,
        [{**VELOCITY, "id": HOSTILE, "statement": HOSTILE}, {**VELOCITY, "metric": HOSTILE, "population": HOSTILE}],
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
    text, page, _ = _write_and_read(directory)
    _check_page(text, page)
    assert "img" not in page.tags
    assert "&lt;script&gt;" in text
    # the template expression {{ 7*7 }} is not evaluated to 49
    assert "49" not in re.findall(r"alert\(1\)&gt;&#34;&#39;&amp;(\S+)", text)


@pytest.mark.parametrize(
    "record",
    [
        "",
        "[]",
        "null",
        "{not json",
        '{"requirements": "all", "definition": 7, "dispersions": [1], "versions": null, "showcase": "x"}',
        '{"requirements": [1, null, {}], "environment": "x", "definition": {"dispersions": {"a": 1}}}',
        '{"name": "\\ud800", "seed": [1], "description": {"a": "b"}}',
    ],
)
@pytest.mark.usefixtures("plain_figures")
def test_damaged_record_gives_a_valid_page(make_run: MakeRun, record: str) -> None:
    directory = make_run(make_rows(6)[MIN_COLUMNS])
    (directory / "campaign.json").write_text(record, encoding="utf-8")
    text, page, _ = _write_and_read(directory)
    _check_page(text, page)


@pytest.mark.usefixtures("plain_figures")
def test_missing_record_and_damaged_products_give_a_valid_page(make_run: MakeRun) -> None:
    directory = make_run(make_rows(6)[MIN_COLUMNS], products={"image_1": np.zeros((4, 4))})
    (directory / "campaign.json").unlink()
    (directory / "cases" / "3" / "products.npz").write_bytes(b"not an archive")
    (directory / "cases" / "not-a-number").mkdir()
    text, page, _ = _write_and_read(directory)
    _check_page(text, page)


@pytest.mark.usefixtures("plain_figures")
def test_interrupted_campaign_is_marked(make_run: MakeRun) -> None:
    text, _, report = _write_and_read(make_run(make_rows(6)[MIN_COLUMNS], state="interrupted", cases=24))
    assert "Not finished." in text
    assert report["state"] == "interrupted"


def test_folder_without_valid_row_table_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"cases\.parquet"):
        write_report(tmp_path)
    (tmp_path / "cases.parquet").write_bytes(b"not a table")
    with pytest.raises(StoreError, match="cannot be read"):
        write_report(tmp_path)


@pytest.mark.slow
def test_report_is_reproducible(make_run: MakeRun) -> None:
    directory = make_run(make_rows(24)[[*MIN_COLUMNS, "off_nadir_max_deg", "terrain"]])
    first = write_report(directory).read_bytes()
    assert write_report(directory).read_bytes() == first


def test_wrong_answers_are_counted_in_the_unit_of_the_metric(make_run: MakeRun) -> None:
    """The requirement multiplies the metric by 60: 60 x 0.05 is above the bound of 2, 60 x 0.01 is not."""
    frame = make_rows(24).assign(velocity_error_m_s=np.where(np.arange(24) < 6, 0.05, 0.01), answered=True)
    requirement = {"id": "SCALED", "metric": "velocity_error_m_s", "bound": 2.0, "scale": 60.0}
    directory = make_run(frame=frame, requirements=[requirement | {"probability": 0.9, "confidence": 0.9}])
    subject = create_subject(evaluate_run(directory))
    assert subject.bound == pytest.approx(2.0 / 60.0)
    answers = answer_fractions(subject)
    wrong_answers = next(fraction for name, fraction in answers.items() if name.startswith("wrong"))
    assert (wrong_answers.hits, wrong_answers.n) == (6, 24)


def test_reports_contain_no_folder_of_the_user(
    make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "home of alice"
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("MARSYARD_CACHE", "/scratch/alice/cache")
    command = {"words": ["marsyard", "run", f"{home}/x.toml"], "folder": str(home / "my project")}
    environment = {"machine": "x86_64", "variables": {"MARSYARD_TOKEN": "secret"}}
    frame = make_rows(12, n_crashed=1)[FULL_COLUMNS].assign(
        error=f"cannot read {home}/a.npy, /scratch/alice/cache/terrain/1.npy"
    )
    directory = make_run(frame, command=command, environment=environment, name="home of alice/run")
    write_report(directory)
    for path in directory.iterdir():
        if path.name not in ("campaign.json", "cases.parquet", "cases.sqlite"):
            text = path.read_text(encoding="utf-8")
            assert not [word for word in (str(home), "/scratch/alice", "MARSYARD_TOKEN", "secret") if word in text], (
                path
            )
    assert "cd ~/&#39;my project&#39;" in (directory / "report.html").read_text(encoding="utf-8")


def test_records_contain_no_variables_and_no_folder_of_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MARSYARD_TOKEN", "secret")
    assert "secret" not in json.dumps(describe_machine())
    monkeypatch.setenv("HOME", str(tmp_path))
    assert hide_folders(f"cannot read '{tmp_path}/a', {tmp_path}-b") == f"cannot read '~/a', {tmp_path}-b"
    assert hide_folders(f"{tmp_path}.b is not in {tmp_path}.") == f"{tmp_path}.b is not in ~."
    assert ExecutorConfig(cluster="tcp://login.example:8786").describe() == "cluster"
