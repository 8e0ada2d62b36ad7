"""Read `images.csv`, the table of images of `marsyard ingest` (docs/real-images.md)."""

import itertools
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.scenarios.measured.layout import LANDING, MAP, MATCHING, VELOCITY, IngestError
from marsyard.scenarios.user_tables import check_column_groups, finite_number, format_problems, parse_table

#: Minimum and maximum number of images of a case.
IMAGE_COUNTS = {VELOCITY: (3, 3), LANDING: (2, 2), MATCHING: (2, 50), MAP: (1, 1)}


class ImageColumn(NamedTuple):
    """A column of `images.csv`; `images.toml` describes all columns.

    - tasks: tasks that read the column
    - required: ``every`` if each row needs a value, empty if the column is optional, else the condition as text
    """

    name: str
    tasks: tuple[str, ...]
    required: str
    description: str


#: All columns, in the order of the documentation.
COLUMNS = tuple(
    ImageColumn(name, tuple(group["tasks"]), group["required"], group["description"])
    for group in tomllib.loads(Path(__file__).with_name("images.toml").read_text(encoding="utf-8"))["columns"]
    for name in group["names"].split()
)
_TEXT_COLUMNS = ("case", "file", "camera", "flat_field")
_POSITIVE_COLUMNS = ("altitude_m", "slant_range_m")
#: Groups of columns: a row must contain all values of a group, or none.
_COLUMN_GROUPS = (
    ("qx", "qy", "qz", "qw"),
    ("x_m", "y_m", "z_m"),
    ("vx_m_s", "vy_m_s", "vz_m_s"),
    ("sun_azimuth_deg", "sun_elevation_deg"),
    ("site_x_m", "site_y_m", "site_z_m"),
    ("true_vx_m_s", "true_vy_m_s"),
    ("true_x_m", "true_y_m", "true_z_m"),
    ("true_qx", "true_qy", "true_qz", "true_qw"),
)
#: Maximum deviation of a quaternion's length from 1; large enough for quaternions with three digits.
_QUATERNION_TOLERANCE = 5e-3
#: Maximum number of rows; matching more images would take days.
_MAX_ROWS = 200_000


@dataclass(frozen=True)
class ImageRow:
    """One row of `images.csv`: its line, and its filled cells by column."""

    line: int
    texts: Mapping[str, str]
    numbers: Mapping[str, float]

    def error(self, message: str) -> IngestError:
        """Return an error with the row's line."""
        return IngestError(f"line {self.line}: {message}")

    def vector(self, *names: str) -> Float64[np.ndarray, "n"] | None:
        """Return the numbers of columns that are filled together; None if they are empty."""
        return np.array([self.numbers[name] for name in names]) if names[0] in self.numbers else None

    def rotation(self, prefix: str = "") -> Rotation | None:
        """Return the rotation of the columns `qx` to `qw`; None if they are empty."""
        quaternion = self.vector(*(f"{prefix}q{axis}" for axis in "xyzw"))
        return None if quaternion is None else Rotation.from_quat(quaternion)


def read_table(path: Path, task: str) -> dict[str, list[ImageRow]]:
    """Read the rows of `images.csv` by case, in the order of the cases' first rows.

    Raises IngestError with all problems by line.
    """
    allowed = [column.name for column in COLUMNS if task in column.tasks]
    required = [column.name for column in COLUMNS if task in column.tasks and column.required == "every"]
    hint = f"allowed for {task}: {', '.join(allowed)}"
    try:
        image_rows, problems = parse_table(path, _MAX_ROWS, required, allowed, hint, _parse_row)
    except ValueError as error:
        raise IngestError(str(error)) from error
    cases: dict[str, list[ImageRow]] = {}
    for row in image_rows:
        cases.setdefault(row.texts["case"], []).append(row)
    if not problems:
        low, high = IMAGE_COUNTS[task]
        number = str(low) if low == high else f"{low} to {high}"
        for name, rows in cases.items():
            if not low <= len(rows) <= high:
                problems.append(
                    f"line {rows[0].line}: case '{name}' has {len(rows)} images; allowed for {task}: {number}"
                )
            for previous, row in itertools.pairwise(rows):
                first, second = previous.numbers.get("time_s"), row.numbers.get("time_s")
                if first is not None and second is not None and second <= first:
                    problems.append(
                        f"line {row.line}: time goes from {first:g} to {second:g} s; allowed: increasing times"
                    )
            problems += [
                f"line {row.line}: {column} is empty"
                for row in rows
                for column in required
                if column not in row.texts and column not in row.numbers
            ]
        if not cases:
            problems = ["it has no rows; allowed: at least one case"]
    if problems:
        raise IngestError(format_problems(path, problems))
    return cases


def _parse_row(line: int, cells: Mapping[str, str]) -> ImageRow:
    """Convert the cells of a row. Raises ValueError for an invalid or a missing value."""
    cell_texts = {name: cell for name, cell in cells.items() if cell}
    numbers = {name: finite_number(name, cell) for name, cell in cell_texts.items() if name not in _TEXT_COLUMNS}
    row = ImageRow(line, {name: cell_texts[name] for name in _TEXT_COLUMNS if name in cell_texts}, numbers)
    for name in _POSITIVE_COLUMNS:
        if numbers.get(name, 1.0) <= 0.0:
            raise ValueError(f"{name} is {cell_texts[name]}; allowed: above 0")
    for name in ("case", "file"):
        if name not in cell_texts:
            raise ValueError(f"{name} is empty")
    check_column_groups(_COLUMN_GROUPS, numbers)
    for prefix in ("", "true_"):
        quaternion = row.vector(*(f"{prefix}q{axis}" for axis in "xyzw"))
        length = 1.0 if quaternion is None else float(np.linalg.norm(quaternion))
        if abs(length - 1.0) > _QUATERNION_TOLERANCE:
            raise ValueError(
                f"the quaternion {prefix}qx to {prefix}qw has the length {length:.4g}; "
                f"allowed: 1 to {_QUATERNION_TOLERANCE:g}"
            )
    return row
