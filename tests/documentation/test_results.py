"""Tests of the tables of results in README and pages, and of the search for contradictions."""

import json
from pathlib import Path

import pytest

from docs import results
from marsyard.reports.campaign_report import write_report
from tests.reports.synthetic_run import VELOCITY, make_rows, write_run

PAGE = """# Page

<!-- results: dimes-a dimes-b -->
an old table
<!-- end -->

<!-- comparison: dimes-a -->
<!-- end -->
"""


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Store a run of two estimators with 40 cases, of which one is silent and eleven answers are wrong."""
    folder = tmp_path_factory.mktemp("results")
    frame = make_rows(40, answer_rate=1.0, terrains=40)
    frame["terrain"] = range(40)
    frame["velocity_error_m_s"] = [1.0] * 28 + [9.0] * 11 + [float("nan")]
    frame["answered"] = [True] * 39 + [False]
    other = frame.rename(columns=lambda name: f"other_plus.{name}")[["other_plus.outcome", "other_plus.answered"]]
    loose = {**VELOCITY, "id": "LOOSE", "bound": 20.0, "probability": 0.8}
    requirements = (VELOCITY, loose)
    run = write_run(
        folder / "run",
        frame.assign(**other, **{"other_plus.velocity_error_m_s": [2.0] * 39 + [float("nan")]}),
        requirements,
    )
    write_report(run)
    results.store_run("dimes-a", run, folder / "stored")
    results.store_run("dimes-a", run, folder / "stored")  # replaces it
    return folder / "stored"


def test_page_has_the_verdicts_of_stored_runs_and_names_missing_ones(stored: Path) -> None:
    reports = results.read_stored(stored)
    text = results.fill_page(PAGE, reports)
    lines = text.splitlines()
    assert lines[4] == "**`dimes-a` fails DIMES-VEL (11 of 39 cases).**"
    (row,) = [line for line in lines if "DIMES-VEL |" in line]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    verdict = reports["dimes-a"].verdicts[0]
    bounds = f"{100.0 * verdict.lower:.2f} % to {100.0 * verdict.upper:.2f} %"
    assert (cells[0], *cells[2:6]) == ("`dimes-a`", "DIMES-VEL", "**FAIL**", "11 of 39", bounds)
    assert cells[6] == "exploration, 40 cases, commit 01234567"
    assert "No run of the present program is stored of `dimes-b`." in lines
    # the reach of the requirement that passes, and of no other
    (reach,) = [line for line in lines if line.startswith("- `dimes-a`")]
    assert reach.startswith("- `dimes-a`, LOOSE: PASS holds (90 % confidence, one change at a time) for ")
    assert "Robust verdicts ([how far a PASS reaches](ROBUST)):" in lines
    (row,) = [line for line in lines if "`other-plus`" in line]
    assert [cell.strip() for cell in row.strip("|").split("|")][2:7] == ["40", "39", "39", "2.000", "2.000"]
    assert "an old table" not in text
    assert results.fill_page(text, reports) == text
    (line,) = (stored / results.HASHES).read_text().splitlines()
    assert line.endswith("  dimes-a.parquet")
    assert results.read_hashes(stored / results.REPORT_HASHES) == {"dimes-a": results.hash_report_sources()}


def test_summary_has_the_requirements_by_verdict(stored: Path) -> None:
    text = results.fill_page("<!-- summary: dimes-a dimes-b -->\n<!-- end -->", results.read_stored(stored), stored)
    (row,) = [line for line in text.splitlines() if line.startswith("| `dimes-a`")]
    assert [cell.strip() for cell in row.strip("|").split("|")][2:] == ["40", "LOOSE", "DIMES-VEL", "–", "exploration"]
    assert "No run of the present program is stored of `dimes-b`." in text


def test_missed_rows_of_a_page_are_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [
        "| a (s) | <= 2 | 5 | 3 | **missed** |",
        "| b | <= 2 | 1 | 1 | met |",
        "| c (GB) | >= 1 | 0.5 | | **missed** |",
    ]
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "times.md").write_text("\n".join(rows))
    (tmp_path / "docs" / "checks.md").write_text("| d | at most 1 px | 2 px | met | |\n")
    monkeypatch.setattr(results, "ROOT", tmp_path)
    assert results.format_missed(["times"]) == "- a (s): 3, limit <= 2\n- c (GB): 0.5, limit >= 1\n\n"
    assert results.format_missed(["checks"]) == "None.\n\n"


def test_page_has_the_tables_of_a_section(stored: Path) -> None:
    page = "<!-- section: dimes-a answers -->\nold\n<!-- end -->\n<!-- section: dimes-b answers -->\n<!-- end -->\n"
    text = results.fill_page(page, results.read_stored(stored), stored)
    lines = text.splitlines()
    assert lines[2] == "Run of `dimes-a`: exploration, 40 cases, commit 01234567."
    (row,) = [line for line in lines if line.startswith("| answered (of all cases) |")]
    assert row.split("|")[2].strip() == "39 of 40"
    assert "old" not in lines
    assert lines[-3:] == ["No run of the present program is stored of `dimes-b`.", "", "<!-- end -->"]
    without_tables = results.fill_page(page, results.read_stored(stored), stored / "none")
    assert "No run of the present program is stored of `dimes-a`." in without_tables.splitlines()
    with pytest.raises(ValueError, match=r"the report of dimes-a has no section 'none'; allowed: answers, "):
        results.fill_page("<!-- section: dimes-a none -->\n<!-- end -->", results.read_stored(stored), stored)


def test_run_without_stored_sections_counts_as_not_stored(stored: Path, tmp_path: Path) -> None:
    text = results.fill_page("<!-- section: dimes-a answers -->\n<!-- end -->", results.read_stored(stored), tmp_path)
    assert text.splitlines()[2] == "No run of the present program is stored of `dimes-a`."


@pytest.mark.parametrize(
    ("sentence", "unknown"),
    [
        ("In `dimes-a`, 11 of 39 answers are wrong.", ""),
        ("In `dimes-a`, 71.8 % of the 39 answers are right; the median is 1.0 m/s.", ""),
        ("In `dimes-a`, 11 of 57 answers are wrong.", "57"),
        ("In `dimes-a`, the median error is 1.7 m/s.", "1.7"),
        ("`dimes-a` has 1,000 cases.", ""),
        ("`dimes-b` has 77 cases.", ""),
        ("Of 77 cases of the paper, most are right.", ""),
    ],
)
def test_numbers_of_prose_are_compared_with_the_report(stored: Path, sentence: str, unknown: str) -> None:
    values = {"dimes-a": json.loads((stored / "dimes-a.json").read_text())}
    found = list(results.find_contradictions(f"{PAGE}\n{sentence}\n", values, {"dimes-a": "cases = 1000"}))
    assert [line.split(" not in the report")[0] for line in found] == ([unknown] if unknown else [])


def test_tables_of_the_pages_are_those_of_the_stored_runs() -> None:
    reports = results.read_stored()
    for page in results.PAGES:
        text = (results.ROOT / page).read_text()
        assert results.write_links(page, results.fill_page(text, reports)) == text, page
