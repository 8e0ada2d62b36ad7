"""Tests that the confidence bounds on documentation pages agree with the counts on the same page."""

from pathlib import Path

from marsyard.reports.statistics.proportions import minimum_sample_size

DOCS = Path(__file__).parents[2] / "docs"


def read_page(page: str) -> str:
    """Return the text of a page; line breaks are replaced by spaces."""
    return " ".join((DOCS / page).read_text(encoding="utf-8").split())


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
