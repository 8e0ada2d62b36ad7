"""Files of recorded poses: CSV and Parquet tables, TUM's text files, EuRoC's ground truth, and SPICE kernels.

CSV and Parquet have the columns time_s, x_m, y_m, z_m, qx, qy, qz, qw, in any order and among others. TUM's lines are
``timestamp tx ty tz qx qy qz qw``, seconds and metres, those with # left out; EuRoC's files begin with ``#timestamp``,
in nanoseconds, then position, then the quaternion with its scalar part first. Kernels are named in a file that ends in
``.spice.toml`` (`marsyard.sim.dynamics.spice`). Quaternions turn the recorded body's axes
into those of the world; what axes these are no format says, and whoever uses the poses states it.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from marsyard.sim.dynamics.recorded import LEAST_INSTANTS
from marsyard.sim.dynamics.spice import SUFFIX, is_spice, spice_poses
from marsyard.sim.files import check_regular

COLUMNS = ("time_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
#: A quaternion's length may be off 1 by this, as written with three digits.
UNIT_TOLERANCE = 5e-3
#: Ten hours at 100 Hz are 400 MB of text; nothing is read that is larger.
MOST_BYTES = 1 << 29
#: And no table of more rows, whatever it is compressed to.
MAX_ROWS = 5_000_000
_KEPT_FILES = 4
#: Cells of a table of text that hold no number.
_MISSING = ("na", "NA", "n/a", "N/A", "null", "NULL", "none", "None")
_ALLOWED = (
    f"a CSV or Parquet table with the columns {', '.join(COLUMNS)}; TUM's lines of timestamp tx ty tz qx qy qz qw; "
    f"EuRoC's ground truth, whose header begins with #timestamp; or SPICE kernels, named in a file *{SUFFIX}"
)


class TrajectoryFileError(ValueError):
    """A file of poses that cannot be used; the message names it, the fault, and what is allowed."""


@dataclass(frozen=True, eq=False)
class RecordedPoses:
    """Poses as a file has them.

    Attributes
    ----------
    path, sha256
        The file, and the hash of its contents.
    times_s
        The file's times, seconds, increasing.
    positions_m
        In the file's world axes.
    quaternions
        From the file's body axes to its world axes: x, y, z, w; of length 1.
    """

    path: str
    sha256: str
    times_s: Float64[np.ndarray, "n"]
    positions_m: Float64[np.ndarray, "n 3"]
    quaternions: Float64[np.ndarray, "n 4"]


def read_poses(path: str | Path) -> RecordedPoses:
    """The poses of a file, checked; kept while the file does not change.

    Raises
    ------
    TrajectoryFileError
        If it cannot be read, is of none of the formats, holds too few poses or a value that is not finite, time does
        not increase, or a quaternion is not of length 1.
    """
    try:
        about = check_regular(path)
    except OSError as fault:
        raise TrajectoryFileError(f"{path}: cannot be read ({fault.strerror})") from fault
    return _read(str(path), about.st_mtime_ns, about.st_size)


@lru_cache(maxsize=_KEPT_FILES)
def _read(path: str, _changed_ns: int, size: int) -> RecordedPoses:
    if is_spice(path):
        return _from_kernels(path)
    if size > MOST_BYTES:
        raise TrajectoryFileError(f"{path}: is larger than {MOST_BYTES >> 20} MiB; {_ALLOWED} is needed")
    try:
        with Path(path).open("rb") as file:
            head = file.read(4096)
            if not head.startswith(b"PAR1") and b"\0" in head:
                raise TrajectoryFileError(f"{path}: is no table of poses; allowed: {_ALLOWED}")
            file.seek(0)
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as fault:
        raise TrajectoryFileError(f"{path}: cannot be read ({fault.strerror})") from fault
    try:
        values = _values(path, head)
    except (OSError, ValueError, UnicodeError) as fault:
        if isinstance(fault, TrajectoryFileError):
            raise
        said = " ".join(str(fault).split())[:200]
        raise TrajectoryFileError(f"{path}: cannot be read as a table ({said}); allowed: {_ALLOWED}") from fault
    return _checked(path, digest, values)


def _from_kernels(path: str) -> RecordedPoses:
    try:
        return _checked(path, *spice_poses(path))
    except ImportError as fault:
        raise TrajectoryFileError(
            f"{path}: SPICE kernels need the package spiceypy: pip install marsyard[spice]"
        ) from fault
    except (OSError, ValueError) as fault:
        if isinstance(fault, TrajectoryFileError):
            raise
        raise TrajectoryFileError(f"{path}: {fault}") from fault


def _values(path: str, head: bytes) -> Float64[np.ndarray, "n 8"]:
    """Time, position, quaternion (x, y, z, w) of each row."""
    text = head.decode("utf-8", errors="replace")
    first = text.lstrip("\ufeff").split("\n", 1)[0].strip()
    if head.startswith(b"PAR1") or (first.startswith("#timestamp") and "," in first):
        return _by_pandas(path, first)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # empty files are reported below; cells beyond the names are left out
        if "," in first and not first.startswith("#"):
            return _comma_separated(path)
        values = np.loadtxt(path, comments="#", ndmin=2)
    if values.size and values.shape[1] != 8:
        raise TrajectoryFileError(f"{path}: has {values.shape[1]} numbers in a line; allowed: {_ALLOWED}")
    return values.reshape(-1, 8)


def _by_pandas(path: str, first: str) -> Float64[np.ndarray, "n 8"]:
    """A Parquet table, or EuRoC's, whose nanoseconds are too many for a float."""
    import pandas as pd  # slow to import: for campaigns that have such a file

    if not first.startswith("#timestamp"):
        return _from_parquet(path)
    frame = pd.read_csv(path, skiprows=1, header=None, usecols=range(8), dtype={0: np.int64})
    values = frame.to_numpy(dtype=np.float64)
    values[:, 0] = 1e-9 * (frame[0] - int(frame[0].iloc[0])).to_numpy(dtype=np.float64)
    values[:, 0] += 1e-9 * int(frame[0].iloc[0])
    return np.asarray(values[:, [0, 1, 2, 3, 5, 6, 7, 4]])


def _from_parquet(path: str) -> Float64[np.ndarray, "n 8"]:
    """The columns of poses alone, checked by the file's own description before anything is expanded."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = pq.ParquetFile(path)
    rows = file.metadata.num_rows
    if rows > MAX_ROWS:
        raise TrajectoryFileError(f"{path}: has {rows} rows; allowed: up to {MAX_ROWS}")
    fields = list(file.schema_arrow)
    stored = [fields[place] for place in _place_columns(path, [field.name.strip() for field in fields])]
    for field in stored:
        if not (pa.types.is_floating(field.type) or pa.types.is_integer(field.type)):
            raise TrajectoryFileError(f"{path}: the column {field.name} holds {field.type}; allowed: numbers")
    values = np.empty((rows, len(COLUMNS)))
    read = 0
    for batch in file.iter_batches(columns=[field.name for field in stored]):
        if read + batch.num_rows > rows:
            raise TrajectoryFileError(f"{path}: has more rows than the {rows} that it states")
        for column, field in enumerate(stored):
            numbers = batch.column(field.name).cast(pa.float64(), safe=False)
            values[read : read + batch.num_rows, column] = numbers.to_numpy(zero_copy_only=False)
        read += batch.num_rows
    return values[:read]


def _comma_separated(path: str) -> Float64[np.ndarray, "n 8"]:
    """A table of text below a line of names; cells without a number become NaN."""
    import pandas as pd  # slow to import: for campaigns that have such a file

    frame = pd.read_csv(
        path,
        usecols=lambda name: name.strip() in COLUMNS,
        dtype=np.float64,
        index_col=False,
        skipinitialspace=True,
        na_values=list(_MISSING),
        float_precision="round_trip",
    )
    return np.asarray(frame.to_numpy()[:, _place_columns(path, [name.strip() for name in frame.columns])])


def _place_columns(path: str, names: Sequence[str]) -> list[int]:
    """Where the columns of poses stand among those of a table."""
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise TrajectoryFileError(f"{path}: has no column {', '.join(missing)}; allowed: {_ALLOWED}")
    return [names.index(name) for name in COLUMNS]


def _checked(path: str, digest: str, values: Float64[np.ndarray, "n 8"]) -> RecordedPoses:
    if len(values) < LEAST_INSTANTS:
        raise TrajectoryFileError(f"{path}: has {len(values)} poses; allowed: at least {LEAST_INSTANTS}")
    faulty = np.flatnonzero(~np.all(np.isfinite(values), axis=1))
    if faulty.size:
        names = [COLUMNS[column] for column in np.flatnonzero(~np.isfinite(values[faulty[0]]))]
        raise TrajectoryFileError(f"{path}: pose {faulty[0] + 1}: {', '.join(names)} is not finite; allowed: numbers")
    back = np.flatnonzero(np.diff(values[:, 0]) <= 0.0)
    if back.size:
        before, after = values[back[0] : back[0] + 2, 0]
        raise TrajectoryFileError(
            f"{path}: pose {back[0] + 2}: time goes from {before:.6f} to {after:.6f} s; allowed: times that increase"
        )
    lengths = np.linalg.norm(values[:, 4:], axis=1)
    long = np.flatnonzero(np.abs(lengths - 1.0) > UNIT_TOLERANCE)
    if long.size:
        raise TrajectoryFileError(
            f"{path}: pose {long[0] + 1}: the quaternion's length is {lengths[long[0]]:.4g}; "
            f"allowed: 1 to {UNIT_TOLERANCE:g}"
        )
    # columns of their own: a table's may be read-only, which rotations refuse
    times, positions = np.array(values[:, 0]), np.array(values[:, 1:4])
    return RecordedPoses(path, digest, times, positions, values[:, 4:] / lengths[:, None])
