"""The folder that `marsyard ingest` reads: `ingest.toml`, `pictures.csv`, the pictures (docs/real-pictures.md)."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field, ValidationError

from marsyard.scenarios.own_axes import RecordedAxes
from marsyard.sim.files import check_regular
from marsyard.sim.frames import direction
from marsyard.sim.parameters import Parameters

#: The two files of every folder.
INGEST_FILE, TABLE_FILE = "ingest.toml", "pictures.csv"

VELOCITY, LANDING, MATCHING = "velocity", "landing", "matching"
TaskName = Literal["velocity", "landing", "matching"]

#: Pictures of a case, least and most.
PICTURES = {VELOCITY: (3, 3), LANDING: (2, 2), MATCHING: (2, 50)}


class IngestError(ValueError):
    """A folder that cannot be used; the message names the file, the line or key, and what is allowed."""


class CameraTable(Parameters):
    """The camera of all pictures that name none of their own."""

    file: Annotated[str | None, Field(description="camera file; none needed for PDS3 products, whose labels are")] = (
        None
    )
    number: Annotated[int, Field(ge=0, description="which of a file's cameras, from 0")] = 0
    placed: Annotated[
        bool,
        Field(
            description="true: the file's vectors place the camera in the body (`attitude_of` is then `body`); "
            "false: it is mounted to look down, wherever the file puts it"
        ),
    ] = False
    subframe_folded_in: Annotated[
        bool, Field(description="PDS labels: a subframe's model describes the stored picture")
    ] = False


class DetectorTable(Parameters):
    """What is known of the detector."""

    bits: Annotated[int, Field(ge=1, le=16, description="of a count; the largest count is 2^bits - 1")]
    offset_dn: Annotated[float, Field(ge=0.0, le=65535.0, description="counts delivered for no light")] = 0.0
    exposure_s: Annotated[float, Field(ge=0.0, le=100.0, description="exposure time; 0: not known")] = 0.0
    transfer_row_s: Annotated[
        float, Field(ge=0.0, le=1.0, description="frame transfer: time under each row while shifted out; 0: none")
    ] = 0.0
    clear_row_s: Annotated[
        float, Field(ge=0.0, le=1.0, description="frame transfer: time under each row while cleared; 0: none")
    ] = 0.0
    rows_summed: Annotated[
        int | None,
        Field(ge=1, le=64, description="physical rows in a delivered one; by default the camera's ratio of scales"),
    ] = None
    flat_field: Annotated[
        str | None,
        Field(
            description="relative response of each pixel: `.npy` of numbers about 1 at the brightest, or a picture, "
            "over its largest count"
        ),
    ] = None


class SunTable(Parameters):
    """Where the sun stands, for all cases whose rows do not say."""

    azimuth_deg: Annotated[float, Field(ge=-360.0, le=720.0, description="clockwise from north")]
    elevation_deg: Annotated[float, Field(gt=0.0, le=90.0, description="above the horizon")]

    @property
    def direction(self) -> Float64[np.ndarray, "3"]:
        """Unit vector to the sun, world axes."""
        return direction(float(np.radians(self.azimuth_deg)), float(np.radians(self.elevation_deg)))


class IngestFile(Parameters):
    """`ingest.toml`: what holds for the whole folder."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100, description="of the campaign")]
    task: Annotated[
        TaskName, Field(description="velocity: three pictures of a descent; landing: two; matching: two or more")
    ]
    description: Annotated[str, Field(description="in the report")] = ""
    poses: Annotated[RecordedAxes | None, Field(description="not needed where PDS3 labels state all poses")] = None
    camera: CameraTable = CameraTable()
    detector: DetectorTable
    sun: SunTable | None = None


def read_ingest_file(folder: Path) -> IngestFile:
    """The folder's `ingest.toml`.

    Raises
    ------
    IngestError
        Where it is missing, no TOML, or states what is not allowed; all that is wrong is told, by key.
    """
    path = folder / INGEST_FILE
    try:
        check_regular(path)
        stated = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise IngestError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise IngestError(f"{path}: not valid TOML: {error}") from error
    try:
        file = IngestFile.model_validate(stated)
    except ValidationError as error:
        raise IngestError(
            "\n".join(f"{path}: {_said(dict(one))}" for one in error.errors(include_url=False))
        ) from error
    if file.camera.placed and file.poses is not None and file.poses.attitude_of != "body":
        raise IngestError(
            f'{path}: camera.placed: the file places the camera in the body, so poses.attitude_of must be "body"'
        )
    return file


def _said(detail: Mapping[str, Any]) -> str:
    """A key of the file, and what is wrong there."""
    key = ".".join(str(part) for part in detail["loc"])
    kinds = {"missing": "required, but missing", "extra_forbidden": "unknown key; see docs/real-pictures.md"}
    message = str(detail["msg"]).removeprefix("Value error, ")
    return f"{key}: " + kinds.get(detail["type"], f"{message}, got {detail['input']!r}")


@dataclass(frozen=True)
class Column:
    """A column of `pictures.csv`.

    Attributes
    ----------
    name
        Its name, which ends with its unit.
    tasks
        Those that read it; others refuse it.
    needed
        Where it must be filled: in `every` row, in none (`""`), or as said.
    what
        What stands in it.
    """

    name: str
    tasks: tuple[str, ...]
    needed: str
    what: str


_ALL = (VELOCITY, LANDING, MATCHING)
_QUATERNION = "unit quaternion, scalar part last, from the axes of `poses.attitude_of` to those of `poses.axes`"
_LABELLED = "unless a PDS3 label states it"


def _columns(names: str, tasks: tuple[str, ...], needed: str, what: str) -> list[Column]:
    return [Column(name, tasks, needed, what) for name in names.split()]


#: All columns, in the order of the documentation.
COLUMNS: tuple[Column, ...] = (
    Column("case", _ALL, "every", "name of the case; its rows stand in the order of time"),
    Column("file", _ALL, "every", "the picture: PNG, PGM or TIFF of 8 or 16 bits and one band, or a PDS3 product"),
    Column("camera", _ALL, "", "camera file of this picture, in place of `camera.file`"),
    Column("flat_field", _ALL, "", "flat field of this picture, in place of `detector.flat_field`"),
    Column("time_s", _ALL, _LABELLED, "middle of the exposure"),
    Column("exposure_s", _ALL, "", "exposure time, in place of `detector.exposure_s`"),
    *_columns("qx qy qz qw", _ALL, _LABELLED, _QUATERNION),
    *_columns(
        "x_m y_m z_m",
        _ALL,
        "landing",
        "measured position, from any origin; matching without it takes pictures as from one place",
    ),
    Column("altitude_m", (VELOCITY,), "every", "measured altitude above the ground"),
    Column("altitude_time_s", (VELOCITY,), "", "its time tag, if it is not the picture's"),
    *_columns(
        "vx_m_s vy_m_s vz_m_s",
        (VELOCITY,),
        "unless there are positions",
        "mean velocity since the picture before, by the inertial unit; empty at a case's first picture",
    ),
    *_columns("sun_azimuth_deg sun_elevation_deg", (VELOCITY,), "", "at a case's first picture, in place of `[sun]`"),
    Column("slant_range_m", (LANDING,), "", "at a case's first picture: the altimeter's range along the optical axis"),
    *_columns(
        "site_x_m site_y_m site_z_m",
        (LANDING,),
        "without a slant range",
        "at a case's first picture: the a-priori site; by default the ground on the optical axis",
    ),
    *_columns(
        "true_vx_m_s true_vy_m_s",
        (VELOCITY,),
        "",
        "truth, at a case's third picture: mean velocity since the second; or by true positions",
    ),
    *_columns("true_x_m true_y_m true_z_m", (VELOCITY, LANDING), "", "truth: position"),
    *_columns("true_qx true_qy true_qz true_qw", (LANDING,), "", "truth: attitude, as the measured one"),
)

#: Names that hold text.
TEXTS = ("case", "file", "camera", "flat_field")
