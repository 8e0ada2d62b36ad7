"""Time and disk space of a campaign are estimated from a few of its cases."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.running.preparation import estimate

CampaignFile = Callable[..., Path]


def test_trial_cases_estimate_time_and_disk_space(campaign_file: CampaignFile) -> None:
    campaign = load_campaign(str(campaign_file("sleep_s = 0.05")), ["cases=1000", "retain.products=all"])
    found = estimate(campaign, jobs=2)
    assert (found.trials, found.unfinished) == (9, 0)
    assert 0.05 <= found.case_s < 0.5
    assert found.time_s == pytest.approx(1000 * found.case_s / 2)
    # a row of some 15 columns, products of some kilobytes
    assert 1e5 < found.rows_bytes < 1e6
    assert 5e5 < found.products_bytes < 5e6
