"""What cases keep, read with care: it comes from files."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def numbers(value: object) -> Float[np.ndarray, "..."] | None:
    """A product as float64; None where it is something else."""
    if value is None:
        return None
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None


def plane(value: object) -> Float[np.ndarray, "_ _"] | None:
    """A product of two dimensions with something in it; None where it is something else."""
    values = numbers(value)
    return values if values is not None and values.ndim == 2 and values.size else None
