"""Parquet table of a campaign's rows: it is written from the row store, in row groups to limit memory, and read.

A layout is the tuple of column names of a stored row (`marsyard.campaigns.store.rows`): rows of one campaign can have
different columns.
"""

import gc
import hashlib
import itertools
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.campaign_file import Requirement
from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store.origin import check_rows
from marsyard.campaigns.store.record import stored_definition
from marsyard.campaigns.store.rows import LEADING_COLUMNS, ROWS_FILE, TRAILING_COLUMNS, Row, RowStore, readable_store
from marsyard.campaigns.store.temporary_files import replace_file
from marsyard.sim.files import report_damage

TABLE_FILE = "cases.parquet"
#: Number of rows in a row group.
_GROUP_ROWS = 50_000


def write_table(path: Path, store: RowStore, metric_columns: Sequence[str] = ()) -> None:
    """Write the rows of a store as a Parquet table in the order of the cases, atomically, and record its SHA-256.

    The columns of the engine come before and after those of the scenario. Missing numbers are NaN, other missing values
    are null. The table always contains the numeric columns `metric_columns`.
    """
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    layouts, kinds = store.columns_by_layout(), store.kinds()
    columns = dict.fromkeys((*itertools.chain.from_iterable(layouts.values()), *metric_columns))
    scenario_columns = [name for name in columns if name not in (*LEADING_COLUMNS, *TRAILING_COLUMNS)]
    names = (*LEADING_COLUMNS, *scenario_columns, *TRAILING_COLUMNS)
    types = {name: _choose_type(kinds.get(name, set())) for name in names}
    schema = pa.schema([(name, kind) for name, (kind, _) in types.items()])
    try:
        with replace_file(path) as partial, pq.ParquetWriter(partial, schema) as writer, ExitStack() as stack:
            if gc.isenabled():
                # with millions of rows garbage collection takes as long as reading, and rows have no cyclic references
                gc.disable()
                stack.callback(gc.enable)
            for chunk in store.chunks(_GROUP_ROWS):
                arrays = []
                for values, (kind, convert) in zip(
                    _transpose(chunk, layouts, list(types)), types.values(), strict=True
                ):
                    if convert is not None:
                        values = [None if value is None else convert(value) for value in values]
                    array = pa.array(values, kind)
                    needs_fill = array.null_count and pa.types.is_floating(kind)
                    arrays.append(pc.fill_null(array, math.nan) if needs_fill else array)
                writer.write_table(pa.Table.from_arrays(arrays, schema=schema), row_group_size=_GROUP_ROWS)
            writer.close()
            with partial.open("rb") as file:
                os.fsync(file.fileno())
                digest = hashlib.file_digest(file, "sha256").hexdigest()
        store.record_table(digest)
    except OSError as error:
        raise StoreError(f"{path} cannot be written: {error.strerror or error}") from error
    except (TypeError, ValueError) as error:
        raise StoreError(f"{path} cannot be written: {ROWS_FILE} is damaged: a row cannot be read: {error}") from error


def is_current(path: Path, store: RowStore) -> bool:
    """Whether a file is the table that was last written from the rows of a store."""
    with report_damage(path, StoreError, "cannot be read"), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == store.table_digest


def check_table(directory: Path) -> None:
    """Raise StoreError if the table of a campaign is not the one that was written from its rows."""
    with readable_store(directory / ROWS_FILE) as store:
        if not is_current(directory / TABLE_FILE, store):
            raise StoreError(
                f"{directory / TABLE_FILE} was changed, or was not completely written: to write it again from "
                f"{ROWS_FILE}: marsyard resume {directory}"
            )


def _transpose(
    chunk: Sequence[tuple[int, list[Any]]], layouts: Mapping[int, Sequence[str]], columns: Sequence[str]
) -> Iterator[Sequence[Any]]:
    """Yield the values of each column; None for missing values.

    - chunk: layout number and values of each row
    - layouts: column names by layout number
    """
    indices_by_layout: dict[int, list[int]] = {}
    for index, (layout, _) in enumerate(chunk):
        indices_by_layout.setdefault(layout, []).append(index)
    values_by_layout = {
        layout: dict(zip(layouts[layout], zip(*(chunk[index][1] for index in row_indices), strict=True), strict=True))
        for layout, row_indices in indices_by_layout.items()
    }
    for name in columns:
        if len(values_by_layout) == 1:
            (layout_values,) = values_by_layout.values()
            yield layout_values.get(name, [None] * len(chunk))
            continue
        values: list[Any] = [None] * len(chunk)
        for layout, row_indices in indices_by_layout.items():
            for index, value in zip(row_indices, values_by_layout[layout].get(name, ()), strict=False):
                values[index] = value
        yield values


def _choose_type(kinds: set[str]) -> tuple[Any, Callable[[Any], Any] | None]:
    """Return an Arrow type that represents all values of a column, and the conversion to it (None if not needed).

    `kinds` are the types of the column's values; "big" is an integer outside 64 bits (`RowStore.kinds`).
    """
    import pyarrow as pa

    if kinds == {"bool"}:
        return pa.bool_(), None
    if kinds == {"int"}:
        return pa.int64(), None
    if kinds <= {"int", "big", "float"}:
        return pa.float64(), None if kinds <= {"float"} else float
    return pa.string(), None if kinds == {"str"} else str


def read_rows(path: Path, case: int | None = None) -> list[dict[str, Any]]:
    """Read the rows of all cases or of one case from a Parquet table; missing values are omitted.

    Raises StoreError if there is no such table.
    """
    import pyarrow.parquet as pq

    with report_damage(path, StoreError, "not a table of cases"):
        case_filter = None if case is None else [("case", "==", case)]
        rows: list[dict[str, Any]] = pq.read_table(path, filters=case_filter).to_pylist()
    return [{name: value for name, value in row.items() if value is not None} for row in rows]


def refresh_table(directory: Path) -> None:
    """Verify the rows of a campaign, and write its table from them.

    Raises StoreError if a row was changed after it was stored, or the table is not writable.
    """
    if not (directory / ROWS_FILE).exists() and (directory / TABLE_FILE).exists():
        return  # a folder of which only the table was copied
    requirements = stored_definition(directory).requirements
    check_rows(directory)
    with RowStore(directory / ROWS_FILE) as store:
        write_table(directory / TABLE_FILE, store, numeric_metrics(requirements))


def numeric_metrics(requirements: Iterable[Requirement]) -> list[str]:
    """Return the columns of the requirements' metrics that are numbers."""
    return [column for item in requirements if item.bound is not None for column in item.metric_columns]


def stored_row(directory: Path, case: int) -> Row | None:
    """Read the row of a case of a stored campaign; None if it has none."""
    if (directory / ROWS_FILE).is_file():
        with readable_store(directory / ROWS_FILE) as store:
            return store.row(case)
    table = directory / TABLE_FILE
    return next(iter(read_rows(table, case)), None) if table.exists() else None
