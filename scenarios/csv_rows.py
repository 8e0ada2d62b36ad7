"""Read and validate CSV tables of a user row by row: pictures to ingest, answers to score."""

from __future__ import annotations

import csv
import difflib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from marsyard.sim.files import check_regular


def read_lines(path: Path, max_rows: int) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Read the column names and the non-empty lines with their numbers.

    Raises ValueError where the file is unreadable, is no table with commas, or has too many rows.
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


def header_problems(header: Sequence[str], needed: Sequence[str], allowed: Sequence[str], hint: str) -> Iterator[str]:
    """Yield missing, unknown and repeated columns; `hint` states the allowed ones."""
    if not header:
        yield "it is empty"
        return
    for name in needed:
        if name not in header:
            yield f"the column '{name}' is missing"
    for name in dict.fromkeys(header):
        if name not in allowed:
            near = difflib.get_close_matches(name, allowed, n=1, cutoff=0.6)
            suggestion = f" (did you mean '{near[0]}'?)" if near else ""
            yield f"unknown column '{name}'{suggestion}; {hint}"
        if header.count(name) > 1:
            yield f"the column '{name}' stands there twice"


def cells_by_column(header: Sequence[str], cells: Sequence[str]) -> dict[str, str]:
    """Return a row's cells by column. Raises ValueError for another number of cells than columns."""
    if len(cells) != len(header):
        raise ValueError(f"it has {len(cells)} cells; the first line has {len(header)}")
    return dict(zip(header, cells, strict=True))


def finite_number(name: str, text: str, otherwise: str = "") -> float:
    """Parse a finite number. Raises ValueError, whose message ends with `otherwise`."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{name} is '{text}'; allowed: a finite number{otherwise}")
    return value


def check_together(groups: Iterable[Sequence[str]], given: Mapping[str, float]) -> None:
    """Raise ValueError where a group of columns is filled in part."""
    for names in groups:
        filled = [name for name in names if name in given]
        missing = [name for name in names if name not in given]
        if filled and missing:
            raise ValueError(f"{filled[0]} is given, but {missing[0]} is not")
