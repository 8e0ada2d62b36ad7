"""Fixtures of synthetic run folders."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from tests.reports.synthetic_run import MakeRun, synthetic_products, write_run


@pytest.fixture
def make_run(tmp_path: Path) -> MakeRun:
    """Return a function that writes a run folder into the test's folder; see `write_run`."""

    def write_named_run(frame: pd.DataFrame, *args: Any, name: str = "run", **kwargs: Any) -> Path:
        return write_run(tmp_path / name, frame, *args, **kwargs)

    return write_named_run


@pytest.fixture
def dimes_products() -> dict[str, Any]:
    """Return products of a synthetic DIMES case; see `synthetic_products`."""
    return synthetic_products()


@pytest.fixture
def plain_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the SVG of figures, for tests that write reports but do not read their figures: most of the time."""
    monkeypatch.setattr("marsyard.reports.section.svg_markup", lambda *_: "<svg></svg>")
