"""Campaigns of the fake scenario."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from tests.campaigns.fake_campaign import TROUBLE, Silence, run, write_campaign


@pytest.fixture
def campaign_file(tmp_path: Path) -> Callable[..., Path]:
    """Writes a campaign: `campaign_file(parameters="...", dispersions=..., requirement=..., head=..., more=...)`."""
    return partial(write_campaign, tmp_path)


@pytest.fixture
def watch() -> Silence:
    return Silence()


@pytest.fixture(scope="session")
def troubled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign in which one case raises, two abort their process and one has no answer; to be left as it is."""
    folder = tmp_path_factory.mktemp("campaign")
    return run(write_campaign(folder, TROUBLE), folder / "troubled", Silence())
