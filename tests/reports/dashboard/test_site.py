"""Tests of the dashboard: list of campaigns, pages, links, escaping of texts and sparklines."""

import csv
import io
import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
from markupsafe import escape

from marsyard.campaigns.definition.requirements import shipped_requirements
from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store import record
from marsyard.reports import signature
from marsyard.reports.campaign_report import write_report
from marsyard.reports.dashboard.entries import find_campaigns, make_slug, read_entries
from marsyard.reports.dashboard.excerpts import read_excerpts
from marsyard.reports.dashboard.requirement_rows import margin_text, requirement_rows, sparkline
from marsyard.reports.dashboard.site import write_site
from marsyard.reports.page_environment import script_hash
from marsyard.reports.requirement_cases import CaseFinder
from marsyard.reports.verdicts import Status, Verdict
from tests.reports.synthetic_run import MIN_COLUMNS, VELOCITY, MakeRun, make_rows, write_table_with_seal

pytestmark = pytest.mark.usefixtures("plain_figures")
#: Text that would run a script or leave the folder of the site if it were not escaped.
HOSTILE = "<script>alert('x')</script><img src=x onerror=alert(1)>\"'../../{{ 7*7 }}"


def _write_index(tmp_path: Path) -> str:
    write_site(tmp_path / "site", [tmp_path])
    return (tmp_path / "site" / "index.html").read_text(encoding="utf-8")


def test_index_lists_all_requirements_and_campaigns(make_run: MakeRun, tmp_path: Path) -> None:
    for day in (1, 2, 3):
        make_run(make_rows(8, seed=day)[MIN_COLUMNS], name=f"run-{day}", started_utc=f"2026-01-0{day}T00:00:00Z")
    text = _write_index(tmp_path)
    for name in shipped_requirements():
        assert f'data-requirement="{name}"' in text
    # only DIMES-VEL has stored campaigns
    assert text.count("No stored campaign tests this requirement.") == len(shipped_requirements()) - 1
    assert len(re.findall(r'<tr id="dimes-synthetic-', text)) == 3
    assert '<svg class="spark"' in text
    assert "3 stored campaigns" in text
    coverage = re.search(r'<ul class="coverage".*?</ul>', text, re.DOTALL)
    assert coverage is not None
    coverage_text = " ".join(re.sub(r"<[^>]+>", " ", coverage[0]).split())
    assert coverage_text == f"INSUFFICIENT 1 NO CAMPAIGN {len(shipped_requirements()) - 1}"
    matrix = list(csv.DictReader(io.StringIO((tmp_path / "site" / "verification.csv").read_text())))
    verdicts = {row["requirement"]: row["verdict"] for row in matrix}
    assert (verdicts["DIMES-VEL"], verdicts["HDA-POS"]) == ("INSUFFICIENT", "NO CAMPAIGN")


def test_finished_campaigns_precede_interrupted_ones(make_run: MakeRun, tmp_path: Path) -> None:
    paths = []
    for day, (name, state) in enumerate([("a", "finished"), ("b", "finished"), ("c", "interrupted")], start=1):
        record_changes = {"started_utc": f"2026-01-0{day}T00:00:00Z", "state": state}
        frame = make_rows(8, seed=day)[MIN_COLUMNS].assign(site=["east", "west"] * 4, algorithm="mine")
        record = make_run(frame, **record_changes) / "campaign.json"
        paths.append(record.parent.rename(tmp_path / name))
        text = (tmp_path / name / "campaign.json").read_text()
        (tmp_path / name / "campaign.json").write_text(text.replace("dimes-synthetic", f"dimes-{name}"))
    entries, problems = read_entries(paths, tmp_path / "pages")
    assert problems == []
    assert [entry.name for entry in entries] == ["dimes-c", "dimes-b", "dimes-a"]
    assert (entries[0].sites, entries[0].algorithms) == (("east", "west"), ("mine",))
    row = next(row for row in requirement_rows(entries, {}) if row.requirement == "DIMES-VEL")
    assert [cell.entry.name for cell in row.cells] == ["dimes-b", "dimes-a", "dimes-c"]


def test_confirmations_precede_later_explorations(make_run: MakeRun, tmp_path: Path) -> None:
    """A FAIL of a confirmation is the headline also after explorations with PASS, which are marked everywhere."""
    requirement = {**VELOCITY, "population": "all", "probability": 0.8}
    confirmation = {"kind": "confirmation", "number": 1, "claim": "0f", "record": str(tmp_path / "none.jsonl")}
    for day, (name, error, evidence) in enumerate([("old", 9.0, confirmation), ("b", 1.0, None), ("c", 1.0, None)]):
        frame = make_rows(12, answer_rate=1.0).assign(velocity_error_m_s=error)[MIN_COLUMNS]
        make_run(frame, [requirement], name=name, evidence=evidence, started_utc=f"2026-01-0{day + 1}T00:00:00Z")
    site = tmp_path / "site"
    write_site(site, [tmp_path / name for name in ("old", "b", "c")])
    entries, _ = read_entries([tmp_path / name for name in ("old", "b", "c")], tmp_path / "pages")
    (row,) = requirement_rows(entries, {})
    assert [cell.word for cell in row.all_cells] == ["FAIL", "PASS (exploration)", "PASS (exploration)"]
    assert (row.latest, row.trend) == (row.all_cells[0], None)
    (row,) = requirement_rows(entries[:2], {})
    assert (row.cells[0].word, row.trend is None) == ("PASS (exploration)", False)
    matrix = list(csv.DictReader(io.StringIO((entries[1].folder / "verification.csv").read_text())))
    assert [cells["verdict"] for cells in matrix] == ["PASS (exploration)"]
    assert "<system-out>PASS (exploration). " in (entries[1].folder / "junit.xml").read_text()
    assert '"PASS (exploration)"' in (site / "index.html").read_text()


@pytest.mark.slow
def test_links_have_targets_in_the_site(make_run: MakeRun, tmp_path: Path, dimes_products: dict[str, Any]) -> None:
    make_run(make_rows(24)[MIN_COLUMNS], products=dimes_products)
    _write_index(tmp_path)
    site = tmp_path / "site"
    pages = list(site.rglob("index.html")) + list(site.rglob("case-*.html"))
    assert any(page.name == "case-3.html" for page in pages)
    for page in pages:
        for link in re.findall(r' href="(?!data:)([^"#]+)', page.read_text(encoding="utf-8")):
            target = (page.parent / link).resolve()
            assert target.is_relative_to(site.resolve())
            assert target.is_file(), link
    assert (next(site.glob("c/*")) / "report.html").is_file()


def test_pages_of_an_own_report_repeat_it_without_evaluating_or_drawing(
    make_run: MakeRun, tmp_path: Path, dimes_products: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A campaign costs neither an evaluation nor a figure: both are parts of the report that this user has written."""
    rows = make_rows(12, error_scale=4.0)[MIN_COLUMNS]
    directory = make_run(rows, products=dimes_products)
    report = write_report(directory).read_text(encoding="utf-8")

    def fail(*_: Any, **__: Any) -> None:
        raise AssertionError("evaluated or drawn again")

    for name in ("marsyard.reports.dashboard.entries.evaluate_run", "marsyard.reports.section.svg_markup"):
        monkeypatch.setattr(name, fail)
    monkeypatch.setattr(CaseFinder, "__init__", fail)
    assert write_site(tmp_path / "site", [directory]).campaigns == 1
    (folder,) = (tmp_path / "site" / "c").iterdir()
    case, index = ((folder / name).read_text(encoding="utf-8") for name in ("case-3.html", "index.html"))
    assert (folder / "report.html").read_text(encoding="utf-8") == report
    figures = report.partition('<article id="case-3"')[2].partition("</article>")[0].count("<svg")
    assert case.count("<svg") == figures > 0
    assert f"<h1>Case 3: {rows['outcome'][3]}</h1>" in case
    assert '<th scope="row">velocity_error_m_s</th>' in case
    assert f"marsyard replay {directory} 3" in case
    assert 'href="case-3.html"' in index
    assert report.count('class="violation"') == index.count('class="violation"') > 0


def test_changed_requirement_is_marked_and_comes_last(make_run: MakeRun, tmp_path: Path) -> None:
    shared = shipped_requirements()["DIMES-VEL"].to_table()
    for day, probability in ((1, 0.99), (2, 0.5)):
        requirement = {**shared, "probability": probability}
        rows = make_rows(12, error_scale=0.1)[MIN_COLUMNS]
        make_run(rows, [requirement], name=f"run-{day}", started_utc=f"2026-01-0{day}T00:00:00Z")
    entries, _ = read_entries(find_campaigns([tmp_path]), tmp_path / "pages")
    row = next(row for row in requirement_rows(entries, shipped_requirements()) if row.requirement == "DIMES-VEL")
    assert [(cell.word, cell.basis.partition("; holds")[0]) for cell in row.all_cells] == [
        ("INSUFFICIENT", ""),
        ("PASS (exploration)", "changed by the campaign: required rate 50 %, not 99 %"),
    ]


def test_report_on_other_requirements_is_not_that_of_the_campaign(make_run: MakeRun, tmp_path: Path) -> None:
    directory = make_run(make_rows(6)[MIN_COLUMNS])
    write_report(directory, [{**VELOCITY, "probability": 0.1}])
    assert not signature.is_own_report(directory, directory)
    (entry,), _ = read_entries([directory], tmp_path / "pages")
    assert entry.report.verdicts[0].probability == VELOCITY["probability"]


def test_reports_of_another_program_are_written_again(
    make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = make_run(make_rows(6)[MIN_COLUMNS])
    write_report(directory)
    monkeypatch.setattr(signature, "hash_program", lambda: "another version")
    assert not signature.is_own_report(directory, directory)
    write_site(tmp_path / "site", [directory])
    assert signature.is_own_report(next((tmp_path / "site" / "c").iterdir()), directory)


def test_values_of_a_campaign_cannot_end_a_part_of_its_report() -> None:
    value = escape('</article><article id="case-9" aria-label="x"><script>')
    report = f'<article class="lists">{value}<a href="#case-2">Case 2</a></article>'
    excerpts = read_excerpts(f'{report}<article id="case-2" aria-label="Case 2">{value}</article>')
    assert excerpts.lists == f'{value}<a href="case-2.html">Case 2</a>'
    assert excerpts.cases == {2: value}


def test_security_policy_contains_the_hash_of_the_script(make_run: MakeRun, tmp_path: Path) -> None:
    make_run(make_rows(6)[MIN_COLUMNS])
    text = _write_index(tmp_path)
    (script,) = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    assert f"script-src '{script_hash(script)}'" in text
    assert "default-src 'none'" in text


def test_texts_are_escaped_and_files_stay_in_the_site(make_run: MakeRun, tmp_path: Path) -> None:
    frame = make_rows(12, n_crashed=1)[[*MIN_COLUMNS, "error"]].assign(error=HOSTILE)
    parameters = {"site": HOSTILE, "algorithm": HOSTILE}
    directory = make_run(frame, [{**VELOCITY, "id": HOSTILE, "statement": HOSTILE}], name="hostile", git_commit=HOSTILE)
    record = (directory / "campaign.json").read_text()
    hostile_record = {**json.loads(record), "name": HOSTILE, "state": HOSTILE, "started_utc": HOSTILE}
    hostile_record["definition"]["parameters"] = parameters
    (directory / "campaign.json").write_text(json.dumps(hostile_record))
    text = _write_index(tmp_path)
    assert "alert('x')</script>" not in text
    assert "<img" not in text
    assert "{{ 7*7 }}" in text  # not evaluated as a template
    pages = [path for path in tmp_path.rglob("*.html") if directory not in path.parents]
    assert all((tmp_path / "site") in path.parents for path in pages)


def test_folder_names_have_only_letters_digits_and_hyphens(tmp_path: Path) -> None:
    for name in ("../../etc/passwd", "", "ä/\x00", "a" * 500):
        slug = make_slug(tmp_path, name)
        assert re.fullmatch(r"[A-Za-z0-9-]{1,80}", slug)
    assert make_slug(tmp_path / "a", "x") != make_slug(tmp_path / "b", "x")


def test_overlapping_search_folders_list_each_campaign_once(make_run: MakeRun, tmp_path: Path) -> None:
    first = make_run(make_rows(6)[MIN_COLUMNS], name="a/b")
    make_run(make_rows(6)[MIN_COLUMNS], name="c")
    assert find_campaigns([tmp_path, first, tmp_path / "a"]) == [first, tmp_path / "c"]
    assert find_campaigns([tmp_path / "nowhere"]) == []


def test_unreadable_campaign_is_reported_and_others_are_shown(make_run: MakeRun, tmp_path: Path) -> None:
    make_run(make_rows(6)[MIN_COLUMNS], name="readable")
    damaged_run = make_run(make_rows(6)[MIN_COLUMNS], name="damaged")
    (damaged_run / "cases.parquet").write_bytes(b"not a table")
    site = write_site(tmp_path / "site", [tmp_path])
    assert site.campaigns == 1
    assert len(site.problems) == 1
    assert "damaged" in site.index.read_text(encoding="utf-8")


def test_pages_of_unchanged_campaigns_are_not_rewritten(make_run: MakeRun, tmp_path: Path) -> None:
    directory = make_run(make_rows(6)[MIN_COLUMNS])
    _write_index(tmp_path)
    page = next((tmp_path / "site" / "c").glob("*/index.html"))
    page.write_text("page of the first run", encoding="utf-8")
    _write_index(tmp_path)
    assert page.read_text(encoding="utf-8") == "page of the first run"
    stored = json.loads((directory / "campaign.json").read_text())
    (directory / "campaign.json").write_text(json.dumps({**stored, "state": "interrupted"}))
    _write_index(tmp_path)
    assert "page of the first run" not in page.read_text(encoding="utf-8")


def test_reports_of_others_are_written_again(
    make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A page with a script, or data with another verdict, never reach the site; the campaign's folder is unchanged."""
    directory = make_run(make_rows(12)[MIN_COLUMNS], name="elsewhere")
    own_page = write_report(directory).read_text(encoding="utf-8")
    _write_index(tmp_path)
    (page,) = (tmp_path / "site" / "c").glob("*/report.html")
    assert page.read_text(encoding="utf-8") == own_page
    for name, text in (("report.html", "<script>alert(1)</script>"), ("report.json", '"verdict": "PASS"')):
        write_report(directory)
        (directory / name).write_text(text, encoding="utf-8")
        index = _write_index(tmp_path)
        assert page.read_text(encoding="utf-8") == own_page
        assert "INSUFFICIENT" in index
        assert (directory / name).read_text(encoding="utf-8") == text
    # a signature of another user counts for nothing, and the date of the rows neither
    write_report(directory)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "another user"))
    rows = directory / "cases.parquet"
    write_table_with_seal(directory, make_rows(12, n_crashed=10)[MIN_COLUMNS])
    os.utime(rows, (0, 0))
    _write_index(tmp_path)
    assert "10 cases crashed" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["report.html", "campaign.json", "cases/3/products.npz", "cases/7"])
def test_folders_with_links_are_refused(
    make_run: MakeRun, tmp_path: Path, dimes_products: dict[str, Any], name: str
) -> None:
    directory = make_run(make_rows(6)[MIN_COLUMNS], name="linked", products=dimes_products)
    secret = tmp_path / "secret"
    link = directory / name
    secret.write_bytes(link.read_bytes() if link.is_file() else b"a file from elsewhere")
    link.unlink(missing_ok=True)
    link.symlink_to(secret)
    site = write_site(tmp_path / "site", [tmp_path])
    assert (site.campaigns, len(site.problems)) == (0, 1)
    assert f"{name} is a symbolic link" in site.problems[0]
    for read in (write_report, record.read):
        with pytest.raises(StoreError, match="symbolic link"):
            read(directory)


def _make_verdict(estimate: float, lower: float = 0.9) -> Verdict:
    return Verdict("R", "", "error_m", 1.0, 0.95, 0.9, "all", Status.PASS, estimate=estimate, lower=lower)


def test_sparkline_rises_with_the_rate() -> None:
    line = sparkline([_make_verdict(0.9), _make_verdict(0.97), _make_verdict(1.0)])
    line_y = [float(point.split(",")[1]) for point in line.points.split()]
    # the y axis of SVG points down: a higher rate has a smaller y
    assert line_y[0] > line.required_y > line_y[1] > line_y[2]
    assert sparkline([_make_verdict(0.9)]) is None
    assert sparkline([_make_verdict(float("nan"))] * 3) is None


def test_margin_is_printed_in_percentage_points() -> None:
    assert margin_text(_make_verdict(0.9)) == "−5.00 pp"
    assert margin_text(_make_verdict(0.9, lower=0.9623)) == "+1.23 pp"
    assert margin_text(_make_verdict(0.9, lower=float("nan"))) == "–"


def test_index_without_campaigns_is_written(tmp_path: Path) -> None:
    assert all(row.latest is None for row in requirement_rows([], shipped_requirements()))
    assert "0 stored campaigns" in _write_index(tmp_path)


def test_failed_requirements_precede_others(make_run: MakeRun, tmp_path: Path) -> None:
    requirements = [
        {**VELOCITY, "id": "MET", "probability": 0.1},
        {**VELOCITY, "id": "UNDECIDED", "probability": 0.9999},
        {**VELOCITY, "id": "FAILED", "bound": 0.1},
    ]
    make_run(make_rows(12)[MIN_COLUMNS], requirements)
    entries, _ = read_entries(find_campaigns([tmp_path]), tmp_path / "pages")
    rows = requirement_rows(entries, shipped_requirements())
    assert [row.requirement for row in rows[:3]] == ["FAILED", "UNDECIDED", "MET"]
    assert all(row.latest is None for row in rows[3:])
