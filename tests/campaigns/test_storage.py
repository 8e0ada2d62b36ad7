"""Rows and products come back from disk as they went there."""

from __future__ import annotations

import math
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from campaigns import record
from campaigns.errors import StoreError
from campaigns.products import load_products, save_products
from campaigns.store import RowStore, read_rows, write_table


def test_rows_come_back_in_the_order_of_their_cases(tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = [
        {"case": 2, "x": math.nan, "big": 2**62},
        {"case": 0, "x": math.inf, "text": "ä\0\n"},
        {"case": 1, "x": 0.1 + 0.2, "flag": True},
    ]
    with RowStore(tmp_path / "cases.sqlite") as store:
        for row in rows:
            store.add(row)
        stored = list(store.rows())
        with pytest.raises(StoreError, match="UNIQUE"):
            store.add(rows[0])
        with pytest.raises(StoreError, match="locked"):
            RowStore(tmp_path / "cases.sqlite")
    assert [row["case"] for row in stored] == [0, 1, 2]
    assert stored[1] == rows[2]
    assert math.isnan(float(stored[2]["x"]))
    assert stored[0]["text"] == "ä\0\n"


def test_rows_survive_a_program_that_never_closes(tmp_path: Path) -> None:
    store = RowStore(tmp_path / "cases.sqlite")
    store.add({"case": 0})
    for name in ("cases.sqlite", "cases.sqlite-wal"):
        (tmp_path / f"copy-{name}").write_bytes((tmp_path / name).read_bytes())
    store.__exit__(None, None, None)
    connection = sqlite3.connect(tmp_path / "copy-cases.sqlite")
    assert connection.execute("SELECT count(*) FROM cases").fetchone() == (1,)
    connection.close()


def test_columns_take_the_narrowest_type(tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = [
        {"case": 0, "mixed": 1, "whole": 1, "odd": 1, "huge": 10**30, "lacking": 1.0},
        {"case": 1, "mixed": 2.5, "whole": 2, "odd": "x", "huge": 1, "late": "y"},
    ]
    write_table(tmp_path / "t.parquet", rows, ["absent"])
    first, second = read_rows(tmp_path / "t.parquet")
    assert (first["mixed"], type(first["whole"]), first["odd"], first["huge"]) == (1.0, int, "1", 1e30)
    assert math.isnan(second["lacking"])
    assert math.isnan(first["absent"])
    assert ("late" in first, second["late"]) == (False, "y")
    assert not list(tmp_path.glob("*.partial"))


def test_an_empty_table_is_one(tmp_path: Path) -> None:
    write_table(tmp_path / "t.parquet", [])
    assert read_rows(tmp_path / "t.parquet") == []
    (tmp_path / "t.parquet").write_text("not a table")
    with pytest.raises(StoreError, match="not a table of cases"):
        read_rows(tmp_path / "t.parquet")


def test_records_that_are_not_ours_are_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no such folder"):
        record.read(tmp_path / "nothing")
    with pytest.raises(StoreError, match=r"it has no campaign\.json"):
        record.read(tmp_path)
    for text, said in (("{", "damaged"), ("[]", "damaged"), ("{}", "damaged"), ('{"schema": 99}', "has schema 99")):
        (tmp_path / "campaign.json").write_text(text)
        with pytest.raises(StoreError, match=said):
            record.read(tmp_path)
    (tmp_path / "campaign.json").write_text('{"schema": 1, "configuration": {"name": 3}}')
    with pytest.raises(StoreError, match="damaged"):
        record.stored_configuration(tmp_path)


_leaf = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5)
_array = st.sampled_from(
    [np.arange(3, dtype=np.uint16), np.eye(2), np.zeros((0, 2), np.float32), np.array(["ab", "c"])]
)
_key = st.text(max_size=3)
_products = st.dictionaries(
    st.text(max_size=5),
    st.recursive(_leaf | _array, lambda inner: st.lists(inner, max_size=2) | st.dictionaries(_key, inner)),
    max_size=4,
)


def _same(value: Any, other: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype == other.dtype and np.array_equal(value, other)
    if isinstance(value, dict):
        return value.keys() == other.keys() and all(_same(value[key], other[key]) for key in value)
    if isinstance(value, list):
        return len(value) == len(other) and all(map(_same, value, other))
    return type(value) is type(other) and value == other


@given(products=_products)
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_products_come_back_as_they_were(tmp_path: Path, products: dict[str, Any]) -> None:
    save_products(tmp_path, products)
    assert _same(products, load_products(tmp_path))


@pytest.mark.parametrize("value", [object(), np.array([object()]), {1, 2}])
def test_products_of_other_kinds_are_named(tmp_path: Path, value: object) -> None:
    with pytest.raises(TypeError, match=r"products\.a\.0 is a"):
        save_products(tmp_path, {"a": [value]})
    with pytest.raises(StoreError, match="holds no products"):
        load_products(tmp_path)
