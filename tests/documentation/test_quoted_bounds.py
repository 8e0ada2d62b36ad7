"""Tests that the confidence bounds on documentation pages agree with the counts on the same page."""

import json
import re
from pathlib import Path

import pytest

from marsyard.reports.statistics.proportions import (
    minimum_sample_size,
    proportion_interval,
    proportion_lower,
    proportion_upper,
)

DOCS = Path(__file__).parents[2] / "docs"
CONFIRMATIONS = DOCS.parent / "benchmarks" / "results" / "confirmations.jsonl"


def read_page(page: str) -> str:
    """Return the text of a page; line breaks are replaced by spaces."""
    return " ".join((DOCS / page).read_text(encoding="utf-8").split())


@pytest.mark.parametrize(("page", "quotes"), [("hda.md", 20), ("vtt.md", 2)])
def test_quoted_intervals_are_correct(page: str, quotes: int) -> None:
    """Landings, and runs within 3 cm at the goal of both trackers."""
    found = re.findall(r"(\d+) of (\d+) \(([\d.]+) to ([\d.]+) %\)", read_page(page))
    assert len(found) >= quotes
    for successes, total, quoted_low, quoted_high in found:
        low, high = (100.0 * bound for bound in proportion_interval(int(successes), int(total), 0.95))
        assert (quoted_low, quoted_high) == (f"{low:.1f}", f"{high:.1f}"), (successes, total)


def test_quoted_bounds_of_landings_are_correct() -> None:
    """The page gives 140 of 142, 20 of 20 and 31 of 33 successful flights."""
    page = read_page("hda.md")
    for successes, total in ((140, 142), (20, 20)):
        lower = f"{100.0 * proportion_lower(successes, total, 0.9):.1f}"
        assert re.search(rf"{successes} of {total} \([^)]*\)[^|]*?, at least {lower} % at 90 % confidence", page)
    assert f"at most {100.0 * proportion_upper(31, 33, 0.9):.1f} % at 90 % confidence" in page


def test_groups_of_hazardous_flights_sum_to_all_flights() -> None:
    page = read_page("hda.md")
    match = re.search(
        r"The ([\d,]+) flights fall into three groups .*?: (\d+) have .*?, (\d+) have .*?, and (\d+) have", page
    )
    flights, *groups = (int(count.replace(",", "")) for count in match.groups())
    records = [json.loads(line) for line in CONFIRMATIONS.read_text(encoding="utf-8").splitlines()]
    (cases,) = {
        record["cases"] for record in records if (record.get("campaign"), record.get("number")) == ("hda-hazardous", 1)
    }
    assert flights == sum(groups) == cases


def test_quoted_sample_sizes_are_correct() -> None:
    numbers = [minimum_sample_size(0.99, 0.9, failures) for failures in range(3)]
    sentence = "For 99 % at 90 % confidence, {} cases without a failure pass, {} with one failure, and {} with two."
    assert sentence.format(*numbers) in read_page("explanation/statistics.md")


def test_requirements_based_on_a_calibration_are_listed() -> None:
    page = read_page("explanation/statistics.md")
    assert "no requirement rests on it" not in page
    # requirements whose verdicts depend on a calibrated option
    for name in ("FIELD-VEL", "FIELD-ANSWER"):
        assert name in page
