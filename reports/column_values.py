"""Values of a column of rows, and of a single cell."""

import numpy as np
import pandas as pd
from jaxtyping import Float


def numbers(frame: pd.DataFrame, column: str) -> Float[np.ndarray, " n"]:
    """Return a column as float64; NaN for missing numbers or a missing column."""
    if column not in frame:
        return np.full(len(frame), np.nan)
    values = pd.to_numeric(frame[column], errors="coerce")
    return np.asarray(values.to_numpy(dtype=np.float64, na_value=np.nan), dtype=np.float64)


def is_number(frame: pd.DataFrame, column: str) -> bool:
    """Whether a column contains numbers; flags are not numbers."""
    dtype = frame[column].dtype
    return pd.api.types.is_numeric_dtype(dtype) and not pd.api.types.is_bool_dtype(dtype)


def to_float(value: object) -> float:
    """Convert a number to float; NaN for other values."""
    return float(value) if isinstance(value, int | float | np.number) and not isinstance(value, bool) else np.nan


def is_true(value: object) -> bool:
    """Whether a value of a row is true; missing values are not."""
    return isinstance(value, bool | np.bool_) and bool(value)
