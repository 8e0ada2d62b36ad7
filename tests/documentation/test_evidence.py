"""Tests that pages agree with the record of confirmations and with the code: numbers, seeds, cases, time spans."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from marsyard.campaigns.definition.loading import load_campaign
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
    text = " ".join((ROOT / "docs" / "localisation.md").read_text().split())
    (sentence,) = re.findall(r"Options of `lvs` were set on (.*?);", text)
    named = {(name, int(seed)) for name, seed in re.findall(r"`(loc-[\w-]+)` with seed (\d+)", sentence)}
    definitions = [load_campaign(name).definition for name in catalogue() if name.startswith("loc-")]
    calibrations = [item.calibration for item in definitions if item.calibration is not None]
    assert named == {(run.campaign, run.seed) for item in calibrations for run in item.runs}
    (jezero,) = [item for item in definitions if item.name == "loc-jezero"]
    assert f"`loc-jezero` with seed {jezero.seed} (that of its file)" in sentence


def test_span_of_inertial_data_is_that_of_the_code() -> None:
    text = " ".join((ROOT / "docs" / "localisation.md").read_text().split())
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
            cases = load_campaign(command.group(1)).definition.cases
            assert int(number.group().replace(",", "")) == cases, cells
            n_rows += 1
    assert n_rows > 20
