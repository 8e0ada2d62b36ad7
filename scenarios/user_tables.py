"""Comma-separated tables of users: rows as parsed, and one message for each problem."""

import csv
import difflib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from marsyard.algorithms.faults import AlgorithmError
from marsyard.sim.files import check_regular

Row = TypeVar("Row")
#: Maximum number of problems of a file in one message.
_MAX_PROBLEMS = 20


def format_problems(file: Path, problems: Sequence[str]) -> str:
    """Format the problems of a file as one message of limited length."""
    more = [f"... and {len(problems) - _MAX_PROBLEMS} more"] if len(problems) > _MAX_PROBLEMS else []
    return "\n  ".join([f"{file}:", *problems[:_MAX_PROBLEMS], *more])


def parse_table(
    path: Path,
    max_rows: int,
    required: Sequence[str],
    allowed: Sequence[str],
    hint: str,
    parse: Callable[[int, Mapping[str, str]], Row],
) -> tuple[list[Row], list[str]]:
    """Parse the rows of a comma-separated table; return the valid rows, and one message for each invalid row.

    Raises ValueError if the file is unreadable or not comma-separated, has too many rows, or has missing or unknown
    columns; `hint` contains the allowed columns. `parse` receives the line number and the cells by column; it raises
    ValueError or AlgorithmError for an invalid row.
    """
    header, lines = _read_lines(path, max_rows)
    problems = list(_header_problems(header, required, allowed, hint))
    if problems:
        raise ValueError(format_problems(path, problems))
    rows: list[Row] = []
    for line, cells in lines:
        try:
            if len(cells) != len(header):
                raise ValueError(f"it has {len(cells)} cells; the first line has {len(header)}")
            rows.append(parse(line, dict(zip(header, cells, strict=True))))
        except (ValueError, AlgorithmError) as error:
            problems.append(f"line {line}: {error}")
    return rows, problems


def _read_lines(path: Path, max_rows: int) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Read the header and the rows with their line numbers, without empty rows. Raises ValueError."""
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
                    raise ValueError(f"{path}: has more than {max_rows} rows; split the file")
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: is not a comma-separated table: {error}") from error
    return header, lines


def _header_problems(
    header: Sequence[str], required: Sequence[str], allowed: Sequence[str], hint: str
) -> Iterator[str]:
    """Yield the missing, unknown and duplicate columns of a header."""
    if not header:
        yield "it is empty"
        return
    for name in required:
        if name not in header:
            yield f"the column '{name}' is missing"
    for name in dict.fromkeys(header):
        if name not in allowed:
            matches = difflib.get_close_matches(name, allowed, n=1)
            suggestion = f" (did you mean '{matches[0]}'?)" if matches else ""
            yield f"unknown column '{name}'{suggestion}; {hint}"
        if header.count(name) > 1:
            yield f"duplicate column '{name}'"


def finite_number(name: str, text: str, hint: str = "") -> float:
    """Parse a finite number. Raises ValueError; `hint` is the end of the message."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{name} is '{text}'; allowed: a finite number{hint}")
    return value


def check_column_groups(groups: Iterable[Sequence[str]], values: Mapping[str, float]) -> None:
    """Raise ValueError if a row contains only some values of a group of columns."""
    for names in groups:
        names_with_value = [name for name in names if name in values]
        missing = [name for name in names if name not in values]
        if names_with_value and missing:
            raise ValueError(f"{names_with_value[0]} is given, but {missing[0]} is not")
