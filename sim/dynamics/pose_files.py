"""Reader of pose files: times, positions and attitudes of a recorded motion.

Formats are CSV and Parquet tables, TUM's text files, EuRoC's ground truth, and SPICE kernels:

- CSV and Parquet: columns time_s, x_m, y_m, z_m, qx, qy, qz, qw, in any order; other columns are ignored. A column
  time_ns (integer nanoseconds) replaces time_s.
- TUM: lines ``timestamp tx ty tz qx qy qz qw``, seconds or integer nanoseconds, and metres; lines with # are comments.
- EuRoC: a header that begins with ``#timestamp``; nanoseconds, position, quaternion with the scalar part first.
- SPICE: a file ``*.spice.toml``, see `marsyard.sim.dynamics.spice`.

Times can be large, for example since 1970: 64-bit floating-point numbers resolve only 0.2 us there, and the second
derivatives of positions amplify rounding errors. Times are therefore read as decimal numbers or integers, and the first
one is subtracted before the conversion to floating point.

Quaternions rotate from the body's axes to the world's. Except for SPICE the files do not define these axes.
"""

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation, localcontext
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from marsyard.sim.dynamics.recorded import MIN_POSES
from marsyard.sim.files import check_regular, report_damage

#: Columns of a table: time, position, and quaternion with the scalar part last.
COLUMNS = ("time_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
#: Positions and quaternions in a row of these columns.
_POSITION, _QUATERNION = slice(1, 4), slice(4, 8)
#: Columns of position and quaternion in EuRoC's ground truth, whose quaternions have the scalar part first.
_EUROC_POSE = [1, 2, 3, 5, 6, 7, 4]
#: Column of integer times that replaces time_s, and powers of ten of its unit and of a second.
NANOSECONDS = "time_ns"
_EXPONENTS = {"time_s": 0, NANOSECONDS: -9}
#: Smallest time in a file of TUM's format that is in nanoseconds: 1.2 days, or three million years in seconds.
_MIN_NANOSECONDS = Decimal(10**14)
#: Digits that are enough for the decimal expansion of a 64-bit number to the last digit of any printed text.
_PRINTED_DIGITS = 60
#: Maximum error of the acceleration by rounded times: 1 mg, similar to the bias of an accelerometer.
MAX_ROUNDING_M_S2 = 0.01
#: Tolerance on a quaternion's length; components rounded to three decimals change it by at most 0.001.
UNIT_TOLERANCE = 5e-3
#: Maximum size of a file: ten hours at 100 Hz are 400 MB of text.
MAX_BYTES = 1 << 29
#: Maximum number of rows of a Parquet file, whose size depends on the compression.
MAX_ROWS = 5_000_000
#: End of the name of a file that lists SPICE kernels.
SPICE_SUFFIX = ".spice.toml"
_MAX_CACHED_FILES = 4
#: Texts for a missing number in a text table.
_MISSING = ("na", "NA", "n/a", "N/A", "null", "NULL", "none", "None")
_ALLOWED = (
    f"a CSV or Parquet table with the columns {', '.join(COLUMNS)}; TUM's lines of timestamp tx ty tz qx qy qz qw; "
    f"EuRoC's ground truth, whose header begins with #timestamp; or SPICE kernels, named in a file *{SPICE_SUFFIX}"
)


class TrajectoryFileError(ValueError):
    """A pose file that cannot be used; the message contains the file, the fault, and the allowed formats or values."""


@dataclass(frozen=True, eq=False)
class RecordedPoses:
    """Poses of a file in the file's world and body axes; unit quaternions (x, y, z, w) from body to world.

    - start_s: the file's time of the first pose, exact
    - times_s: times since the first pose
    """

    path: str
    sha256: str
    start_s: Decimal
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
            from marsyard.sim.dynamics.spice import sample_kernels

            digest, values = sample_kernels(path, MIN_POSES)
            return _check_poses(path, digest, Decimal(0), values)
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
        start, values = _read_table(path, head)
    return _check_poses(path, digest, start, values)


def _read_table(path: str, head: bytes) -> tuple[Decimal, Float64[np.ndarray, "n 8"]]:
    """Read the first time and, of each row, time since then, position and quaternion (x, y, z, w).

    The first bytes determine the format.
    """
    first_line = head.decode("utf-8", errors="replace").lstrip("\ufeff").split("\n", 1)[0].strip()
    if head.startswith(b"PAR1"):
        return _read_parquet(path)
    import pandas as pd  # imported here: slow, and few campaigns use such a file

    if first_line.startswith("#timestamp") and "," in first_line:
        frame = pd.read_csv(path, skiprows=1, header=None, usecols=range(8), dtype={0: np.int64})
        return _join_times(path, NANOSECONDS, frame[0].tolist(), frame.to_numpy(dtype=np.float64)[:, _EUROC_POSE])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # empty files are reported below; cells without a column name are ignored
        if "," in first_line and not first_line.startswith("#"):
            return _read_csv(path)
        values = np.loadtxt(path, comments="#", ndmin=2)
        if not values.size:
            return Decimal(0), values.reshape(-1, 8)
        if values.shape[1] != 8:
            raise TrajectoryFileError(f"{path}: has {values.shape[1]} numbers in a line; allowed: {_ALLOWED}")
        texts = np.loadtxt(path, comments="#", ndmin=1, usecols=0, dtype=str).tolist()
    is_integer = all(text.isdecimal() for text in texts)
    unit = NANOSECONDS if is_integer and Decimal(texts[0]) >= _MIN_NANOSECONDS else COLUMNS[0]
    return _join_times(path, unit, texts, values[:, 1:])


def _read_csv(path: str) -> tuple[Decimal, Float64[np.ndarray, "n 8"]]:
    """Read a table with a header; times are read as text, other columns as floating-point numbers."""
    import pandas as pd

    options: dict[str, Any] = {"index_col": False, "skipinitialspace": True}
    names = {name: name.strip() for name in pd.read_csv(path, nrows=0, **options).columns}
    allowed = {*COLUMNS, NANOSECONDS}
    frame = pd.read_csv(
        path,
        usecols=lambda name: name.strip() in allowed,
        dtype={name: str if short in _EXPONENTS else np.float64 for name, short in names.items() if short in allowed},
        na_values=list(_MISSING),
        float_precision="round_trip",
        **options,
    )
    frame.columns = [name.strip() for name in frame.columns]
    columns = _select_columns(path, list(frame.columns))
    times = frame[columns[0]].fillna("nan").str.strip().tolist()
    return _join_times(path, columns[0], times, frame[columns[1:]].to_numpy(dtype=np.float64))


def _join_times(
    path: str, name: str, times: list[Any], poses: Float64[np.ndarray, "n 7"], exponent: int | None = None
) -> tuple[Decimal, Float64[np.ndarray, "n 8"]]:
    """Subtract the first time from all, in decimal numbers; return it and the table of differences (s) and poses.

    - times: text, integers, decimal or floating-point numbers in the unit of the column `name`, or 10^exponent s

    A floating-point number is replaced by its shortest decimal, which is the one that its author wrote if that has at
    most 15 digits. Raises TrajectoryFileError for times that are rounded too much, ValueError for text that is not a
    number.
    """
    exponent = _EXPONENTS[name] if exponent is None else exponent
    if _is_printed_from_floats(times):
        times = [float(time) for time in times]
    start, seconds = Decimal(0), []
    for row, time in enumerate(times):
        try:
            value = Decimal(repr(time) if isinstance(time, float) else time).scaleb(exponent)
        except InvalidOperation as error:
            raise ValueError(f"the time {time!r} is not a number") from error
        start = start if row else value
        seconds.append(float(value - start) if value.is_finite() and start.is_finite() else float("nan"))
    values = np.column_stack([np.array(seconds, dtype=np.float64), poses])
    if all(isinstance(time, float) for time in times):
        _check_resolution(path, name, np.array(times, dtype=np.float64), exponent, values)
    return start, values


def _is_printed_from_floats(times: Sequence[Any]) -> bool:
    """Return whether the texts with more than 15 digits are the decimals of 64-bit floating-point numbers.

    Programs write such numbers with up to 19 digits, the last of which contain the rounding error.
    """
    texts = [time for time in times if isinstance(time, str) and not time.isdecimal()]
    long_texts = [text for text in texts if sum(map(str.isdigit, text.lower().partition("e")[0])) > 15]
    try:
        with localcontext(prec=_PRINTED_DIGITS):
            return bool(long_texts) and all(
                Decimal(float(text)).quantize(Decimal(text)) == Decimal(text) for text in long_texts
            )
    except (InvalidOperation, OverflowError, ValueError):
        return False


def _read_parquet(path: str) -> tuple[Decimal, Float64[np.ndarray, "n 8"]]:
    """Read the pose columns; row count and types are checked in the metadata before any data is decompressed."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = pq.ParquetFile(path)
    rows = file.metadata.num_rows
    if rows > MAX_ROWS:
        raise TrajectoryFileError(f"{path}: has {rows} rows; allowed: up to {MAX_ROWS}")
    available = {field.name.strip(): field for field in file.schema_arrow}
    columns = _select_columns(path, list(available))
    fields = [available[name] for name in columns]
    for field in fields:
        is_time = field is fields[0] and (pa.types.is_decimal(field.type) or _has_unit(field.type))
        if not (pa.types.is_floating(field.type) or pa.types.is_integer(field.type) or is_time):
            raise TrajectoryFileError(f"{path}: the column {field.name} contains {field.type}; allowed: numbers")
    values = np.empty((rows, len(COLUMNS) - 1))
    times: list[Any] = []
    exponent, start = _EXPONENTS[columns[0]], 0
    for batch in file.iter_batches(columns=[field.name for field in fields]):
        if start + batch.num_rows > rows:
            raise TrajectoryFileError(f"{path}: has more rows than the {rows} of its metadata")
        column = batch.column(fields[0].name)
        if _has_unit(column.type):
            exponent = {"s": 0, "ms": -3, "us": -6, "ns": -9}[column.type.unit]
            column = column.cast(pa.int64())
        times += [float("nan") if time is None else time for time in column.to_pylist()]
        for index, field in enumerate(fields[1:]):
            numbers = batch.column(field.name).cast(pa.float64(), safe=False)
            values[start : start + batch.num_rows, index] = numbers.to_numpy(zero_copy_only=False)
        start += batch.num_rows
    return _join_times(path, columns[0], times, values[:start], exponent)


def _has_unit(kind: Any) -> bool:
    """Return whether an Arrow type is a timestamp or duration, which are integers of a unit."""
    import pyarrow as pa

    return bool(pa.types.is_timestamp(kind) or pa.types.is_duration(kind))


def _check_resolution(
    path: str, name: str, stored: Float64[np.ndarray, "n"], exponent: int, values: Float64[np.ndarray, "n 8"]
) -> None:
    """Raise TrajectoryFileError if rounded times cause accelerations above `MAX_ROUNDING_M_S2`.

    Only times with more digits than their type resolves are rounded. A rounding error is uniform over the resolution d:
    its RMS is d / 12^0.5. The second difference 1, -2, 1 of positions amplifies it by 6^0.5 speed / step^2.
    """
    finite = stored[np.isfinite(stored)]
    if finite.size < MIN_POSES:
        return
    resolution = float(np.spacing(np.max(np.abs(finite))))
    digits = (Decimal(repr(time)).as_tuple().exponent for time in finite.tolist())
    if all(isinstance(digit, int) and 10.0**digit > resolution for digit in digits):
        return
    steps = np.diff(values, axis=0)
    step_s = float(np.median(steps[:, 0]))
    speed_m_s = float(np.median(np.linalg.norm(steps[:, _POSITION], axis=1))) / step_s if step_s > 0.0 else 0.0
    resolution_s = resolution * 10.0**exponent
    noise_m_s2 = np.sqrt(0.5) * resolution_s * speed_m_s / step_s**2 if step_s > 0.0 else 0.0
    if noise_m_s2 > MAX_ROUNDING_M_S2:
        raise TrajectoryFileError(
            f"{path}: {name} contains 64-bit floating-point numbers near {finite[0]:.10g}, which are rounded to "
            f"{resolution_s:.1g} s: an acceleration error of {noise_m_s2:.2g} m/s^2; allowed: integers in a column "
            f"{NANOSECONDS}, timestamps, decimals, or times since the first pose"
        )


def _select_columns(path: str, names: Sequence[str]) -> list[str]:
    """Return the names of the columns in the order of `COLUMNS`, with `NANOSECONDS` in place of time_s if available.

    Raises TrajectoryFileError for a missing column.
    """
    columns = [NANOSECONDS if NANOSECONDS in names else COLUMNS[0], *COLUMNS[1:]]
    missing = [name for name in columns if name not in names]
    if missing:
        raise TrajectoryFileError(f"{path}: has no column {', '.join(missing)}; allowed: {_ALLOWED}")
    return columns


def _check_poses(path: str, digest: str, start: Decimal, values: Float64[np.ndarray, "n 8"]) -> RecordedPoses:
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
        before, after = (start + Decimal(time) for time in values[first : first + 2, 0].tolist())
        raise TrajectoryFileError(
            f"{path}: pose {first + 2}: time goes from {before:.6f} to {after:.6f} s; allowed: times that increase"
        )
    lengths = np.linalg.norm(values[:, _QUATERNION], axis=1)
    not_unit = np.flatnonzero(np.abs(lengths - 1.0) > UNIT_TOLERANCE)
    if not_unit.size:
        raise TrajectoryFileError(
            f"{path}: pose {not_unit[0] + 1}: the quaternion's length is {lengths[not_unit[0]]:.4g}; "
            f"allowed: 1 within {UNIT_TOLERANCE:g}"
        )
    # copies, because the table can be read-only, and SciPy's rotations do not accept read-only arrays
    times, positions = np.array(values[:, 0]), np.array(values[:, _POSITION])
    return RecordedPoses(path, digest, start, times, positions, values[:, _QUATERNION] / lengths[:, None])
