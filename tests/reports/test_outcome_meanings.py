"""Tests of the meaning of outcomes in the report."""

from __future__ import annotations

import pandas as pd
import pytest

from marsyard.reports.sections import outcome_grid


@pytest.mark.parametrize(
    ("scenario", "meaning"),
    [
        ("descent", "a velocity is reported"),
        ("localisation", "a position is reported"),
        ("measured-velocity", "reported"),
    ],
)
def test_outcome_has_the_meaning_of_its_system(scenario: str, meaning: str) -> None:
    rows = outcome_grid(pd.DataFrame({"outcome": ["VALID"] * 3}), scenario).rows
    assert len(rows) == 1
    assert meaning in rows[0][3]  # column: meaning
