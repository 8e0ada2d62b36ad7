"""Reads `pictures.csv`: one row a picture, texts and finite numbers by their columns, cases in their order."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.scenarios.csv_rows import cells_by_column, check_together, finite_number, header_problems, read_lines
from marsyard.scenarios.measured.layout import COLUMNS, PICTURES, TEXTS, IngestError
from marsyard.scenarios.own_files import listed

#: A quaternion's length may be off 1 by this, as written with three digits.
UNIT_TOLERANCE = 5e-3
#: So many rows would take days to match.
MOST_ROWS = 200_000


@dataclass(frozen=True)
class PictureRow:
    """A row: its line in the file, its texts and numbers by their columns; what is empty is not there."""

    line: int
    texts: Mapping[str, str]
    numbers: Mapping[str, float]

    def number(self, name: str) -> float | None:
        """A column's number; None where it is empty."""
        return self.numbers.get(name)

    def vector(self, names: Sequence[str]) -> Float64[np.ndarray, "n"] | None:
        """The numbers of columns that go together; None where they are empty."""
        found = [self.numbers[name] for name in names if name in self.numbers]
        return np.array(found) if len(found) == len(names) else None

    def rotation(self, prefix: str = "") -> Rotation | None:
        """The row's quaternion; None where it is empty."""
        quaternion = self.vector([f"{prefix}q{axis}" for axis in "xyzw"])
        return None if quaternion is None else Rotation.from_quat(quaternion)


@dataclass(frozen=True)
class CaseRows:
    """The rows of one case."""

    name: str
    rows: tuple[PictureRow, ...]


#: Columns of which all or none are filled in a row.
_TOGETHER = (
    ("qx", "qy", "qz", "qw"),
    ("x_m", "y_m", "z_m"),
    ("vx_m_s", "vy_m_s", "vz_m_s"),
    ("sun_azimuth_deg", "sun_elevation_deg"),
    ("site_x_m", "site_y_m", "site_z_m"),
    ("true_vx_m_s", "true_vy_m_s"),
    ("true_x_m", "true_y_m", "true_z_m"),
    ("true_qx", "true_qy", "true_qz", "true_qw"),
)
#: Columns whose numbers are above 0.
_POSITIVE = ("altitude_m", "slant_range_m")


def read_table(path: Path, task: str) -> tuple[CaseRows, ...]:
    """The cases of a table, in the order of their first rows.

    Raises
    ------
    IngestError
        Where it cannot be read, or holds anything that is not allowed; all that is wrong is told, by line.
    """
    try:
        header, lines = read_lines(path, MOST_ROWS)
    except ValueError as error:
        raise IngestError(str(error)) from error
    problems = list(_header_problems(header, task))
    if problems:
        raise IngestError(listed(path, problems))
    rows: list[PictureRow] = []
    for line, cells in lines:
        try:
            rows.append(_row(line, header, cells))
        except ValueError as error:
            problems.append(f"line {line}: {error}")
    cases = _grouped(rows)
    if not problems:
        problems = [problem for case in cases for problem in _case_problems(case, task)]
    if not rows and not problems:
        problems = ["it has no rows; at least one case is needed"]
    if problems:
        raise IngestError(listed(path, problems))
    return cases


def _header_problems(header: Sequence[str], task: str) -> Iterator[str]:
    allowed = [column.name for column in COLUMNS if task in column.tasks]
    needed = [column.name for column in COLUMNS if task in column.tasks and column.needed == "every"]
    return header_problems(header, needed, allowed, f"allowed for {task}: {', '.join(allowed)}")


def _row(line: int, header: Sequence[str], cells: Sequence[str]) -> PictureRow:
    stated = {name: cell for name, cell in cells_by_column(header, cells).items() if cell}
    row = PictureRow(
        line,
        {name: cell for name, cell in stated.items() if name in TEXTS},
        {name: _number(name, cell) for name, cell in stated.items() if name not in TEXTS},
    )
    for name in ("case", "file"):
        if name not in row.texts:
            raise ValueError(f"{name} is empty")
    check_together(_TOGETHER, row.numbers)
    for prefix in ("", "true_"):
        _check_quaternion(row.vector([f"{prefix}q{axis}" for axis in "xyzw"]), f"{prefix}qx to {prefix}qw")
    return row


def _number(name: str, text: str) -> float:
    value = finite_number(name, text)
    if name in _POSITIVE and value <= 0.0:
        raise ValueError(f"{name} is {text}; allowed: above 0")
    return value


def _check_quaternion(quaternion: Float64[np.ndarray, "n"] | None, names: str) -> None:
    if quaternion is None:
        return
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > UNIT_TOLERANCE:
        raise ValueError(f"the quaternion {names} has the length {length:.4g}; allowed: 1 to {UNIT_TOLERANCE:g}")


def _grouped(rows: Sequence[PictureRow]) -> tuple[CaseRows, ...]:
    cases: dict[str, list[PictureRow]] = {}
    for row in rows:
        cases.setdefault(row.texts["case"], []).append(row)
    return tuple(CaseRows(name, tuple(of_case)) for name, of_case in cases.items())


def _case_problems(case: CaseRows, task: str) -> Iterator[str]:
    """What is wrong with the rows of a case together."""
    least, most = PICTURES[task]
    first = case.rows[0].line
    if not least <= len(case.rows) <= most:
        allowed = str(least) if least == most else f"{least} to {most}"
        yield f"line {first}: case '{case.name}' has {len(case.rows)} pictures; allowed for {task}: {allowed}"
    for before, row in itertools.pairwise(case.rows):
        times = (before.number("time_s"), row.number("time_s"))
        if times[0] is not None and times[1] is not None and times[1] <= times[0]:
            yield f"line {row.line}: time goes from {times[0]:g} to {times[1]:g} s; allowed: times that increase"
    for row in case.rows:
        for column in COLUMNS:
            if column.needed == "every" and task in column.tasks and column.name not in {**row.texts, **row.numbers}:
                yield f"line {row.line}: {column.name} is empty"
