"""Fixtures of campaigns of the fake scenario."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from tests.campaigns.fake_campaign import FAILING_CASES, RecordingWatch, run, write_campaign


@pytest.fixture
def campaign_file(tmp_path: Path) -> Callable[..., Path]:
    """Write a campaign: `campaign_file(parameters="...", dispersions=..., requirement=..., head=..., more=...)`."""
    return partial(write_campaign, tmp_path)


@pytest.fixture
def watch() -> RecordingWatch:
    return RecordingWatch()


@pytest.fixture(scope="session")
def failing_campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run a campaign: one case raises, two abort their process, one has no answer. Tests must not change it."""
    folder = tmp_path_factory.mktemp("campaign")
    return run(write_campaign(folder, FAILING_CASES), folder / "failing_campaign", RecordingWatch())
