"""Write and read ingested cases: `cases.json` with its images, cameras and flat fields, and select a case of it.

World axes are east, north, up; attitudes are those of the body.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field, ValidationError, model_validator
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.exchange.files import read_counts
from marsyard.scenarios.measured.layout import TaskName
from marsyard.scenarios.user_files import UserFile
from marsyard.sim.camera import BODY_FRAME, CameraModel, read_cahvor, write_cahvor
from marsyard.sim.files import check_regular
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DetectorCalibration, DetectorImage
from marsyard.sim.parameters import Parameters

#: Version of `cases.json`, and its name.
SCHEMA = 1
CASES_FILE = "cases.json"
#: Name of the parameter that selects a case of the file.
RECORDED_CASE = "number"

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class StoredFile(Parameters):
    """A file next to `cases.json`, and the hash of its contents."""

    file: str
    sha256: str


class StoredImage(Parameters):
    """An image, its size (columns, rows), and the measurements taken with it.

    - source: path of the image in the ingested folder
    - counts, camera, flat_field: files next to `cases.json`; without a flat field the response is 1
    - world_from_body_xyzw: None for an image that could not be registered on the map
    - altitude_time_s: time tag of the altitude; None for the image's time
    - registration_inliers: number of features that agree with the pose, if it was found on the map
    - bits_per_pixel: size of the source file, for lossy formats
    """

    source: str
    size: tuple[int, int]
    counts: StoredFile
    camera: StoredFile
    flat_field: StoredFile | None = None
    time_s: float
    exposure_s: float
    world_from_body_xyzw: Quaternion | None = None
    position_m: Vector | None = None
    altitude_m: float | None = None
    altitude_time_s: float | None = None
    registration_inliers: int | None = None
    bits_per_pixel: float | None = None

    @property
    def attitude(self) -> Rotation:
        """The body's measured attitude in world axes. Raises ValueError for an image that is not registered."""
        if self.world_from_body_xyzw is None:
            raise ValueError(f"{self.source}: has no attitude")
        return Rotation.from_quat(np.array(self.world_from_body_xyzw))

    @property
    def pose(self) -> RigidTransform:
        """The body's measured pose in world axes; its position is the origin if no position was measured."""
        return rigid(self.attitude, np.array(self.position_m or (0.0, 0.0, 0.0)))


class StoredTruth(Parameters):
    """True mean velocity of the camera from the second to the third image (east, north), and true poses of the body."""

    velocity_m_s: tuple[float, float] | None = None
    poses: tuple[tuple[Vector, Quaternion], ...] | None = None


class StoredCase(Parameters):
    """A case: its images and their measurements, and its truth.

    - interval_velocities_m_s, sun_direction: mean velocities between successive images, and the unit vector to the sun,
      for velocity
    - slant_range_m, site_m: range along the first camera's axis, and the a-priori site, for landing
    """

    name: str
    images: tuple[StoredImage, ...]
    interval_velocities_m_s: tuple[Vector, ...] | None = None
    sun_direction: Vector | None = None
    slant_range_m: float | None = None
    site_m: Vector | None = None
    truth: StoredTruth = StoredTruth()


class StoredDetector(Parameters):
    """Parameters of the detector of all images."""

    offset_dn: float
    full_scale_dn: int
    transfer_row_s: float
    clear_row_s: float
    rows_summed: int


class StoredMap(Parameters):
    """A map, row 0 in the south: `.npy` files of appearance and elevation next to `cases.json`, and the pixel size."""

    appearance: StoredFile
    elevation: StoredFile
    is_level: bool
    pixel_m: float


class StoredCases(Parameters):
    """Contents of `cases.json`."""

    schema_version: int
    name: str
    description: str = ""
    task: TaskName
    folder: str
    detector: StoredDetector
    cases: tuple[StoredCase, ...]
    map: StoredMap | None = None


class CasesFile(UserFile):
    """The `cases.json` of `marsyard ingest`: all measurements, and the hash of every image."""

    @classmethod
    def file_hash(cls, file: str) -> str:
        """Check `cases.json` and return its SHA-256."""
        _, sha256 = _load(file)
        return sha256

    @property
    def stored(self) -> StoredCases:
        """The contents of the file."""
        stored, _ = _load(self.file)
        return stored


class MeasuredParameters(Parameters):
    """Parameters of all tasks; subclasses define `task_name`, the required task of `cases.json`."""

    task_name: ClassVar[TaskName]

    cases: Annotated[CasesFile, Field(description="`cases.json` of `marsyard ingest`")]
    number: Annotated[int, Field(ge=0, description="index of the case in the file; usually a grid over all cases")] = 0

    @model_validator(mode="after")
    def _check_case_and_task(self) -> MeasuredParameters:
        stored = self.cases.stored
        if self.number >= len(stored.cases):
            raise ValueError(f"number is {self.number}; {self.cases.file} contains 0 to {len(stored.cases) - 1}")
        if stored.task != self.task_name:
            raise ValueError(
                f"{self.cases.file}: its task is {stored.task}; the scenario measured-{stored.task} runs it"
            )
        return self

    @property
    def case(self) -> StoredCase:
        """The case with this number."""
        return self.cases.stored.cases[self.number]


def _load(file: str) -> tuple[StoredCases, str]:
    """Return contents and SHA-256 of `cases.json`, cached until the file changes. Raises ValueError."""
    try:
        status = check_regular(file)
    except OSError as error:
        raise ValueError(f"{file}: {error.strerror or error}; marsyard ingest writes it") from error
    return _read(file, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4)
def _read(file: str, _modified_ns: int, _size: int) -> tuple[StoredCases, str]:
    """Read and check `cases.json`; modification time and size are cache keys, so that a changed file is read again."""
    try:
        contents = Path(file).read_bytes()
        stored = StoredCases.model_validate_json(contents)
    except OSError as error:
        raise ValueError(f"{file}: {error.strerror or error}") from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        location = ".".join(str(part) for part in first["loc"])
        raise ValueError(f"{file}: is not a valid cases.json of marsyard ingest: {location}: {first['msg']}") from error
    if stored.schema_version != SCHEMA:
        raise ValueError(f"{file}: has schema {stored.schema_version}; this version of Marsyard reads {SCHEMA}")
    return stored, hashlib.sha256(contents).hexdigest()


def write_cases(folder: Path, stored: StoredCases) -> Path:
    """Write `cases.json` and return its path. Raises OSError."""
    path = folder / CASES_FILE
    text = json.dumps(stored.model_dump(mode="json", exclude_defaults=True), indent=1, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")
    return path


def write_file(folder: Path, kind: str, name: str, write: Callable[[Path], object]) -> StoredFile:
    """Write a file next to `cases.json`, in the folder of its kind (`images`, `cameras`, `flat_fields`)."""
    path = folder / kind / name
    path.parent.mkdir(exist_ok=True)
    write(path)
    return StoredFile(file=path.relative_to(folder).as_posix(), sha256=hashlib.sha256(path.read_bytes()).hexdigest())


def write_camera(folder: Path, number: int, camera: CameraModel) -> StoredFile:
    """Write a camera next to `cases.json`; its file contains the body frame."""
    return write_file(
        folder, "cameras", f"{number:06d}.cahvor", lambda path: write_cahvor(camera, path, frame=BODY_FRAME)
    )


def check_unchanged(folder: Path, stored: StoredFile) -> Path:
    """Return the file's path. Raises ValueError if the file is missing or has changed."""
    path = folder / stored.file
    try:
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}; ingest again") from error
    if sha256 != stored.sha256:
        raise ValueError(f"{path}: has changed since it was ingested")
    return path


def load_images(cases: CasesFile, case: StoredCase) -> tuple[DetectorImage, ...]:
    """Load the images of a case with their cameras in the body frame. Raises ValueError if a file has changed."""
    folder, images = Path(cases.file).parent, []
    for image in case.images:
        counts = read_counts(check_unchanged(folder, image.counts))
        flat = image.flat_field
        calibration = DetectorCalibration(
            flat_field=np.ones(counts.shape)
            if flat is None
            else np.load(check_unchanged(folder, flat), allow_pickle=False),
            exposure_s=image.exposure_s,
            **cases.stored.detector.model_dump(),
        )
        camera = read_cahvor(check_unchanged(folder, image.camera))
        images.append(DetectorImage(counts, image.time_s, camera, calibration))
    return tuple(images)
