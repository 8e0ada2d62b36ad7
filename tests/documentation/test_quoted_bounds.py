"""Tests that the confidence bounds on documentation pages agree with the counts on the same page."""

import re
from pathlib import Path

from marsyard.reports.statistics.proportions import (
    minimum_sample_size,
    proportion_interval,
    proportion_lower,
    proportion_upper,
)

DOCS = Path(__file__).parents[2] / "docs"


def read_page(page: str) -> str:
    """Return the text of a page; line breaks are replaced by spaces."""
    return " ".join((DOCS / page).read_text(encoding="utf-8").split())


def parse_percent(text: str) -> float:
    match = re.search(r"([\d.]+) %", text)
    assert match is not None
    return float(match[1])


def test_quoted_bounds_on_wrong_velocities_are_correct() -> None:
    lines = (DOCS / "dimes.md").read_text(encoding="utf-8").splitlines()
    tables = [
        index for index, line in enumerate(lines) if line.startswith("| valid answers, of these errors above 5 m/s")
    ]
    assert len(tables) == 2
    for index in tables:
        counts, bounds = (re.split(r"\s*\|\s*", line.strip("| "))[1:] for line in lines[index : index + 2])
        assert len(counts) == len(bounds) == 3
        for cell, bound in zip(counts, bounds, strict=True):
            answers, wrong = map(int, re.findall(r"\d+", cell)[:2])
            assert parse_percent(bound) == round(100.0 * proportion_upper(wrong, answers, 0.9), 2)


def test_quoted_interval_of_wrong_answers_is_correct() -> None:
    """The page gives two of 6 wrong answers; so few answers cannot show a rate of one in 300."""
    page = read_page("dimes.md")
    low, high = proportion_interval(2, 6, 0.95)
    assert f"two of 6 answers are wrong (95 % confidence interval {100.0 * low:.1f} to {100.0 * high:.1f} %)" in page
    assert "one in 300" not in page


def test_bound_of_landings_counts_terrains() -> None:
    (number,) = re.findall(r"In confirmation 1 of `dimes`, over (\d+) terrains", read_page("dimes.md"))
    terrains = int(number)
    bound = f"{100.0 * proportion_lower(terrains, terrains, 0.9):.1f} %"
    assert f"With terrains as the independent unit, the lower 90 % confidence bound of the success rate is {bound}" in (
        read_page("dimes.md")
    )


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
