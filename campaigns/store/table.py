"""The Parquet table of a campaign: made from its store row group by row group, so that memory stays small."""

from __future__ import annotations

import gc
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store.columns import LEADING_COLUMNS, TRAILING_COLUMNS, Row
from marsyard.campaigns.store.record import stored_configuration
from marsyard.campaigns.store.rows import ROWS_FILE, RowStore, readable_store

TABLE_FILE = "cases.parquet"

#: Rows of a row group.
_GROUP = 50_000


def columns_of(layouts: Iterable[Sequence[str]], measures: Sequence[str] = ()) -> list[str]:
    """Every column in any layout: the engine's first and last, the scenario's between them as they first appear.

    `measures` are columns that there must be in any event.
    """
    found = dict.fromkeys(name for names in layouts for name in names)
    found.update(dict.fromkeys(measures))
    own = [name for name in found if name not in LEADING_COLUMNS and name not in TRAILING_COLUMNS]
    return [*LEADING_COLUMNS, *own, *TRAILING_COLUMNS]


def write_table(path: Path, store: RowStore, measures: Sequence[str] = ()) -> None:
    """Writes the rows of a store as a Parquet table in the order of the cases, whole or not at all.

    A number that a row lacks is NaN, anything else that it lacks is null.

    Parameters
    ----------
    path
        Where to.
    store
        The rows.
    measures
        Columns of numbers that the table must have even where no row does.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    layouts = store.names()
    columns = columns_of(layouts.values(), measures)
    kinds = store.kinds()
    forms = {name: _form(kinds.get(name, set())) for name in columns}
    schema = pa.schema([(name, form[0]) for name, form in forms.items()])
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        with pq.ParquetWriter(partial, schema) as writer, _no_search_for_garbage():
            for chunk in store.chunks(_GROUP):
                pairs = zip(_columns(chunk, layouts, columns), forms.values(), strict=True)
                arrays = [_array(values, *form) for values, form in pairs]
                writer.write_table(pa.Table.from_arrays(arrays, schema=schema), row_group_size=_GROUP)
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        raise StoreError(f"{path} cannot be written: {error.strerror or error}") from error
    except (TypeError, ValueError) as error:
        partial.unlink(missing_ok=True)
        raise StoreError(f"{path} cannot be made, as {ROWS_FILE} is damaged: a row cannot be read: {error}") from error


def _columns(
    chunk: Sequence[tuple[int, list[Any]]], layouts: Mapping[int, Sequence[str]], columns: Sequence[str]
) -> Iterator[Sequence[Any]]:
    """The values of each column in a chunk of rows; None where a row lacks it."""
    places: dict[int, list[int]] = {}
    for place, (layout, _) in enumerate(chunk):
        places.setdefault(layout, []).append(place)
    parts = {
        layout: dict(zip(layouts[layout], zip(*(chunk[place][1] for place in found), strict=True), strict=True))
        for layout, found in places.items()
    }
    for name in columns:
        if len(parts) == 1:
            (part,) = parts.values()
            yield part.get(name, [None] * len(chunk))
            continue
        values: list[Any] = [None] * len(chunk)
        for layout, found in places.items():
            for place, value in zip(found, parts[layout].get(name, ()), strict=False):
                values[place] = value
        yield values


@contextmanager
def _no_search_for_garbage() -> Iterator[None]:
    """Rows do not refer to themselves, and looking through millions for some that do takes as long as reading them."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _array(values: Sequence[Any], type_: Any, convert: Callable[[Any], Any] | None) -> Any:
    """A column; numbers that are missing are NaN."""
    import pyarrow as pa
    import pyarrow.compute as pc

    array = pa.array([convert(value) for value in values] if convert else values, type_)
    return pc.fill_null(array, math.nan) if array.null_count and pa.types.is_floating(type_) else array


def _form(kinds: set[str]) -> tuple[Any, Callable[[Any], Any] | None]:
    """The narrowest type that holds all of a column's values, and what brings them to it."""
    import pyarrow as pa

    if kinds == {"bool"}:
        return pa.bool_(), None
    if kinds == {"int"}:
        return pa.int64(), None
    if kinds <= {"float"}:
        return pa.float64(), None
    if kinds <= {"int", "big", "float"}:
        return pa.float64(), _number
    return pa.string(), None if kinds == {"str"} else _text


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def _text(value: Any) -> str | None:
    return None if value is None else str(value)


def read_rows(path: Path, case: int | None = None) -> list[dict[str, Any]]:
    """The rows of a Parquet table, without what they lack; of all cases, or of one.

    Raises
    ------
    StoreError
        Where there is no such table.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        only = None if case is None else [("case", "==", case)]
        rows: list[dict[str, Any]] = pq.read_table(path, filters=only).to_pylist()
    except (OSError, pa.ArrowException) as error:
        raise StoreError(f"{path}: not a table of cases: {error}") from error
    return [{name: value for name, value in row.items() if value is not None} for row in rows]


def refresh_table(directory: Path) -> None:
    """Makes the table of a campaign that is not finished from the rows that it has so far.

    Raises
    ------
    StoreError
        Where it has no store that can be read, or the table cannot be written.
    """
    if not (directory / ROWS_FILE).exists() and (directory / TABLE_FILE).exists():
        return  # of an earlier version, which wrote the table when it was interrupted
    requirements = stored_configuration(directory).requirements
    with RowStore(directory / ROWS_FILE) as store:
        write_table(directory / TABLE_FILE, store, [asked.metric for asked in requirements if asked.bound is not None])


def stored_row(directory: Path, case: int) -> Row | None:
    """The row of a case of a stored campaign; None where it has none."""
    if (directory / ROWS_FILE).is_file():
        with readable_store(directory / ROWS_FILE) as store:
            return store.row(case)
    table = directory / TABLE_FILE
    return next(iter(read_rows(table, case)), None) if table.exists() else None
