"""What tables of a user's own are held against, row by row: pictures to ingest, answers to score."""

from __future__ import annotations

import csv
import difflib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from marsyard.sim.files import check_regular


def read_lines(path: Path, max_rows: int) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Names of the columns of a table, and its lines that are not empty with their numbers.

    Raises
    ------
    ValueError
        Where the file cannot be read, is no table with commas, or has too many rows.
    """
    try:
        check_regular(path)
        with path.open(newline="", encoding="utf-8-sig") as text:
            reader = csv.reader(text)
            header = [name.strip() for name in next(reader, [])]
            lines = []
            for cells in reader:
                if any(cell.strip() for cell in cells):
                    lines.append((reader.line_num, [cell.strip() for cell in cells]))
                if len(lines) > max_rows:
                    raise ValueError(f"{path}: has more than {max_rows} rows; divide it")
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: is no table with commas: {error}") from error
    return header, lines


def header_problems(header: Sequence[str], needed: Sequence[str], allowed: Sequence[str], said: str) -> Iterator[str]:
    """What is wrong with the columns' names: none at all, missing, unknown, twice. `said` tells what is allowed."""
    if not header:
        yield "it is empty"
        return
    for name in needed:
        if name not in header:
            yield f"the column '{name}' is missing"
    for name in dict.fromkeys(header):
        if name not in allowed:
            near = difflib.get_close_matches(name, allowed, n=1, cutoff=0.6)
            hint = f" (did you mean '{near[0]}'?)" if near else ""
            yield f"unknown column '{name}'{hint}; {said}"
        if header.count(name) > 1:
            yield f"the column '{name}' stands there twice"


def cells_by_column(header: Sequence[str], cells: Sequence[str]) -> dict[str, str]:
    """A row's cells by their columns. Raises ValueError where there are more or fewer than columns."""
    if len(cells) != len(header):
        raise ValueError(f"it has {len(cells)} cells; the first line has {len(header)}")
    return dict(zip(header, cells, strict=True))


def finite_number(name: str, text: str, otherwise: str = "") -> float:
    """The number in a cell. Raises ValueError where it is none or not finite; `otherwise` says what else may be."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{name} is '{text}'; allowed: a finite number{otherwise}")
    return value


def check_together(groups: Iterable[Sequence[str]], given: Mapping[str, float]) -> None:
    """Raises ValueError where of columns that go together some are given and some are not."""
    for names in groups:
        there = [name for name in names if name in given]
        lacking = [name for name in names if name not in given]
        if there and lacking:
            raise ValueError(f"{there[0]} is given, but {lacking[0]} is not")
