"""Compiled projection through a lens with radial distortion: few points at a time, where NumPy's calls cost most."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Triple = tuple[float, float, float]


@njit(cache=True, inline="always")
def _dot(vector: Array, x: float, y: float, z: float) -> float:
    product: float = vector[0] * x + vector[1] * y + vector[2] * z
    return product


@njit(cache=True, error_model="numpy")
def radial_image(
    points: tuple[Array, Array, Array],
    axis: Array,
    image_plane: tuple[Array, Array, Array],
    axis_image: Triple,
    r: Array,
    tau_limit: float,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Columns and rows of points, and whether the optics can image them: `sim.camera.Cahvor` says by what model.

    Parameters
    ----------
    points
        x, y and z of P - C, shape (n,) each.
    axis
        O, to full length.
    image_plane, axis_image
        H, V and A, and the products of O with each.
    r, tau_limit
        (rho0, rho1, rho2), and the tau at which the distance from the axis stops growing.
    """
    along_x, along_y, along_z = points
    h, v, a = image_plane
    count = along_x.size
    columns, rows, seen = np.empty(count), np.empty(count), np.empty(count, dtype=np.bool_)
    for n in range(count):
        x, y, z = along_x[n], along_y[n], along_z[n]
        omega = _dot(axis, x, y, z)
        tau = (x * x + y * y + z * z) / (omega * omega) - 1.0
        tau = 0.0 if tau < 0.0 else tau
        mu = r[0] + tau * (r[1] + tau * r[2])
        column, row, depth = _dot(h, x, y, z), _dot(v, x, y, z), _dot(a, x, y, z)
        column += mu * (column - axis_image[0] * omega)
        row += mu * (row - axis_image[1] * omega)
        depth += mu * (depth - axis_image[2] * omega)
        columns[n], rows[n] = column / depth, row / depth
        seen[n] = omega > 0.0 and tau < tau_limit and depth > 0.0
    return columns, rows, seen
