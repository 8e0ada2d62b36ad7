"""A replayed case is compared with its stored row."""

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


def test_replay_reports_differing_columns(troubled: Path, tmp_path: Path) -> None:
    troubled = shutil.copytree(troubled, tmp_path / "copy")
    frame = pd.read_parquet(troubled / "cases.parquet")
    altitudes = frame["altitude_m"].to_numpy(copy=True)
    altitudes[4] = np.nextafter(altitudes[4], np.inf)
    frame["altitude_m"] = altitudes
    frame.to_parquet(troubled / "cases.parquet")
    (troubled / "cases.sqlite").unlink()
    assert replay(troubled, 4).differing == ("altitude_m",)
    with pytest.raises(CampaignError, match="has no case 12; allowed: 0 to 11"):
        replay(troubled, 12)
    with pytest.raises(StoreError, match="does not hold a campaign"):
        replay(troubled / "cases", 0)
