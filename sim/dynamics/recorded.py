"""Recorded motion: reader of pose files, and a trajectory that interpolates the poses by splines.

File formats are CSV and Parquet tables, TUM's text files, EuRoC's ground truth, and SPICE kernels:

- CSV and Parquet: columns time_s, x_m, y_m, z_m, qx, qy, qz, qw, in any order; other columns are ignored.
- TUM: lines ``timestamp tx ty tz qx qy qz qw``, seconds and metres; lines with # are comments.
- EuRoC: a header that begins with ``#timestamp``; nanoseconds, position, quaternion with the scalar part first.
- SPICE: a file ``*.spice.toml`` with the kernels, the body, the observer and the frames. Positions are geometric,
  without light time; times are TDB seconds since `begin`, without leap seconds. ::

    kernels = ["naif0012.tls", "mission.bsp", "mission.bc", "mission.tsc", "site.tf"]   # relative to this file
    target = "-999"            # the body: a name or number in the kernels
    observer = "-999900"       # origin of the positions: a landing site, or another body
    world = "SITE_ENU"         # frame of positions and attitudes
    axes = "LANDER_CAMERA"     # frame whose attitude is recorded
    begin = "2030-01-01T00:00:00"
    end = "2030-01-01T00:01:30"
    step_s = 0.1               # time between poses

Quaternions rotate from the body's axes to the world's. Except for SPICE the files do not define these axes.
"""

from __future__ import annotations

import hashlib
import tomllib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field, ValidationError
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from marsyard.sim.dynamics.trajectory import Motion, Trajectory, check_times
from marsyard.sim.files import check_regular, report_damage
from marsyard.sim.parameters import Parameters

#: Minimum number of poses of a cubic spline.
MIN_POSES = 4
#: Maximum rotation from one pose to the next; for larger rotations the interpolation is ambiguous.
MAX_ROTATION_DEG = 90.0
#: Tolerance on times outside the span, for rounding errors in sums of times.
ROUNDING_S = 1e-9
#: Columns of a table: time, position, and quaternion with the scalar part last.
COLUMNS = ("time_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
#: Tolerance on a quaternion's length; components rounded to three decimals change it by at most 0.001.
UNIT_TOLERANCE = 5e-3
#: Maximum size of a file: ten hours at 100 Hz are 400 MB of text.
MAX_BYTES = 1 << 29
#: Maximum number of rows of a Parquet file, whose size depends on the compression.
MAX_ROWS = 5_000_000
#: Maximum number of poses sampled from SPICE kernels: five hours at 50 Hz.
MAX_SPICE_POSES = 1_000_000
#: End of the name of a file that lists SPICE kernels.
SPICE_SUFFIX = ".spice.toml"
_MAX_CACHED_FILES = 4
#: Texts for a missing number in a text table.
_MISSING = ("na", "NA", "n/a", "N/A", "null", "NULL", "none", "None")
_ALLOWED = (
    f"a CSV or Parquet table with the columns {', '.join(COLUMNS)}; TUM's lines of timestamp tx ty tz qx qy qz qw; "
    f"EuRoC's ground truth, whose header begins with #timestamp; or SPICE kernels, named in a file *{SPICE_SUFFIX}"
)


@dataclass(frozen=True, eq=False)
class RecordedMotion(Trajectory):
    """A `Trajectory` through recorded poses of a body, world axes.

    Positions are interpolated by a cubic spline (not-a-knot), attitudes by a spline of continuous angular acceleration.
    Velocity, body rate and specific force are derivatives of these splines.

    - times_s, positions_m, attitudes: the recorded poses; attitudes rotate from body to world
    - gravity_m_s2: gravity, along the world's -z

    Raises ValueError for fewer than `MIN_POSES` poses, times that do not increase, a value that is not finite, or a
    rotation of more than `MAX_ROTATION_DEG` from one pose to the next.
    """

    times_s: Float64[np.ndarray, "n"]
    positions_m: Float64[np.ndarray, "n 3"]
    attitudes: Rotation
    gravity_m_s2: float

    def __post_init__(self) -> None:
        if self.times_s.size < MIN_POSES:
            raise ValueError(f"has {self.times_s.size} poses; allowed: at least {MIN_POSES}")
        if not (np.all(np.isfinite(self.times_s)) and np.all(np.isfinite(self.positions_m))):
            raise ValueError("contains a value that is not finite")
        not_increasing = np.flatnonzero(np.diff(self.times_s) <= 0.0)
        if not_increasing.size:
            raise ValueError(
                f"time does not increase after {self.times_s[not_increasing[0]]:.6f} s (pose {not_increasing[0] + 1})"
            )
        angles = np.degrees((self.attitudes[:-1].inv() * self.attitudes[1:]).magnitude())
        too_large = np.flatnonzero(angles > MAX_ROTATION_DEG)
        if too_large.size:
            index = too_large[0]
            raise ValueError(
                f"rotates by {angles[index]:.0f} deg after {self.times_s[index]:.6f} s (pose {index + 1}); "
                f"allowed: up to {MAX_ROTATION_DEG:g} deg from one pose to the next"
            )

    @cached_property
    def _position_spline(self) -> CubicSpline:
        return CubicSpline(self.times_s, self.positions_m)

    @cached_property
    def _attitude_spline(self) -> RotationSpline:
        return RotationSpline(self.times_s, self.attitudes)

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last recorded time."""
        return float(self.times_s[0]), float(self.times_s[-1])

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """Compute the true states at many times. Raises ValueError for times outside the span."""
        check_times(times_s, self.span_s, ROUNDING_S)
        derivatives = [self._position_spline(times_s, order) for order in range(3)]
        attitudes, rates = self._attitude_spline(times_s), self._attitude_spline(times_s, 1)
        return Motion.from_accelerations(times_s, derivatives, attitudes, rates, self.gravity_m_s2)


class TrajectoryFileError(ValueError):
    """A pose file that cannot be used; the message contains the file, the fault, and the allowed formats or values."""


@dataclass(frozen=True, eq=False)
class RecordedPoses:
    """Poses of a file in the file's world and body axes; unit quaternions (x, y, z, w) from body to world."""

    path: str
    sha256: str
    times_s: Float64[np.ndarray, "n"]
    positions_m: Float64[np.ndarray, "n 3"]
    quaternions: Float64[np.ndarray, "n 4"]


def read_poses(path: str | Path) -> RecordedPoses:
    """Read and check a pose file; the result is cached until the file changes.

    Raises TrajectoryFileError for a file that cannot be read, an unknown format, too few poses, a value that is not
    finite, times that do not increase, or a quaternion that is not of length 1.
    """
    try:
        status = check_regular(path)
    except OSError as fault:
        raise TrajectoryFileError(f"{path}: cannot be read ({fault.strerror})") from fault
    return _read_file(str(path), status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=_MAX_CACHED_FILES)
def _read_file(path: str, _modified_ns: int, size: int) -> RecordedPoses:
    """Read and check a file; the modification time is a key of the cache."""
    if path.endswith(SPICE_SUFFIX):
        try:
            return _check_poses(path, *_sample_kernels(path))
        except ImportError as fault:
            install = "SPICE kernels need the package spiceypy: pip install marsyard[spice]"
            raise TrajectoryFileError(f"{path}: {install}") from fault
        except TrajectoryFileError:
            raise
        except (OSError, ValueError) as fault:
            raise TrajectoryFileError(f"{path}: {fault}") from fault
    if size > MAX_BYTES:
        raise TrajectoryFileError(f"{path}: is larger than {MAX_BYTES >> 20} MiB; {_ALLOWED} is needed")
    try:
        with Path(path).open("rb") as file:
            head = file.read(4096)
            if not head.startswith(b"PAR1") and b"\0" in head:
                raise TrajectoryFileError(f"{path}: is not a table of poses; allowed: {_ALLOWED}")
            file.seek(0)
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as fault:
        raise TrajectoryFileError(f"{path}: cannot be read ({fault.strerror})") from fault
    with report_damage(path, TrajectoryFileError, "cannot be read as a table", f"; allowed: {_ALLOWED}"):
        values = _read_table(path, head)
    return _check_poses(path, digest, values)


def _read_table(path: str, head: bytes) -> Float64[np.ndarray, "n 8"]:
    """Read time, position and quaternion (x, y, z, w) of each row; the first bytes determine the format."""
    first_line = head.decode("utf-8", errors="replace").lstrip("\ufeff").split("\n", 1)[0].strip()
    if head.startswith(b"PAR1"):
        return _read_parquet(path)
    import pandas as pd  # imported here: slow, and few campaigns use such a file

    if first_line.startswith("#timestamp") and "," in first_line:
        frame = pd.read_csv(path, skiprows=1, header=None, usecols=range(8), dtype={0: np.int64})
        values = frame.to_numpy(dtype=np.float64)
        values[:, 0] *= 1e-9
        return np.asarray(values[:, [0, 1, 2, 3, 5, 6, 7, 4]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # empty files are reported below; cells without a column name are ignored
        if "," in first_line and not first_line.startswith("#"):
            frame = pd.read_csv(
                path,
                usecols=lambda name: name.strip() in COLUMNS,
                dtype=np.float64,
                index_col=False,
                skipinitialspace=True,
                na_values=list(_MISSING),
                float_precision="round_trip",
            )
            names = [name.strip() for name in frame.columns]
            return np.asarray(frame.to_numpy()[:, _column_indices(path, names)])
        values = np.loadtxt(path, comments="#", ndmin=2)
    if values.size and values.shape[1] != 8:
        raise TrajectoryFileError(f"{path}: has {values.shape[1]} numbers in a line; allowed: {_ALLOWED}")
    return values.reshape(-1, 8)


def _read_parquet(path: str) -> Float64[np.ndarray, "n 8"]:
    """Read the pose columns; row count and types are checked in the metadata before any data is decompressed."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = pq.ParquetFile(path)
    rows = file.metadata.num_rows
    if rows > MAX_ROWS:
        raise TrajectoryFileError(f"{path}: has {rows} rows; allowed: up to {MAX_ROWS}")
    fields = list(file.schema_arrow)
    fields = [fields[index] for index in _column_indices(path, [field.name.strip() for field in fields])]
    for field in fields:
        if not (pa.types.is_floating(field.type) or pa.types.is_integer(field.type)):
            raise TrajectoryFileError(f"{path}: the column {field.name} contains {field.type}; allowed: numbers")
    values = np.empty((rows, len(COLUMNS)))
    start = 0
    for batch in file.iter_batches(columns=[field.name for field in fields]):
        if start + batch.num_rows > rows:
            raise TrajectoryFileError(f"{path}: has more rows than the {rows} of its metadata")
        for column, field in enumerate(fields):
            numbers = batch.column(field.name).cast(pa.float64(), safe=False)
            values[start : start + batch.num_rows, column] = numbers.to_numpy(zero_copy_only=False)
        start += batch.num_rows
    return values[:start]


def _column_indices(path: str, names: Sequence[str]) -> list[int]:
    """Return the positions of `COLUMNS` among the names of a table. Raises TrajectoryFileError for a missing column."""
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise TrajectoryFileError(f"{path}: has no column {', '.join(missing)}; allowed: {_ALLOWED}")
    return [names.index(name) for name in COLUMNS]


def _check_poses(path: str, digest: str, values: Float64[np.ndarray, "n 8"]) -> RecordedPoses:
    """Check the rows of a table and convert them to poses. Raises TrajectoryFileError for the first invalid pose."""
    if len(values) < MIN_POSES:
        raise TrajectoryFileError(f"{path}: has {len(values)} poses; allowed: at least {MIN_POSES}")
    invalid = np.flatnonzero(~np.all(np.isfinite(values), axis=1))
    if invalid.size:
        names = [COLUMNS[column] for column in np.flatnonzero(~np.isfinite(values[invalid[0]]))]
        raise TrajectoryFileError(f"{path}: pose {invalid[0] + 1}: {', '.join(names)} is not finite; allowed: numbers")
    not_increasing = np.flatnonzero(np.diff(values[:, 0]) <= 0.0)
    if not_increasing.size:
        first = not_increasing[0]
        before, after = values[first : first + 2, 0]
        raise TrajectoryFileError(
            f"{path}: pose {first + 2}: time goes from {before:.6f} to {after:.6f} s; allowed: times that increase"
        )
    lengths = np.linalg.norm(values[:, 4:], axis=1)
    not_unit = np.flatnonzero(np.abs(lengths - 1.0) > UNIT_TOLERANCE)
    if not_unit.size:
        raise TrajectoryFileError(
            f"{path}: pose {not_unit[0] + 1}: the quaternion's length is {lengths[not_unit[0]]:.4g}; "
            f"allowed: 1 within {UNIT_TOLERANCE:g}"
        )
    # copies, because the table can be read-only, and SciPy's rotations do not accept read-only arrays
    times, positions = np.array(values[:, 0]), np.array(values[:, 1:4])
    return RecordedPoses(path, digest, times, positions, values[:, 4:] / lengths[:, None])


class SpiceFlight(Parameters):
    """Content of a file ``*.spice.toml``: SPICE kernels, body, frames and times of the poses to be sampled."""

    kernels: Annotated[tuple[str, ...], Field(min_length=1, description="paths, relative to the file")]
    target: Annotated[str, Field(description="the body: a name or number in the kernels")]
    observer: Annotated[str, Field(description="origin of the positions")]
    world: Annotated[str, Field(description="frame of positions and attitudes")]
    axes: Annotated[str, Field(description="frame whose attitude is recorded")]
    begin: Annotated[str, Field(description="UTC, in a format of SPICE")]
    end: Annotated[str, Field(description="UTC")]
    step_s: Annotated[float, Field(gt=0.0, le=60.0, description="time between poses, s")]


def _sample_kernels(path: str) -> tuple[str, Float64[np.ndarray, "n 8"]]:
    """Sample poses from SPICE kernels; return the SHA-256 of the file and its kernels, and the poses.

    Columns: time (s since `begin`), position (m), quaternion (x, y, z, w). Raises ValueError for an invalid file or
    kernel, ImportError without the package spiceypy.
    """
    try:
        flight = SpiceFlight.model_validate(tomllib.loads(Path(path).read_text(encoding="utf-8")))
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    kernels = [Path(path).parent / name for name in flight.kernels]
    digest = hashlib.sha256(Path(path).read_bytes())
    for kernel in kernels:
        if not kernel.is_file():
            raise ValueError(f"the kernel {kernel} does not exist")
        with kernel.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    import spiceypy
    from spiceypy.utils.exceptions import SpiceyError

    try:
        # SPICE has one kernel pool per process; kernels that other code has loaded remain in it
        with spiceypy.KernelPool([str(kernel) for kernel in kernels]):
            begin, end = (float(spiceypy.str2et(utc)) for utc in (flight.begin, flight.end))
            count = int(np.floor((end - begin) / flight.step_s + 1e-9)) + 1
            if not MIN_POSES <= count <= MAX_SPICE_POSES:
                allowed = f"{MIN_POSES} to {MAX_SPICE_POSES}"
                raise ValueError(f"begin, end and step_s result in {max(count, 0)} poses; allowed: {allowed}")
            times = flight.step_s * np.arange(count)
            positions = spiceypy.spkpos(flight.target, begin + times, flight.world, "NONE", flight.observer)[0]
            rotations = np.stack([spiceypy.pxform(flight.axes, flight.world, begin + time) for time in times])
    except SpiceyError as error:
        # put the message on one line, without SPICE's banner and traceback
        words = [getattr(error, "short", ""), *str(getattr(error, "long", "") or error).split()]
        raise ValueError(f"SPICE: {' '.join(words).strip()[:300]}") from error
    quaternions = Rotation.from_matrix(rotations).as_quat()
    return digest.hexdigest(), np.concatenate([times[:, None], 1e3 * np.asarray(positions), quaternions], axis=1)
