"""Tests of the page of run times: values of another machine are scaled before they are compared with the limits."""

import json
from pathlib import Path

import pytest

from benchmarks import page
from benchmarks.page import REFERENCE, REFERENCE_MS, RESULTS, is_within_limit, scale_value


@pytest.mark.parametrize(
    ("name", "scaled"),
    [
        # the machine of the measurement is twice as slow as that of the limits
        ("descent frame", 5.0),
        ("tracking update (ms)", 5.0),
        ("HDA features: templates (paper: 0.21 s)", 5.0),
        ("marsyard --help (wall s)", 5.0),
        ("dimes-gusev on two workers (cases per wall s)", 20.0),
        ("report: memory (GB)", None),
        ("engine: overhead of a case of 50 ms (%)", None),
        ("engine: speed-up by two workers, rendered cases (ratio)", None),
    ],
)
def test_times_and_rates_are_scaled_to_the_machine_of_the_limits(name: str, scaled: float | None) -> None:
    assert scale_value(name, 10.0, 2.0 * REFERENCE_MS) == scaled


def test_limits_are_compared_with_values() -> None:
    assert is_within_limit("<= 2", 2.0) is True
    assert is_within_limit("<= 2", 2.1) is False
    assert is_within_limit(">= 3.3", 3.2) is False
    assert is_within_limit(">= 3.3", 3.4) is True
    assert is_within_limit("", 1.0) is None


def test_page_shows_scaled_values_and_verdicts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "PAGE", tmp_path / "performance.md")
    figures = {
        REFERENCE: {"median": 8.4, "limit": ""},
        "fast": {"median": 1.0, "limit": "<= 0.6"},
        "slow": {"median": 1.0, "limit": "<= 0.4"},
        "memory (GB)": {"median": 1.0, "limit": "<= 0.6"},
        "other program": {"median": 3.0, "limit": ""},
    }
    machine = {"cores": 2, "processor": "x86_64"}
    page.write_page({"measured": "2026-11-28T19:15:02", "machine": machine, "gl": "llvmpipe", "figures": figures})
    text = (tmp_path / "performance.md").read_text()
    assert "| fast | <= 0.6 | 1 | 0.5 | met |" in text
    assert "| slow | <= 0.4 | 1 | 0.5 | **missed** |" in text
    assert "| memory (GB) | <= 0.6 | 1 |  | **missed** |" in text
    assert "run times are about 2 times as long" in text
    # rows without a limit are in a table of their own
    limits, comparison = text.split("### For comparison")
    assert "| other program | 3 | 1.5 |" in comparison
    assert f"| {REFERENCE} | 8.4 | 4.2 |" in comparison
    assert all(line.endswith(("| met |", "| **missed** |", "| verdict |", "|---|")) for line in _table(limits))


def _table(text: str) -> list[str]:
    """Return the lines of the last table."""
    return [line for line in text.split("## Measurements")[1].splitlines() if line.startswith("|")]


def test_published_page_is_that_of_the_stored_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    published = page.PAGE.read_text()
    monkeypatch.setattr(page, "PAGE", tmp_path / "performance.md")
    page.write_page(json.loads(RESULTS.read_text()))
    assert (tmp_path / "performance.md").read_text() == published
