"""Plain vector arithmetic and the checks of a camera's fields."""

from __future__ import annotations

import numpy as np
from jaxtyping import Num
from numpy.typing import ArrayLike, NDArray

Vector = NDArray[np.float64]
#: What is measured and may be written as an integer (the run-time checks take no integer for a float).
Real = float | int
#: Three components, as an array or written out.
Triple = Num[np.ndarray, "3"] | tuple[Real, Real, Real]
Gradient = tuple[Vector, Vector, Vector]

#: Points handled at once: few enough for the processor's cache, enough to hide NumPy's cost per call.
BLOCK = 16384


def dot(vector: NDArray[np.float64], x: Vector, y: Vector, z: Vector) -> Vector:
    """Scalar product of one vector with n, the same for each whatever n is (a BLAS product need not be)."""
    return np.asarray(vector[0] * x + vector[1] * y + vector[2] * z)


def cross(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vector product of two vectors of three components, in a fifth of the time that NumPy's takes for any shapes."""
    a, b, c = first.tolist()
    x, y, z = second.tolist()
    return np.array([b * z - c * y, c * x - a * z, a * y - b * x])


def unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """The vector brought to length 1."""
    return np.asarray(vector / np.linalg.norm(vector))


def blocks(count: int) -> list[slice]:
    """Slices of at most `BLOCK` that cover range(count)."""
    return [slice(start, min(start + BLOCK, count)) for start in range(0, count, BLOCK)]


def frozen_vector(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """A read-only copy of three finite components, or a ValueError that names the field."""
    vector = np.asarray(value, dtype=np.float64) + 0.0  # a copy; turns -0.0 into 0.0, so that equal cameras hash alike
    if vector.shape != (3,):
        raise ValueError(f"{name} must have three components, not shape {vector.shape}")
    if not np.all(np.isfinite(vector)):
        raise ValueError(f"{name} must be finite, not {vector.tolist()}")
    vector.flags.writeable = False
    return vector


def checked_size(size: tuple[int, int]) -> tuple[int, int]:
    """The size as Python integers, or a ValueError."""
    columns, rows = size
    if int(columns) != columns or int(rows) != rows or columns < 1 or rows < 1:
        raise ValueError(f"size must be two positive integers (columns, rows), not {size}")
    return int(columns), int(rows)
