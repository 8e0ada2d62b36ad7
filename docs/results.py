"""Tables of results in README and pages, from the stored `report.json` of runs: ``python docs/results.py [RUN...]``.

A run folder is stored as `benchmarks/results/reports/CAMPAIGN.json` (with ``NAME=FOLDER`` under another name), the
tables of its report's sections in `sections/CAMPAIGN.json`, and the hashes of its rows and of the sources of the report
in `rows.sha256` and `sources.sha256`. The tables are written between two comments:

    <!-- results: CAMPAIGN... -->       verdicts, robust verdicts and evidence; a sentence first names what fails
    <!-- summary: CAMPAIGN... -->       the requirements of each campaign by verdict
    <!-- comparison: CAMPAIGN... -->    all algorithms of each run
    <!-- missed: PAGE... -->            rows of docs/PAGE.md that miss their limit (`validation`, `performance`)
    <!-- section: CAMPAIGN KEY -->      tables and notes of a section of the report, for example `field-test`
    <!-- end -->

With ``--check`` nothing is written. The exit code is 1 if a page has other tables, if a stored run or its report is of
other sources than the present ones, or if a sentence that names one stored campaign contains a number that neither its
report nor its campaign file contains.
"""

import argparse
import hashlib
import json
import math
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

from marsyard.reports.campaign_report import create_subject, section_makers
from marsyard.reports.evaluation import evaluate_run
from marsyard.reports.report_file import REPORT_JSON, CampaignReport, read_report
from marsyard.reports.robustness_wording import robustness_text
from marsyard.reports.verdicts import Status
from marsyard.reports.wording import NOTHING, label, number, percent
from marsyard.scenarios.systems import catalogue

ROOT = Path(__file__).parents[1]
STORED = ROOT / "benchmarks" / "results" / "reports"
HASHES, REPORT_HASHES = "rows.sha256", "sources.sha256"
PAGES = ("README.md", "docs/dimes.md", "docs/vtt.md", "docs/hda.md", "docs/localisation.md")
#: Sources that determine the rows of a run, and those that determine its report, as patterns of git.
SOURCES, REPORT_SOURCES = (
    ("sim", "algorithms", "scenarios", "campaigns", ":(exclude)campaigns/studies"),
    ("reports", ":(exclude)reports/validation.json"),
)
_BLOCK = re.compile(
    r"(<!-- (results|summary|comparison|section|missed): ([a-z0-9 -]+?) -->\n)(.*?)(<!-- end -->)", re.DOTALL
)
_NUMBER = re.compile(r"(?<![\w.,-])\d[\d,]*(?:\.\d+)?(?![\w-])")
Reports = Mapping[str, CampaignReport]


def store_run(name: str, run: Path, folder: Path = STORED) -> None:
    """Store the report of a run, its sections' tables, and the SHA-256 of its rows in the form of `sha256sum`."""
    (folder / "sections").mkdir(parents=True, exist_ok=True)
    contents = {"sections/": read_sections(run), "": json.loads((run / REPORT_JSON).read_text())}
    for prefix, content in contents.items():
        text = json.dumps(content, separators=(",", ":"), ensure_ascii=False)
        (folder / f"{prefix}{name}.json").write_text(text + "\n")
    _write_hash(folder / HASHES, f"{name}.parquet", hashlib.sha256((run / "cases.parquet").read_bytes()).hexdigest())
    _write_hash(folder / REPORT_HASHES, name, hash_report_sources())


def hash_report_sources() -> str:
    """Return the SHA-256 of the sources of reports."""
    files = [ROOT / line for line in _git("ls-files", "--", *REPORT_SOURCES).stdout.splitlines()]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files if path.exists())).hexdigest()


def _git(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)  # noqa: S603, S607


def _write_hash(path: Path, name: str, digest: str) -> None:
    """Write the hash of a name, or replace it, in a file that is sorted by name."""
    hashes = read_hashes(path) | {name: digest}
    path.write_text("".join(f"{hashes[key]}  {key}\n" for key in sorted(hashes)))


def read_hashes(path: Path) -> dict[str, str]:
    """Read hashes by name; none if there is no file."""
    lines = path.read_text().splitlines() if path.exists() else []
    return {name: digest for digest, name in (line.split("  ") for line in lines)}


def read_sections(run: Path) -> dict[str, list[dict[str, Any]]]:
    """Return the blocks with tables, or with texts alone, of each section of a run's report, by the section's key."""
    subject = create_subject(evaluate_run(run))
    sections = [section for maker in section_makers() if (section := maker(subject)) is not None]
    return {
        section.key: [
            {"heading": block.heading, "text": block.text, "note": block.note}
            | ({} if block.grid is None else {"head": list(block.grid.head), "rows": block.grid.rows})
            for block in section.blocks
            if block.grid is not None or (block.text + block.note and not block.figures)
        ]
        for section in sections
    }


def read_stored(folder: Path = STORED) -> dict[str, CampaignReport]:
    """Read the stored reports by name; raises ValueError for one of another layout."""
    reports = {path.stem: read_report(path.read_text()) for path in sorted(folder.glob("*.json"))}
    for name, report in reports.items():
        if report is None:
            raise ValueError(f"{name}.json has another layout: run `marsyard report` on its folder, and store it again")
    return {name: report for name, report in reports.items() if report is not None}


def fill_page(text: str, reports: Reports, folder: Path = STORED) -> str:
    """Return a page with the tables of the reports, which are stored in a folder."""
    make = {"results": format_results, "summary": format_summary, "comparison": format_comparison}

    def fill(match: re.Match[str]) -> str:
        names = match[3].split()
        if match[2] == "missed":
            return f"{match[1]}\n{format_missed(names)}{match[5]}"
        if match[2] == "section":
            name, key = names
            return f"{match[1]}\n{format_section(name, key, reports.get(name), folder)}{match[5]}"
        missing = ", ".join(f"`{name}`" for name in names if name not in reports)
        note = f"No run of the present program is stored of {missing}.\n\n" if missing else ""
        body = make[match[2]]({name: reports[name] for name in names if name in reports})
        return f"{match[1]}\n{body}{note}{match[5]}"

    return _BLOCK.sub(fill, text)


def format_results(reports: Reports) -> str:
    """Format the verdicts of campaigns, and first the requirements that failed."""
    if not reports:
        return ""
    failed, rows, reaches = [], [], []
    for name, report in reports.items():
        for verdict in report.verdicts:
            count = f"{verdict.failures} of {verdict.n}"
            if verdict.status is Status.FAIL:
                failed.append(f"`{name}` fails {verdict.requirement_id} ({count} cases)")
            has_bounds = not math.isnan(verdict.lower)
            bounds = f"{percent(verdict.lower)} to {percent(verdict.upper)}" if has_bounds else NOTHING
            evidence = f"{report.evidence.title}, {report.cases:,} cases, {describe_tree(report)}"
            cells = (f"`{name}`", f"`{report.algorithm_details[0].name}`" if report.algorithm_details else NOTHING)
            rows.append([*cells, verdict.requirement_id, f"**{verdict.status}**", count, bounds, evidence])
            reach = robustness_text(verdict, report.robustness) if verdict.status.is_met else ""
            reaches += [f"- `{name}`, {verdict.requirement_id}: {reach}"] if reach else []
    head = ["campaign", "algorithm", "requirement", "verdict", "failed", "bounds of the success rate", "evidence"]
    sentence = f"**{'; '.join(failed)}.**" if failed else "No requirement of these runs is FAIL."
    text = f"{sentence}\n\n{_format_table(head, rows)}\n"
    robust = "\n".join(reaches)
    return f"{text}Robust verdicts ([how far a PASS reaches](ROBUST)):\n\n{robust}\n\n" if robust else text


def format_summary(reports: Reports) -> str:
    """Format a row per campaign: its requirements that are met, that are not met, and that are undecided."""
    if not reports:
        return ""
    rows = []
    for name, report in reports.items():
        groups: dict[str, list[str]] = {"met": [], "failed": [], "undecided": []}
        for verdict in report.verdicts:
            status = verdict.status
            group = "met" if status.is_met else "failed" if status is Status.FAIL else "undecided"
            detail = re.sub(r"PASS \((.*)\)", r"\1", status) if status.is_met and status is not Status.PASS else ""
            groups[group].append(f"{verdict.requirement_id} ({detail.lower()})" if detail else verdict.requirement_id)
        texts = [", ".join(names) or NOTHING for names in groups.values()]
        algorithm = f"`{report.algorithm_details[0].name}`" if report.algorithm_details else NOTHING
        rows.append([f"`{name}`", algorithm, f"{report.cases:,}", *texts, report.evidence.title])
    head = ["campaign", "algorithm", "cases", "met", "not met (FAIL)", "undecided (INSUFFICIENT)", "evidence"]
    return _format_table(head, rows) + "\n"


def format_comparison(reports: Reports) -> str:
    """Format all algorithms of the runs: answers, successes, and errors in the unit of the page's metric."""
    rows = []
    for name, report in reports.items():
        for entry in report.sections.get("algorithms", {}).get("algorithms", ()):
            errors = [NOTHING if entry[key] is None else number(entry[key]) for key in ("median", "p95")]
            numbers = [entry[key] for key in ("cases", "answered", "succeeded")]
            counts = [NOTHING if count is None else f"{count:,}" for count in numbers]
            tree = f"{report.evidence.title}, {describe_tree(report)}"
            # the section contains labels, which are prefixes of columns: `dimes_plus` for the algorithm `dimes-plus`
            rows.append([f"`{name}`", f"`{entry['name'].replace('_', '-')}`", *counts, *errors, tree])
    if not rows:
        return ""
    metric = label(next(iter(reports.values())).metric or "")
    head = ["run", "algorithm", "cases", "answered", "succeeded", f"{metric}: median", "95 % quantile", "evidence"]
    return _format_table(head, rows) + "\n"


def format_section(name: str, key: str, report: CampaignReport | None, folder: Path) -> str:
    """Format the tables of a section of a report; raises ValueError if the report does not have this section.

    A run that was stored without the tables of its sections counts as not stored.
    """
    path = folder / "sections" / f"{name}.json"
    if report is None or not path.exists():
        return f"No run of the present program is stored of `{name}`.\n\n"
    sections = json.loads(path.read_text())
    if key not in sections:
        raise ValueError(f"the report of {name} has no section '{key}'; allowed: {', '.join(sections)}")
    parts = [f"Run of `{name}`: {report.evidence.title}, {report.cases:,} cases, {describe_tree(report)}."]
    for block in sections[key]:
        parts += filter(None, (f"*{block['heading']}*" if block["heading"] else "", block["text"].strip()))
        if "rows" in block:
            rows = [[cell.replace("|", "\\|").replace("<", "&lt;") for cell in row] for row in block["rows"]]
            parts.append(_format_table(block["head"], rows).rstrip())
        parts += filter(None, (block["note"].strip(),))
    return "\n\n".join(parts) + "\n\n"


def format_missed(pages: Sequence[str]) -> str:
    """List the rows of generated pages that miss their limit: quantity, value (scaled, if it is a time) and limit."""
    items = []
    for page in pages:
        for line in (ROOT / "docs" / f"{page}.md").read_text().splitlines():
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            if "**missed**" in cells:
                name, limit, *values = cells[: cells.index("**missed**")]
                items.append(f"- {name}: {[value for value in values if value][-1]}, limit {limit}")
    return "\n".join(items or ["None."]) + "\n\n"


def describe_tree(report: CampaignReport) -> str:
    """Return the commit of a run."""
    return f"commit {report.git_commit[:8]}" if isinstance(report.git_commit, str) else "unknown commit"


def _format_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)) + "\n"


def find_contradictions(text: str, reports: Mapping[str, Any], sources: Mapping[str, str]) -> Iterator[str]:
    """Yield the sentences that name only one campaign, a stored one, with numbers that neither report nor sources have.

    A whole number agrees with an equal value of the report; a percentage, and a number with decimals, with a value that
    rounds to it. Generated tables and code blocks are left out. That a number agrees does not show that it is the right
    one of the report.
    """
    prose = re.sub(r"```.*?```|^ {4}.*?$", "", _BLOCK.sub("", text), flags=re.DOTALL | re.MULTILINE)
    campaigns = reports.keys() | catalogue().keys()
    # headings and paragraphs end sentences
    paragraphs = [" ".join(paragraph.split()) for paragraph in re.split(r"\n\s*\n", prose)]
    sentences = [part for text in paragraphs for part in re.split(r"(?<=[.:;])\s+(?=[A-Z`|])", text)]
    for sentence in sentences:
        names = [name for name in re.findall(r"`([a-z0-9-]+)`", sentence) if name in campaigns]
        if len(set(names)) != 1 or names[0] not in reports:
            continue
        values = [*_leaves(reports[names[0]])]
        known = {word.replace(",", "") for word in _NUMBER.findall(sources.get(names[0], ""))}
        unknown = [
            match[0]
            for match in _NUMBER.finditer(sentence)
            if match[0].replace(",", "") not in known
            and not _agrees(match[0].replace(",", ""), sentence[match.end() :].startswith(" %"), values)
        ]
        if unknown:
            yield f"{', '.join(unknown)} not in the report of {names[0]}: {sentence}"


def _agrees(word: str, is_percentage: bool, values: Sequence[float]) -> bool:
    """Whether a value equals a whole number, or rounds to a percentage or a number with the same decimals."""
    decimals, scale = -int(Decimal(word).as_tuple().exponent), 100.0 if is_percentage else 1.0
    tolerance = 0.5000001 * 10.0**-decimals if decimals or is_percentage else 0.0
    return any(abs(abs(scale * value) - float(word)) <= tolerance for value in values)


def _leaves(value: Any) -> Iterator[float]:
    """Yield the numbers of a JSON value."""
    if isinstance(value, dict | list):
        for entry in value.values() if isinstance(value, dict) else value:
            yield from _leaves(entry)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield float(value)


def check(reports: Reports) -> list[str]:
    """Return the faults of the pages and of the stored runs."""
    faults, hashes, present = [], read_hashes(STORED / REPORT_HASHES), hash_report_sources()
    for name, report in reports.items():
        # the record of confirmations is the only file that `tools/confirm_queue.py` lets change
        commit = str(report.git_commit).removesuffix("+changes" if report.evidence.claim else "")
        if _git("diff", "--quiet", commit, "--", *SOURCES).returncode:
            faults.append(f"{name}: its sources ({describe_tree(report)}) are not the present ones: run it again")
        if hashes.get(name) != present:
            faults.append(f"{name}: its report is of other sources: run `marsyard report` on its folder, and store it")
    values = {name: json.loads((STORED / f"{name}.json").read_text()) for name in reports}
    files = {name: path.read_text() for name, path in catalogue().items()}
    sources = {name: files.get(report.campaign, "") for name, report in reports.items()}
    for page in PAGES:
        text = (ROOT / page).read_text()
        if write_links(page, fill_page(text, reports)) != text:
            faults.append(f"{page}: other tables than those of the stored runs: run `python docs/results.py`")
        faults += [f"{page}: {fault}" for fault in find_contradictions(text, values, sources)]
    return faults


def write_links(page: str, text: str) -> str:
    """Complete the links of a page."""
    return text.replace("(ROBUST)", f"({'' if page.startswith('docs/') else 'docs/'}robustness.md)")


def main() -> int:
    """Store runs, and write or check the pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", metavar="[NAME=]RUN", help="folders of runs to store")
    parser.add_argument("--check", action="store_true", help="report faults, and write nothing")
    options = parser.parse_args()
    if options.check:
        faults = check(read_stored())
        print("\n".join(faults))
        return int(bool(faults))
    for word in options.runs:
        name, _, folder = word.rpartition("=")
        run = Path(folder)
        store_run(name or json.loads((run / REPORT_JSON).read_text())["campaign"], run)
    for page in PAGES:
        path = ROOT / page
        path.write_text(write_links(page, fill_page(path.read_text(), read_stored())))
    return 0


if __name__ == "__main__":
    sys.exit(main())
