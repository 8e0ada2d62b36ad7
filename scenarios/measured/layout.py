"""Read `ingest.toml`, the parameters of a folder of `marsyard ingest` (docs/real-images.md)."""

import tomllib
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field, ValidationError, field_validator

from marsyard.scenarios.recorded_axes import RecordedAxes
from marsyard.sim.files import check_regular
from marsyard.sim.frames import direction, world_from_mars_fixed
from marsyard.sim.parameters import Parameters, bounded_field

#: Names of the file of parameters and of the table of images in every folder.
INGEST_FILE, TABLE_FILE = "ingest.toml", "images.csv"

VELOCITY, LANDING, MATCHING, MAP = "velocity", "landing", "matching", "map"
TaskName = Literal["velocity", "landing", "matching", "map"]


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
