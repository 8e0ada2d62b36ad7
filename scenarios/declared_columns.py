"""Declared columns of all scenarios: found by name, and in words."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

from marsyard.scenarios.columns import ENGINE, Column, Columns, split_unit, to_words
from marsyard.scenarios.imports import import_object
from marsyard.scenarios.systems import find_system, systems


@cache
def row_columns(scenario: str) -> Columns | None:
    """Return the columns of a scenario; None if its system declares none. Raises ValueError for an invalid one."""
    system = find_system(scenario)
    path = None if system is None else system.columns.get(scenario)
    if path is None:
        return None
    try:
        columns = import_object(path)
    except ImportError as error:
        raise ValueError(f"the columns of '{scenario}' cannot be imported: {error}") from error
    if not isinstance(columns, Columns):
        raise ValueError(f"{path} is a {type(columns).__name__}; allowed: a marsyard.scenarios.columns.Columns")
    return columns


@cache
def _all_columns() -> Columns:
    """Return the columns of all scenarios; the first declaration of a name applies."""
    columns = {item.name: item for item in ENGINE}
    for scenario in (name for system in systems() for name in system.columns):
        try:
            declared = row_columns(scenario)
        except ValueError:  # campaigns of the scenario report the error
            continue
        for item in declared or ():
            columns.setdefault(item.name, item)
    return Columns(tuple(columns.values()))


@cache
def find_column(name: str) -> Column | None:
    """Return the declaration of a column of any scenario; None if there is none."""
    return _all_columns().find(name)


def enabling_columns(names: Iterable[str]) -> list[Column]:
    """Return the declarations of the flags without which an algorithm cannot answer, among columns given by name."""
    return [column for name in names if (column := find_column(name)) is not None and column.enables_answer]


@cache
def label(column: str) -> str:
    """Return a column in words, without its unit: ``velocity error``.

    The label of a compared algorithm precedes its columns. A sampled value, whose name is the path of its parameter,
    is named by the last two parts of the path.
    """
    found = find_column(column)
    if found is not None:
        return found.label_of(column)
    prefix, _, name = column.rpartition(".")
    compared = find_column(name) if prefix and "." not in prefix else None
    if compared is not None:
        return f"{to_words(prefix)} {compared.label_of(name)}"
    return to_words(".".join(split_unit(column)[0].split(".")[-2:]))
