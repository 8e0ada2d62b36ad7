"""Tests of stored products: the configured cases and the showcase (the case that reports show)."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.running.replay import differing_columns
from marsyard.campaigns.store import record
from marsyard.campaigns.store.product_selection import find_showcase, find_worst_cases
from marsyard.campaigns.store.products import load_products
from marsyard.campaigns.store.rows import RowStore, create_store
from marsyard.campaigns.store.table import write_table
from tests.campaigns.fake_campaign import CampaignFile, RecordingWatch, read_case_rows, run


def test_showcase_is_the_worst_answered_case(failing_campaign: Path) -> None:
    rows = read_case_rows(failing_campaign)
    worst = max((row for row in rows if row["answered"]), key=lambda row: row["velocity_error_m_s"])["case"]
    assert record.read(failing_campaign)["showcase"] == worst
    folder = failing_campaign / "cases" / str(worst)
    assert differing_columns(json.loads((folder / "row.json").read_text()), rows[worst]) == ()
    products = load_products(folder)
    assert products["image"].dtype == np.uint16
    assert products["image"].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert np.array_equal(products["nested"][0]["x"], np.eye(2))
    assert products["title"] == "a"


def test_showcase_follows_the_definition(campaign_file: CampaignFile, tmp_path: Path) -> None:
    """Without an answered case, or without a requirement, the showcase is the first case that has finished."""
    rows: list[dict[str, Any]] = [
        {"case": 0, "outcome": "CRASHED", "answered": False},
        {"case": 1, "outcome": "SILENT", "answered": False, "velocity_error_m_s": math.nan},
        {"case": 2, "outcome": "VALID", "answered": True, "velocity_error_m_s": 1.0},
        {"case": 3, "outcome": "VALID", "answered": True, "velocity_error_m_s": -2.0},
    ]
    create_store(tmp_path / "cases.sqlite", {})
    with RowStore(tmp_path / "cases.sqlite") as store:
        table = tmp_path / "cases.parquet"
        store.add(rows[:1])
        write_table(table, store, ["velocity_error_m_s"])
        worst = load_campaign(str(campaign_file()), ["retain.worst=9"]).definition
        first = load_campaign(str(campaign_file()), ["retain.showcase=first"]).definition
        none = load_campaign(str(campaign_file()), ["retain.showcase=none"]).definition
        no_requirement = load_campaign(str(campaign_file(requirement=""))).definition
        assert find_showcase(worst, table, store) is None
        store.add(rows[1:2])
        write_table(table, store)
        assert find_showcase(worst, table, store) == 1
        store.add(rows[2:])
        write_table(table, store)
        assert [find_showcase(definition, table, store) for definition in (worst, first, none, no_requirement)] == [
            3,
            1,
            None,
            1,
        ]  # case 3 has the largest absolute error
    assert [find_worst_cases(definition, table, definition.retain.worst) for definition in (worst, no_requirement)] == [
        [3, 2],
        [],
    ]
    # a requirement on a sum of times selects no worst case
    requirement = 'id = "T"\nmetric = "a_time_s + b_time_s"\nbound = 2.0\nprobability = 0.9\nconfidence = 0.9\n'
    time_sum = load_campaign(str(campaign_file(requirement=f"[[requirements]]\n{requirement}"))).definition
    assert find_worst_cases(time_sum, table, 2) == []


@pytest.mark.usefixtures("inline_workers")
def test_unsupported_products_stop_no_campaign(
    campaign_file: CampaignFile, tmp_path: Path, watch: RecordingWatch
) -> None:
    directory = run(campaign_file(), tmp_path / "run", watch, "products=bad", "cases=2", jobs=1)
    assert record.read(directory)["state"] == "finished"
    assert "products.unsupported is a object; allowed" in watch.notes[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "cases"),
    [
        (["retain.products=all"], [0, 1, 3, 4, 5]),
        (["retain.products=every", "retain.every=3"], [0, 3]),
        (["retain.products=failed"], [1]),
        (["retain.products=worst", "retain.worst=2"], None),
        # the budget of 1 kB is used by the products of the first case
        (["retain.products=all", "retain.budget_gb=1e-6"], [0]),
    ],
)
@pytest.mark.usefixtures("inline_workers")
def test_products_of_configured_cases_are_stored(
    campaign_file: CampaignFile, tmp_path: Path, watch: RecordingWatch, overrides: list[str], cases: list[int] | None
) -> None:
    # case 1 fails without an answer; case 2 crashes and has no products
    path = campaign_file("unanswered_cases = [1]\nraising_cases = [2]")
    directory = run(path, tmp_path / "run", watch, "cases=6", "retain.showcase=none", *overrides, jobs=1)
    rows = read_case_rows(directory)
    if cases is None:
        answered_rows = [row for row in rows if row["answered"]]
        cases = sorted(row["case"] for row in sorted(answered_rows, key=lambda row: -row["velocity_error_m_s"])[:2])
    stored_cases = sorted(int(path.name) for path in (directory / "cases").iterdir())
    assert stored_cases == cases
    for case in stored_cases:
        assert load_products(directory / "cases" / str(case))["title"] == "a"
        stored_row = json.loads((directory / "cases" / str(case) / "row.json").read_text())
        assert differing_columns(stored_row, rows[case]) == ()
    assert [note for note in watch.notes if "budget" in note] == (
        ["the disk space for products (retain.budget_gb) is used: none are stored from case 1 on"]
        if "retain.budget_gb=1e-6" in overrides
        else []
    )
