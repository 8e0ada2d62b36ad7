"""Read a folder of `marsyard ingest`: its parameters `ingest.toml`, and its table of images `images.csv`.

docs/real-images.md describes both.
"""

import itertools
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64
from pydantic import Field, ValidationError, field_validator
from scipy.spatial.transform import Rotation

from marsyard.scenarios.recorded_axes import RecordedAxes
from marsyard.scenarios.user_tables import check_column_groups, finite_number, format_problems, parse_table
from marsyard.sim.files import check_regular
from marsyard.sim.frames import direction, world_from_mars_fixed
from marsyard.sim.parameters import Parameters, bounded_field

#: Names of the file of parameters and of the table of images in every folder.
INGEST_FILE, TABLE_FILE = "ingest.toml", "images.csv"

VELOCITY, LANDING, MATCHING, MAP = "velocity", "landing", "matching", "map"
TaskName = Literal["velocity", "landing", "matching", "map"]
#: Minimum and maximum number of images of a case.
IMAGE_COUNTS = {VELOCITY: (3, 3), LANDING: (2, 2), MATCHING: (2, 50), MAP: (1, 1)}
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


class IngestError(ValueError):
    """An invalid folder; the message contains the file, the line or key, and the allowed values."""


class CameraTable(Parameters):
    """Default camera of the images."""

    file: Annotated[
        str | None, Field(description="camera file; not needed for PDS3 products, whose labels contain the camera")
    ] = None
    number: Annotated[int, Field(ge=0, description="index of the camera in the file, from 0")] = 0
    pose_in_file: Annotated[
        bool,
        Field(
            description="true: the file's vectors define the camera's pose in the body (`attitude_of` is then `body`); "
            "false: the camera looks down, regardless of the pose in the file"
        ),
    ] = False
    subframe_folded_in: Annotated[
        bool, Field(description="PDS labels: a subframe's model describes the stored image")
    ] = False


class DetectorTable(Parameters):
    """Parameters of the detector."""

    bits: Annotated[int, Field(ge=1, le=16, description="bits of a count; the largest count is 2^bits - 1")]
    offset_dn: Annotated[float, Field(ge=0.0, le=65535.0, description="count of a dark pixel")] = 0.0
    exposure_s: Annotated[float, Field(ge=0.0, le=100.0, description="exposure time; 0: unknown")] = 0.0
    transfer_row_s: Annotated[
        float, Field(ge=0.0, le=1.0, description="frame transfer: time under each row while shifted out; 0: none")
    ] = 0.0
    clear_row_s: Annotated[
        float, bounded_field(0.0, 1.0, "frame transfer: time under each row while cleared; 0: none")
    ] = 0.0
    rows_summed: Annotated[
        int | None,
        Field(ge=1, le=64, description="detector rows in an image row; default: ratio of the camera's focal lengths"),
    ] = None
    flat_field: Annotated[
        str | None,
        Field(
            description="relative response of each pixel: `.npy` of numbers, about 1 at the maximum, or an image, "
            "divided by its largest count"
        ),
    ] = None


class SunTable(Parameters):
    """Default direction to the sun."""

    azimuth_deg: Annotated[float, Field(ge=-360.0, le=720.0, description="azimuth of the sun, clockwise from north")]
    elevation_deg: Annotated[float, Field(gt=0.0, le=90.0, description="elevation of the sun above the horizon")]

    @property
    def direction(self) -> Float64[np.ndarray, "3"]:
        """Unit vector to the sun, world axes."""
        return direction(float(np.radians(self.azimuth_deg)), float(np.radians(self.elevation_deg)))


class MapTable(Parameters):
    """Map of the ground, for the task `map`. Its world has the origin in the centre of the map, at elevation 0."""

    file: Annotated[str, Field(description="image of the ground from above, north up; colours are averaged")]
    pixel_m: Annotated[float, Field(gt=0.0, le=1000.0, description="size of a map pixel, m")]
    elevation: Annotated[
        str | None,
        Field(description="`.npy` with elevations, m, of any grid over the same area, north up; default: level ground"),
    ] = None
    origin_mars_fixed_m: Annotated[
        tuple[float, float, float] | None,
        Field(description="position of the map's origin in the Mars-fixed frame; with it, poses of labels are used"),
    ] = None
    sun: Annotated[SunTable | None, Field(description="sun in the images of the map")] = None

    @field_validator("origin_mars_fixed_m")
    @classmethod
    def _check_origin(cls, origin_m: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
        if origin_m is not None:
            world_from_mars_fixed(np.array(origin_m))
        return origin_m


class IngestFile(Parameters):
    """`ingest.toml`: parameters of the whole folder."""

    name: Annotated[
        str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100, description="name of the campaign")
    ]
    task: Annotated[
        TaskName,
        Field(
            description="velocity: three images of a descent; landing: two; matching: two or more; map: one, over a map"
        ),
    ]
    description: Annotated[str, Field(description="description in the report")] = ""
    poses: Annotated[RecordedAxes | None, Field(description="not needed if PDS3 labels contain all poses")] = None
    camera: CameraTable = CameraTable()
    detector: DetectorTable
    sun: SunTable | None = None
    map: MapTable | None = None


def read_ingest_file(folder: Path) -> IngestFile:
    """Read the folder's `ingest.toml`. Raises IngestError with all problems by key."""
    path = folder / INGEST_FILE
    try:
        check_regular(path)
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise IngestError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise IngestError(f"{path}: not valid TOML: {error}") from error
    try:
        file = IngestFile.model_validate(values)
    except ValidationError as error:
        messages = {"missing": "required, but missing", "extra_forbidden": "unknown key; see docs/real-images.md"}
        problems = []
        for detail in error.errors(include_url=False):
            message = f"{detail['msg'].removeprefix('Value error, ')}, got {detail['input']!r}"
            problems.append(f"{path}: {'.'.join(map(str, detail['loc']))}: {messages.get(detail['type'], message)}")
        raise IngestError("\n".join(problems)) from error
    if file.camera.pose_in_file and file.poses is not None and file.poses.attitude_of != "body":
        raise IngestError(
            f'{path}: camera.pose_in_file: the file contains the pose in the body: poses.attitude_of must be "body"'
        )
    if (file.map is None) == (file.task == MAP):
        raise IngestError(f"{path}: map: the task map, and no other, needs the table [map]; the task is {file.task}")
    return file


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
            lines: dict[str, int] = {}
            for row in rows:
                first_line = lines.setdefault(row.texts["file"], row.line)
                if first_line != row.line and task != MATCHING:
                    problems.append(
                        f"line {row.line}: {row.texts['file']} is also the image of line {first_line}; allowed: "
                        "different images in a case"
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
                f"allowed: 1, within {_QUATERNION_TOLERANCE:g}"
            )
    return row
