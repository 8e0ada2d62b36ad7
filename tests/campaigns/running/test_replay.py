"""Tests of `replay`: a case runs again, and its row is compared with the stored row."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from marsyard.campaigns.errors import CampaignError, StoreError
from marsyard.campaigns.running.replay import replay


def test_replay_reports_differing_columns(failing_campaign: Path, tmp_path: Path) -> None:
    directory = shutil.copytree(failing_campaign, tmp_path / "copy")
    frame = pd.read_parquet(directory / "cases.parquet")
    altitudes = frame["altitude_m"].to_numpy(copy=True)
    altitudes[4] = np.nextafter(altitudes[4], np.inf)
    frame["altitude_m"] = altitudes
    frame.to_parquet(directory / "cases.parquet")
    # without the database, `replay` reads the rows from the table
    (directory / "cases.sqlite").unlink()
    assert replay(directory, 4).differing == ("altitude_m",)
    with pytest.raises(CampaignError, match="has no case 12; allowed: 0 to 11"):
        replay(directory, 12)
    with pytest.raises(StoreError, match="does not contain a campaign"):
        replay(directory / "cases", 0)
