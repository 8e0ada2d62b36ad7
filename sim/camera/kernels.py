"""Compiled projection through a lens with radial distortion, and its inverse.

`marsyard.sim.camera.models` uses these functions and defines their symbols: `Cahvor` (omega, tau, mu) and `RadialModel`
(chi, f).
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vector3 = tuple[float, float, float]

#: Maximum number of Newton steps, and relative step that ends the iteration; the remaining error is about step**2.
NEWTON_STEPS, TOLERANCE = 12, 1e-9
#: Steps of the bisection if Newton's method fails: more than the 53 bits of a float's mantissa.
BISECTION_STEPS = 70


@njit(cache=True, inline="always")
def _dot(vector: Array, x: float, y: float, z: float) -> float:
    product: float = vector[0] * x + vector[1] * y + vector[2] * z
    return product


@njit(cache=True, error_model="numpy")
def project_radial(
    points: tuple[Array, Array, Array],
    axis: Array,
    image_plane: tuple[Array, Array, Array],
    axis_image: Vector3,
    r: Array,
    tau_limit: float,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Project points to columns and rows, and test whether they are visible; equations and symbols of `Cahvor`.

    - points: x, y and z of P - C, shape (n,) each
    - axis: O, normalised
    - image_plane, axis_image: H, V and A, and their scalar products with O
    - r, tau_limit: (rho0, rho1, rho2), and the tau at which the distance (1 + mu) sqrt(tau) from the axis stops growing
    """
    point_x, point_y, point_z = points
    h, v, a = image_plane
    count = point_x.size
    columns, rows, is_visible = np.empty(count), np.empty(count), np.empty(count, dtype=np.bool_)
    for n in range(count):
        x, y, z = point_x[n], point_y[n], point_z[n]
        omega = _dot(axis, x, y, z)
        tau = (x * x + y * y + z * z) / (omega * omega) - 1.0
        tau = 0.0 if tau < 0.0 else tau
        mu = r[0] + tau * (r[1] + tau * r[2])
        column, row, depth = _dot(h, x, y, z), _dot(v, x, y, z), _dot(a, x, y, z)
        column += mu * (column - axis_image[0] * omega)
        row += mu * (row - axis_image[1] * omega)
        depth += mu * (depth - axis_image[2] * omega)
        columns[n], rows[n] = column / depth, row / depth
        is_visible[n] = omega > 0.0 and tau < tau_limit and depth > 0.0
    return columns, rows, is_visible


@njit(cache=True, inline="always")
def _compute_residual(polynomial: Vector3, tau: float, ratio: float) -> float:
    """Compute the residual of the equation of `_invert_distortion`; it grows with the ratio while f grows."""
    s = tau * ratio * ratio
    return ratio * (polynomial[0] + s * (polynomial[1] + s * polynomial[2])) - 1.0


@njit(cache=True, error_model="numpy")
def _bisect(polynomial: Vector3, tau: float, upper: float) -> float:
    """Solve the equation of `_invert_distortion` by bisection between 0 and `upper`, which may be infinite."""
    low, high = 0.0, upper
    if upper == math.inf:
        high = 1.0
        while _compute_residual(polynomial, tau, high) < 0.0:
            high *= 2.0
    for _ in range(BISECTION_STEPS):
        midpoint = 0.5 * (low + high)
        if _compute_residual(polynomial, tau, midpoint) > 0.0:
            high = midpoint
        else:
            low = midpoint
    return 0.5 * (low + high)


@njit(cache=True, error_model="numpy")
def _invert_distortion(polynomial: Vector3, limits: tuple[float, float], tau: float) -> float:
    """Solve g (k1 + s (k3 + s k5)) = 1 with s = tau g^2 for the ratio g = chi / f(chi); tau is f(chi)^2.

    The ratio is finite on the axis. Newton's method starts at g = 1 / k1; bisection follows if it fails.
    """
    if not tau < limits[1]:
        return math.nan
    k1, k3, k5 = polynomial
    ratio, step = 1.0 / k1, 0.0
    for _ in range(NEWTON_STEPS):
        s = tau * ratio * ratio
        step = (ratio * (k1 + s * (k3 + s * k5)) - 1.0) / (k1 + s * (3.0 * k3 + s * (5.0 * k5)))
        ratio -= step
        if abs(step) <= TOLERANCE * ratio:
            break
    upper = math.sqrt(limits[0] / tau)
    if abs(step) <= TOLERANCE * ratio and 0.0 < ratio <= upper:
        return ratio
    solution: float = _bisect(polynomial, tau, upper)
    return solution


@njit(cache=True, error_model="numpy")
def compute_undistortion_ratios(polynomial: Vector3, limits: tuple[float, float], distorted_tau: Array) -> Array:
    """Compute the ratio chi / f(chi) for each f(chi)^2; NaN beyond the range of f.

    - polynomial: k1, k3 and k5 of f(chi) = k1 chi + k3 chi^3 + k5 chi^5
    - limits: chi^2 and f(chi)^2 at the first maximum of f
    """
    ratio = np.empty(distorted_tau.size)
    for n in range(distorted_tau.size):
        ratio[n] = _invert_distortion(polynomial, limits, distorted_tau[n])
    return ratio


@njit(cache=True, error_model="numpy")
def compute_ray_directions(
    u: Array,
    v: Array,
    direction_from_pixel: NDArray[np.float64],
    axis: Array,
    polynomial: Vector3,
    limits: tuple[float, float],
) -> tuple[Array, Array, Array]:
    """Compute ray directions of pixels for `Cahvor`: of any length, NaN beyond the range of the distortion.

    - direction_from_pixel: matrix that maps (u, v, 1) to a direction before distortion
    - axis: O, normalised
    - polynomial, limits: as in `compute_undistortion_ratios`
    """
    matrix = direction_from_pixel
    direction_x, direction_y, direction_z = np.empty(u.size), np.empty(u.size), np.empty(u.size)
    for n in range(u.size):
        x = matrix[0, 0] * u[n] + matrix[0, 1] * v[n] + matrix[0, 2]
        y = matrix[1, 0] * u[n] + matrix[1, 1] * v[n] + matrix[1, 2]
        z = matrix[2, 0] * u[n] + matrix[2, 1] * v[n] + matrix[2, 2]
        axial = _dot(axis, x, y, z)
        x, y, z = x - axial * axis[0], y - axial * axis[1], z - axial * axis[2]
        tau = (x * x + y * y + z * z) / (axial * axial) if axial > 0.0 else math.nan
        ratio = _invert_distortion(polynomial, limits, tau)
        direction_x[n] = axial * axis[0] + ratio * x
        direction_y[n] = axial * axis[1] + ratio * y
        direction_z[n] = axial * axis[2] + ratio * z
    return direction_x, direction_y, direction_z
