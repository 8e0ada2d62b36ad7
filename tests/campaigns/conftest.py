"""Fixtures that write and run campaigns of the fake scenario; used by all tests of campaigns."""

from functools import partial
from pathlib import Path

import pytest

from tests.campaigns.fake_campaign import FAILING_CASES, CampaignFile, RecordingWatch, run, write_campaign


@pytest.fixture
def campaign_file(tmp_path: Path) -> CampaignFile:
    """Return `write_campaign` for the temporary folder: `campaign_file("altitude_m = 1500", dispersions="...")`."""
    return partial(write_campaign, tmp_path)


@pytest.fixture
def watch() -> RecordingWatch:
    """Return a progress watch that records stages, steps and notes of a run without printing."""
    return RecordingWatch()


@pytest.fixture(scope="session")
def failing_campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run `FAILING_CASES` and return the campaign folder. Tests must not change the folder."""
    folder = tmp_path_factory.mktemp("campaign")
    return run(write_campaign(folder, FAILING_CASES), folder / "failing_campaign", RecordingWatch(), jobs=2)
