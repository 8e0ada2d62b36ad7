"""Bounds and intervals that the pages quote, against the project's own statistics of the counts that they quote."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.reports.statistics.proportions import (
    minimum_sample_size,
    proportion_interval,
    proportion_lower,
    proportion_upper,
)

DOCS = Path(__file__).parents[2] / "docs"


def text_of(page: str) -> str:
    """A page with its lines joined."""
    return " ".join((DOCS / page).read_text(encoding="utf-8").split())


def cells(page: str, start: str) -> list[str]:
    """The cells of the one row of a page's tables that starts so."""
    (row,) = [line for line in (DOCS / page).read_text(encoding="utf-8").splitlines() if line.startswith(f"| {start}")]
    return [cell.strip() for cell in row.strip("|").split("|")]


def counts(cell: str) -> tuple[int, int]:
    """The first `k of n` of a cell; n alone where k is left out."""
    found = re.search(r"(?:([\d,]+) of )?([\d,]+)", cell)
    assert found is not None
    last = int(found[2].replace(",", ""))
    return (last if found[1] is None else int(found[1].replace(",", "")), last)


def per_cent(text: str) -> float:
    found = re.search(r"([\d.]+) %", text)
    assert found is not None
    return float(found[1])


@pytest.mark.parametrize("column", [1, 2])
def test_the_bound_on_wrong_velocities_is_the_one_that_decides(column: int) -> None:
    wrong, answers = counts(cells("dimes.md", "wrong answers (error above 5 m/s)")[column])
    assert wrong == 0
    deciding = cells("dimes.md", "upper bound of their rate at 90 % confidence, terrains counted")[column]
    terrains = int(deciding.split(" over ")[1].split()[0])
    assert per_cent(deciding) == round(100.0 * proportion_upper(0, terrains, 0.9), 2)
    independent = cells("dimes.md", "upper bound for independent cases")[column]
    assert per_cent(independent) == round(100.0 * proportion_upper(0, answers, 0.9), 2)


def test_few_wrong_answers_to_a_wrong_altitude_are_quoted_with_their_intervals() -> None:
    page = text_of("dimes.md")
    for (wrong, answers), quoted in (((1, 5), "between 0.5 and 71.6 %"), ((3, 10), "between 6.7 and 65.2 %")):
        low, high = proportion_interval(wrong, answers, 0.95)
        assert quoted == f"between {100.0 * low:.1f} and {100.0 * high:.1f} %"
        assert quoted in page
    assert "one in 300" not in page


def test_what_the_landings_show_counts_terrains() -> None:
    terrains = int(load_campaign("dimes-landing").configuration.parameters["location"]["bank"])
    shown = f"{100.0 * proportion_lower(terrains, terrains, 0.9):.1f} %"
    assert f"Counting terrains, this shows {shown} at 90 % confidence" in text_of("dimes.md")


@pytest.mark.parametrize(
    "start",
    ["chosen sites truly safe", "safe sites exist, none with safe surroundings", "`no safe site` where there is none"],
)
def test_rates_of_hazardous_flights_have_their_bounds(start: str) -> None:
    _, measured, interval = cells("hda.md", start)
    successes, n = counts(re.sub(r"^at least ", "", measured))
    lower = f"{100.0 * proportion_lower(successes, n, 0.9):.2f}"
    assert re.search(rf"\b({lower}|{float(lower):.1f}) %", measured), f"expected {lower} % at 90 % confidence"
    low, high = (100.0 * end for end in proportion_interval(successes, n, 0.95))
    assert per_cent(interval.split(" to ")[0] + " %") == round(low, 1)
    if successes < n and not measured.startswith("at least"):
        assert per_cent(interval) == round(high, 1)


def test_groups_of_hazardous_flights_are_all_flights() -> None:
    page = text_of("hda.md")
    found = re.search(
        r"The ([\d,]+) flights fall into three groups .*?: (\d+) have .*?, (\d+) have .*?, and (\d+) have", page
    )
    assert found is not None
    flights, *groups = (int(one.replace(",", "")) for one in found.groups())
    assert flights == sum(groups) == load_campaign("hda-hazardous").configuration.cases


def test_runs_to_the_goal_have_their_bounds() -> None:
    page = text_of("vtt.md")
    near, far = (100.0 * proportion_lower(*one, 0.9) for one in ((456, 457), (467, 467)))
    assert f"at least {near:.2f} and {far:.2f} % at 90 % confidence" in page
    assert f"98.8 %, at least {100.0 * proportion_lower(924, 935, 0.9):.1f} %" in page
    assert f"at most {100.0 - 100.0 * proportion_lower(933, 935, 0.9):.2f} %: INSUFFICIENT" in page


def test_cases_without_a_failure_that_pass() -> None:
    numbers = [minimum_sample_size(0.99, 0.9, failures) for failures in range(3)]
    expected = "For 99 % at 90 % confidence, {} cases without a failure pass, {} with one failure, and {} with two."
    expected = expected.format(*numbers)
    assert expected in text_of("explanation/statistics.md")


def test_requirements_that_rest_on_a_calibration_are_named() -> None:
    page = text_of("explanation/statistics.md")
    assert "no requirement rests on it" not in page
    for name in ("HDA-TIME", "HDA-POS", "FIELD-VEL", "FIELD-ANSWER"):
        assert name in page
