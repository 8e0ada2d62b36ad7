"""True errors of a map: its displacement and elevation errors, which are smooth random fields.

The fields are Gaussian, with a Gaussian correlation function.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # scipy.signal is slow to import: it is loaded at its first use
from jaxtyping import Float, Float64
from numpy.random import Generator
from scipy.interpolate import BSpline
from scipy.ndimage import map_coordinates
from scipy.sparse import csr_array

#: Control points per correlation length.
POINTS_PER_LENGTH = 4
#: Extent of the smoothing kernel on each side, standard deviations.
_KERNEL_EXTENT = 4.0
#: A cubic B-spline's values at a knot, from the three control values there; its variance, knots squared.
_SPLINE_AT_KNOTS, _SPLINE_VARIANCE = np.array([1.0, 4.0, 1.0]) / 6.0, 1.0 / 3.0
#: Maximum number of fixed-point iterations of `MapTruth.map_position`, and the change after which they end, m.
_INVERSE_STEPS, _INVERSE_CHANGE_M = 12, 1e-9


@dataclass(frozen=True)
class SmoothField:
    """A field as a uniform cubic B-spline; it is constant outside its extent.

    - control: control values; row i, column j is at y = corner_m[1] + i spacing, x = corner_m[0] + j spacing
    - corner_m: x and y of control value (0, 0)
    """

    control: Float64[np.ndarray, "rows columns"]
    corner_m: Float64[np.ndarray, "2"]
    spacing_m: float

    @classmethod
    def draw(
        cls, low_m: Float[np.ndarray, "2"], high_m: Float[np.ndarray, "2"], sd: float, length_m: float, rng: Generator
    ) -> SmoothField:
        """Draw a stationary Gaussian field with zero mean and the correlation ``exp(-r**2 / (2 length**2))``.

        - low_m, high_m: minimum and maximum x and y of the extent
        - sd: standard deviation of the field

        White noise is filtered by a Gaussian kernel; the spline is part of the kernel.
        """
        spacing = length_m / POINTS_PER_LENGTH
        # one control value more than intervals, and two beyond each end of the extent, which a cubic spline needs
        columns, rows = (np.ceil((np.asarray(high_m) - low_m) / spacing).astype(int) + 1 + 2 * 2).tolist()
        # two kernels with the variance length**2 / 2 give the correlation function
        kernel_sd = np.sqrt(0.5 * POINTS_PER_LENGTH**2 - _SPLINE_VARIANCE)
        extent = int(np.ceil(_KERNEL_EXTENT * kernel_sd))
        kernel = np.exp(-0.5 * (np.arange(-extent, extent + 1) / kernel_sd) ** 2)
        kernel /= np.sqrt(np.sum(np.convolve(kernel, _SPLINE_AT_KNOTS) ** 2))
        noise = rng.standard_normal((rows + 2 * extent, columns + 2 * extent))
        along_y = scipy.signal.oaconvolve(noise, kernel[:, None], mode="valid")
        control = scipy.signal.oaconvolve(along_y, kernel[None, :], mode="valid")
        return cls(sd * control, np.asarray(low_m, dtype=np.float64) - 2.0 * spacing, spacing)

    def at(self, x: Float[np.ndarray, "*batch"], y: Float[np.ndarray, "*batch"]) -> Float64[np.ndarray, "*batch"]:
        """Evaluate the field at positions, metres."""
        positions = np.stack([(y - self.corner_m[1]) / self.spacing_m, (x - self.corner_m[0]) / self.spacing_m])
        return np.asarray(map_coordinates(self.control, positions, order=3, mode="nearest", prefilter=False))

    def on_grid(
        self, x: Float[np.ndarray, "columns"], y: Float[np.ndarray, "rows"]
    ) -> Float64[np.ndarray, "rows columns"]:
        """Evaluate the field on the grid of coordinates inside the extent, metres."""
        rows, columns = self.control.shape
        along_y = _spline_matrix((y - self.corner_m[1]) / self.spacing_m, rows)
        along_x = _spline_matrix((x - self.corner_m[0]) / self.spacing_m, columns)
        return np.asarray(along_y @ (along_x @ self.control.T).T)


def _spline_matrix(positions: Float[np.ndarray, "n"], count: int) -> csr_array:
    """Return the sparse matrix of B-spline weights, (n, count), of positions in control points."""
    # basis function k of these knots is centred at k
    return BSpline.design_matrix(positions, np.arange(-2.0, count + 2.0), 3)


@dataclass(frozen=True)
class MapTruth:
    """True errors of a map.

    - shift_m: map position minus world position, of the whole map
    - distortion_x, distortion_y: additional displacement along each axis, m, at a map position
    - elevation_error: error of the elevation, m, at a map position, without the effect of the posts' distance
    - counts_per_radiance: appearance divided by the radiance factor at the orbiter
    """

    shift_m: Float64[np.ndarray, "2"]
    distortion_x: SmoothField
    distortion_y: SmoothField
    elevation_error: SmoothField
    counts_per_radiance: float

    def distortion(self, map_m: Float[np.ndarray, "*batch 2"]) -> Float64[np.ndarray, "*batch 2"]:
        """Return the displacement of map positions relative to the whole map, m."""
        x, y = np.atleast_1d(map_m[..., 0]), np.atleast_1d(map_m[..., 1])
        return np.stack([self.distortion_x.at(x, y), self.distortion_y.at(x, y)], axis=-1).reshape(np.shape(map_m))

    def world_position(self, map_m: Float[np.ndarray, "*batch 2"]) -> Float64[np.ndarray, "*batch 2"]:
        """Return the world x, y of the surface point that appears at a map position.

        The position error of the map is ``map_m - world_position(map_m)``.
        """
        return np.asarray(map_m - self.shift_m - self.distortion(map_m))

    def map_position(self, world_m: Float[np.ndarray, "*batch 2"]) -> Float64[np.ndarray, "*batch 2"]:
        """Return the map position at which a world position appears, by fixed-point iteration.

        It converges, because the distortion changes much less over a metre than a metre.
        """
        map_m = world_m + self.shift_m
        for _ in range(_INVERSE_STEPS):
            previous_m, map_m = map_m, world_m + self.shift_m + self.distortion(map_m)
            if np.abs(map_m - previous_m).max(initial=0.0) < _INVERSE_CHANGE_M:
                break
        return np.asarray(map_m)
