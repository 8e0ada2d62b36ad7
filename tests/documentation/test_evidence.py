"""Tests that pages agree with the record of confirmations, packaged data and the code: numbers, seeds, time spans."""

import json
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest

from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.reports.assurance.verification import verify_package
from marsyard.reports.statistics.proportions import minimum_sample_size
from marsyard.scenarios.localisation import simulation
from marsyard.scenarios.localisation.flight import LEAD_S as FLIGHT_LEAD_S
from marsyard.scenarios.systems import catalogue

ROOT = Path(__file__).parents[2]
RECORD = ROOT / "benchmarks" / "results" / "confirmations.jsonl"
PAGES = ("dimes.md", "hda.md", "localisation.md", "vtt.md")


def read_confirmations() -> dict[tuple[str, int], dict[str, Any]]:
    """Read the first entry of each confirmation: algorithm, seed and number of cases."""
    entries = (json.loads(line) for line in RECORD.read_text().splitlines())
    return {(entry["campaign"], entry["number"]): entry for entry in entries if "seed" in entry}


def read_page(page: str) -> str:
    """Return the text of a page; line breaks are replaced by spaces."""
    return " ".join((ROOT / "docs" / page).read_text(encoding="utf-8").split())


@cache
def read_definition(name: str) -> CampaignDefinition:
    return load_campaign(name).definition


def list_rows(page: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the rows of the tables, each with the first campaign of the record named after the last heading."""
    campaigns, campaign = {name for name, _ in read_confirmations()}, ""
    for line in (ROOT / "docs" / page).read_text().splitlines():
        if line.startswith("#"):
            campaign = ""
        if not campaign:
            campaign = next((name for name in re.findall(r"`([a-z0-9-]+)`", line) if name in campaigns), "")
        if line.startswith("|"):
            yield campaign, [cell.strip() for cell in line.strip("|").split("|")]


@pytest.mark.parametrize("page", PAGES)
def test_seeds_of_confirmations_are_those_of_the_record(page: str) -> None:
    confirmations = read_confirmations()
    for _, cells in list_rows(page):
        command = re.match(r"`marsyard run ([\w./-]+)`", cells[0])
        for number, seed in re.findall(r"confirmation (\d+)[^;|]*? seed (\d+)", "|".join(cells)):
            assert command is not None, cells
            assert confirmations[Path(command.group(1)).stem, int(number)]["seed"] == int(seed), cells


def test_results_of_hazard_detection_are_generated() -> None:
    """Outside of the generated blocks the page has no verdict, no interval, and no seed or number of a run."""
    text = (ROOT / "docs" / "hda.md").read_text()
    prose = " ".join(re.sub(r"<!-- (results|comparison|section): .*?<!-- end -->", "", text, flags=re.DOTALL).split())
    result = r"\*\*(PASS|FAIL|MET|INSUFFICIENT)|\([\d.]+ to [\d.]+ %\)|(confirmation|seed) \d"
    assert [match.group() for match in re.finditer(result, prose)] == []


def test_calibrations_of_localisation_are_those_of_the_campaign_files() -> None:
    """The page names the runs on which options of `lvs` were set."""
    (sentence,) = re.findall(r"Options of `lvs` were set on (.*?);", read_page("localisation.md"))
    named = {(name, int(seed)) for name, seed in re.findall(r"`(loc-[\w-]+)` with seed (\d+)", sentence)}
    definitions = [read_definition(name) for name in catalogue() if name.startswith("loc-")]
    calibrations = [item.calibration for item in definitions if item.calibration is not None]
    assert named == {(run.campaign, run.seed) for item in calibrations for run in item.runs}
    (jezero,) = [item for item in definitions if item.name == "loc-jezero"]
    assert f"`loc-jezero` with seed {jezero.seed} (that of its file)" in sentence


def test_span_of_inertial_data_is_that_of_the_code() -> None:
    text = read_page("localisation.md")
    assert re.findall(r"inertial data begin ([\d.]+) s before", text) == [f"{simulation.INERTIAL_LEAD_S:g}"]
    assert re.findall(r"flight is simulated from ([\d.]+) s before", text) == [f"{FLIGHT_LEAD_S:g}"]


def test_pages_use_one_term_for_requirements_without_confidence() -> None:
    pages = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "reports" / "templates").glob("*.j2")]
    texts = {page: " ".join(page.read_text().split()) for page in pages}
    assert [page for page, text in texts.items() if re.search(r"decided by (the )?(observed )?rate", text)] == []
    assert sum("evaluated by observed rate" in text for text in texts.values()) > 5


def test_number_of_cases_of_a_campaign_is_that_of_its_file() -> None:
    """Tables of commands: the column `cases` states the number of cases of the campaign's file."""
    n_rows = 0
    for page in PAGES:
        for _, cells in list_rows(page):
            command = re.fullmatch(r"`marsyard run ([\w-]+)`", cells[0])
            if command is None or command.group(1) not in catalogue():
                continue
            number = re.match(r"[\d,]+", cells[2])
            assert number is not None, cells
            cases = read_definition(command.group(1)).cases
            assert int(number.group().replace(",", "")) == cases, cells
            n_rows += 1
    assert n_rows > 20


def test_page_on_credibility_has_the_packaged_factors() -> None:
    factors = tomllib.loads((ROOT / "reports/credibility.toml").read_text())["factors"]
    page = (ROOT / "docs/credibility.md").read_text().splitlines()
    rows = [line for line in page if line.startswith("| ") and not line.startswith("| factor")]
    assert rows == [f"| {item['name']} | {item['group']} | {item['level']} | {item['reasons']} |" for item in factors]
    assert all(0 <= int(item["level"][0]) <= 4 for item in factors)


def test_quoted_sample_sizes_are_correct() -> None:
    numbers = [minimum_sample_size(0.99, 0.9, failures) for failures in range(3)]
    sentence = "For 99 % at 90 % confidence, {} cases without a failure pass, {} with one failure, and {} with two."
    assert sentence.format(*numbers) in read_page("explanation/statistics.md")


def test_requirements_based_on_a_calibration_are_listed() -> None:
    # requirements whose verdicts depend on a calibrated option
    page = read_page("explanation/statistics.md")
    assert {name for name in ("FIELD-VEL", "FIELD-ANSWER") if name not in page} == set()


def test_packaged_example_of_the_four_systems_verifies(tmp_path: Path) -> None:
    """Hashes, rows and verdicts of the example of the guide."""
    with ZipFile(ROOT / "docs/examples/assurance.zip") as archive:
        archive.extractall(tmp_path)
    folder = tmp_path / "package"
    assert verify_package(folder).problems == ()
    names = {path.name for path in (folder / "runs").iterdir()}
    assert names == {"dimes-smoke", "vtt-montecarlo", "hda-hazardous", "loc-smoke"}
