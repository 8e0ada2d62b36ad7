"""Tests of the estimated time and disk space of a campaign."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.running import preparation
from marsyard.campaigns.running.preparation import estimate_campaign

CampaignFile = Callable[..., Path]


def test_estimate_follows_from_trial_cases(campaign_file: CampaignFile) -> None:
    campaign = load_campaign(str(campaign_file("sleep_s = 0.05")), ["cases=1000", "retain.products=all"])
    cost = estimate_campaign(campaign, jobs=2)
    # an estimate runs at most 9 trial cases
    assert (cost.trials, cost.unfinished) == (9, 0)
    assert 0.05 <= cost.case_s < 0.5
    assert cost.time_s == pytest.approx(1000 * cost.case_s / 2)
    # 1000 rows of about 15 columns (0.1 to 1 kB each), and products of 0.5 to 5 kB per case
    assert 1e5 < cost.rows_bytes < 1e6
    assert 5e5 < cost.products_bytes < 5e6


def test_time_of_the_first_trial_case_is_left_out(campaign_file: CampaignFile, monkeypatch: pytest.MonkeyPatch) -> None:
    # the first trial case includes the start of the worker and the compilation of kernels
    monkeypatch.setattr(preparation, "_MAX_TRIAL_TIME_S", 0.0)
    cost = estimate_campaign(load_campaign(str(campaign_file("sleep_s = 0.05")), ["cases=1000"]), jobs=1)
    assert cost.trials == 2
    assert cost.case_range_s[0] == cost.case_range_s[1]
