"""Tests of replayed cases against their stored rows."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from marsyard.campaigns.errors import CampaignError, StoreError
from marsyard.campaigns.running.replay import replay

CampaignFile = Callable[..., Path]


def test_replay_reports_differing_columns(failing_campaign: Path, tmp_path: Path) -> None:
    failing_campaign = shutil.copytree(failing_campaign, tmp_path / "copy")
    frame = pd.read_parquet(failing_campaign / "cases.parquet")
    altitudes = frame["altitude_m"].to_numpy(copy=True)
    altitudes[4] = np.nextafter(altitudes[4], np.inf)
    frame["altitude_m"] = altitudes
    frame.to_parquet(failing_campaign / "cases.parquet")
    (failing_campaign / "cases.sqlite").unlink()
    assert replay(failing_campaign, 4).differing == ("altitude_m",)
    with pytest.raises(CampaignError, match="has no case 12; allowed: 0 to 11"):
        replay(failing_campaign, 12)
    with pytest.raises(StoreError, match="does not contain a campaign"):
        replay(failing_campaign / "cases", 0)
