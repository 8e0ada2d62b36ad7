"""Numbers and flags of single cells of a row."""

import numpy as np


def to_float(value: object) -> float:
    """Convert a number to float; NaN for other values."""
    return float(value) if isinstance(value, int | float | np.number) and not isinstance(value, bool) else np.nan


def is_true(value: object) -> bool:
    """Whether a value of a row is true; missing values are not."""
    return isinstance(value, bool | np.bool_) and bool(value)
