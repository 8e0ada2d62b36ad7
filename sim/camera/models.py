"""The camera models CAHV (pinhole) and CAHVOR (radial distortion), and the base class of CAHVOR and CAHVORE.

CAHV: Yakimovsky & Cunningham 1978. CAHVOR: Gennery 2001; 2006, section 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from marsyard.sim.camera.base import UNIT_TOLERANCE, CameraModel, Components, Number, Vector, Vector3Like, dot

_ORIGIN = (0.0, 0.0, 0.0)
#: A chi^2 above this is treated as infinite.
_INFINITE_TAU = 1e30
#: Maximum number of Newton steps, and relative step that ends the iteration; the remaining error is about step**2.
_NEWTON_STEPS, _STEP_TOLERANCE = 12, 1e-9
#: Steps of the bisection if Newton's method fails: more than the 53 bits of a float's mantissa.
_BISECTION_STEPS = 70


@final
@dataclass(frozen=True, eq=False)
class Cahv(CameraModel):
    """A pinhole camera: u = (P - C).H / (P - C).A and v = (P - C).V / (P - C).A for a point P.

    Attributes as in `CameraModel`. Raises ValueError if a vector is not finite, A is not a unit vector, A, H and V are
    linearly dependent or the size is not positive.
    """

    c: Float[np.ndarray, "3"]
    a: Float[np.ndarray, "3"]
    h: Float[np.ndarray, "3"]
    v: Float[np.ndarray, "3"]
    size: tuple[int, int]

    def _compute_pixels(self, x: Vector, y: Vector, z: Vector) -> tuple[Vector, Vector, NDArray[np.bool_]]:
        depth = dot(self.a, x, y, z)
        return dot(self.h, x, y, z) / depth, dot(self.v, x, y, z) / depth, depth > 0

    def _compute_gradients(self, x: Vector, y: Vector, z: Vector) -> tuple[Components, Components]:
        depth = dot(self.a, x, y, z)
        u, v = dot(self.h, x, y, z) / depth, dot(self.v, x, y, z) / depth
        return _gradient(self.h, self.a, u, depth), _gradient(self.v, self.a, v, depth)

    def _compute_rays(self, u: Vector, v: Vector) -> tuple[Components, Vector | None]:
        return self._compute_linear_directions(u, v), None

    @classmethod
    def from_axes(
        cls,
        focal_lengths: tuple[Number, Number],
        size: tuple[int, int],
        *,
        axis: Vector3Like,
        right: Vector3Like,
        centre: Vector3Like = _ORIGIN,
        image_centre: tuple[Number, Number] | None = None,
    ) -> Cahv:
        """Create a camera whose H' and V' are perpendicular from its focal lengths (hs, vs) in pixels.

        - axis: viewing direction A, of any length
        - right: direction in which u grows; its component along `axis` is removed. v grows along axis x right
        - centre: C, metres
        - image_centre: (hc, vc), pixels; the middle of the frame by default

        Raises ValueError if a focal length is not positive, or if `axis` and `right` are zero or parallel.
        """
        if not (np.all(np.isfinite(focal_lengths)) and min(focal_lengths) > 0):
            raise ValueError(f"focal lengths must be positive and finite, not {focal_lengths}")
        units = []
        for name, triple in (("axis", axis), ("right", right)):
            vector = np.asarray(triple, dtype=np.float64)
            length = float(np.linalg.norm(vector))
            if vector.shape != (3,) or not (np.isfinite(length) and length > 0):
                raise ValueError(f"{name} must be a finite vector of three components that are not all zero")
            units.append(vector / length)
        forward, sideways = units
        perpendicular = sideways - (sideways @ forward) * forward
        if np.linalg.norm(perpendicular) < 1e-6:
            raise ValueError("axis and right must not be parallel")
        perpendicular /= np.linalg.norm(perpendicular)
        hc, vc = ((size[0] - 1) / 2, (size[1] - 1) / 2) if image_centre is None else image_centre
        return cls(
            c=np.asarray(centre, dtype=np.float64),
            a=forward,
            h=focal_lengths[0] * perpendicular + hc * forward,
            v=focal_lengths[1] * np.cross(forward, perpendicular) + vc * forward,
            size=size,
        )

    @classmethod
    def from_focal_length(
        cls,
        focal_m: Number,
        pixel_pitch_m: Number | tuple[Number, Number],
        size: tuple[int, int],
        *,
        axis: Vector3Like,
        right: Vector3Like,
        centre: Vector3Like = _ORIGIN,
        image_centre: tuple[Number, Number] | None = None,
    ) -> Cahv:
        """Create a camera from its focal length and pixel pitch (one number, or width and height); see `from_axes`."""
        column_m, row_m = pixel_pitch_m if isinstance(pixel_pitch_m, tuple) else (pixel_pitch_m, pixel_pitch_m)
        if not (column_m > 0 and row_m > 0):
            raise ValueError(f"the pixel pitch must be positive, not {pixel_pitch_m} m")
        focal_lengths = (focal_m / column_m, focal_m / row_m)
        return cls.from_axes(focal_lengths, size, axis=axis, right=right, centre=centre, image_centre=image_centre)

    @classmethod
    def from_field_of_view(
        cls,
        horizontal_rad: Number,
        size: tuple[int, int],
        *,
        axis: Vector3Like,
        right: Vector3Like,
        vertical_rad: Number | None = None,
        centre: Vector3Like = _ORIGIN,
    ) -> Cahv:
        """Create a camera from its full field of view; pixels are square if `vertical_rad` is None; see `from_axes`."""
        for angle in (horizontal_rad, vertical_rad):
            if angle is not None and not 0 < angle < np.pi:
                raise ValueError(f"a field of view must lie between 0 and pi radians, not {angle}")
        hs = float(size[0] / 2 / np.tan(horizontal_rad / 2))
        vs = hs if vertical_rad is None else float(size[1] / 2 / np.tan(vertical_rad / 2))
        return cls.from_axes((hs, vs), size, axis=axis, right=right, centre=centre)


def _gradient(image_vector: NDArray[np.float64], axis: NDArray[np.float64], pixel: Vector, depth: Vector) -> Components:
    """Compute the gradient of a column or row of a pinhole camera; `image_vector` is H or V, `axis` is A."""
    x, y, z = ((image_vector[i] - pixel * axis[i]) / depth for i in range(3))
    return x, y, z


class RadialModel(CameraModel):
    """A camera with radial distortion about an optical axis O: base class of CAHVOR and CAHVORE.

    Let lambda be the component of P - C perpendicular to O. A point P is projected to the pixel of the direction
    O + kappa lambda; the two models differ in kappa. Let chi be the radial coordinate of a ray: a function of its angle
    from O, for a perspective lens the tangent. The distortion moves the ray from chi to

        f(chi) = (1 + rho0) chi + rho1 chi^3 + rho2 chi^5

    (Gennery 2006: mu = rho0 + rho1 tau + rho2 tau^2 with tau = chi^2). The valid range of chi ends at the first maximum
    of f, because beyond it two directions would be projected to one pixel.
    """

    o: Float[np.ndarray, "3"]
    r: Float[np.ndarray, "3"]

    def __post_init__(self) -> None:
        super().__post_init__()
        length = float(np.linalg.norm(self.o))
        if abs(length - 1) > UNIT_TOLERANCE:
            raise ValueError(f"o must be a unit vector (to {UNIT_TOLERANCE:g}); its length is {length!r}")
        if not self._axis @ self.a > 0:
            raise ValueError("o must point to the same side of the image plane as a")
        if not self.r[0] > -1:
            rho0 = float(self.r[0])
            raise ValueError(f"r must begin with a number above -1 (1 + r[0] scales the image), not {rho0!r}")

    @cached_property
    def _axis(self) -> NDArray[np.float64]:
        """O normalised, because labels contain it rounded to six digits."""
        return np.asarray(self.o / np.linalg.norm(self.o))

    @cached_property
    def _axis_image(self) -> tuple[float, float, float]:
        """Scalar products of the normalised O with H, V and A."""
        return float(self._axis @ self.h), float(self._axis @ self.v), float(self._axis @ self.a)

    @cached_property
    def _polynomial(self) -> tuple[float, float, float]:
        """Coefficients k1 > 0, k3 and k5 of f."""
        return 1 + float(self.r[0]), float(self.r[1]), float(self.r[2])

    @cached_property
    def _limits(self) -> tuple[float, float]:
        """chi^2 and f(chi)^2 at the first maximum of f; infinite if f has none below `_INFINITE_TAU`."""
        k1, k3, k5 = self._polynomial
        tau, discriminant = np.inf, 9 * k3**2 - 20 * k5 * k1
        if k5 == 0:
            tau = -k1 / (3 * k3) if k3 < 0 else np.inf
        elif discriminant >= 0:
            # the two roots of k1 + 3 k3 tau + 5 k5 tau^2, in the form without cancellation
            half = -0.5 * (3 * k3 + np.copysign(np.sqrt(discriminant), k3))
            roots = [half / (5 * k5), k1 / half if half else -np.inf]
            tau = min((float(root) for root in roots if root > 0), default=np.inf)
        if not tau < _INFINITE_TAU:
            return np.inf, np.inf
        return float(tau), float(tau * (k1 + tau * (k3 + tau * k5)) ** 2)

    def _compute_undistortion_ratios(self, distorted_tau: Vector) -> Vector:
        """Compute the ratios g = chi / f(chi) for values tau of f(chi)^2; NaN beyond the range of f.

        Each solves g (k1 + s (k3 + s k5)) = 1 with s = tau g^2, and is finite on the axis. Newton's method starts at
        g = 1 / k1; bisection follows for the values for which it fails.
        """
        k1, k3, k5 = self._polynomial
        ratio = np.full_like(distorted_tau, 1.0 / k1)
        is_valid = distorted_tau < self._limits[1]
        is_moving = is_valid.copy()
        for _ in range(_NEWTON_STEPS):
            s = distorted_tau * ratio * ratio
            step = (ratio * (k1 + s * (k3 + s * k5)) - 1.0) / (k1 + s * (3.0 * k3 + s * (5.0 * k5)))
            ratio = np.where(is_moving, ratio - step, ratio)
            is_moving &= ~(np.abs(step) <= _STEP_TOLERANCE * ratio)
            if not is_moving.any():
                break
        max_ratio = np.sqrt(self._limits[0] / distorted_tau)
        has_failed = is_valid & (is_moving | ~((ratio > 0.0) & (ratio <= max_ratio)))
        if has_failed.any():
            ratio[has_failed] = self._bisect_ratios(distorted_tau[has_failed], max_ratio[has_failed])
        return np.where(is_valid, ratio, np.nan)

    def _bisect_ratios(self, distorted_tau: Vector, max_ratio: Vector) -> Vector:
        """Solve the equation of `_compute_undistortion_ratios` by bisection between 0 and a maximum or infinity."""
        k1, k3, k5 = self._polynomial

        def is_not_above(ratio: Vector) -> NDArray[np.bool_]:
            s = distorted_tau * ratio * ratio
            return np.asarray(ratio * (k1 + s * (k3 + s * k5)) <= 1.0)

        low, high = np.zeros_like(max_ratio), np.where(np.isfinite(max_ratio), max_ratio, 1.0)
        while np.any(is_below := is_not_above(high) & np.isinf(max_ratio)):
            high = np.where(is_below, 2.0 * high, high)
        for _ in range(_BISECTION_STEPS):
            middle = 0.5 * (low + high)
            is_low = is_not_above(middle)
            low, high = np.where(is_low, middle, low), np.where(is_low, high, middle)
        return 0.5 * (low + high)

    def _split_at_axis(self, x: Vector, y: Vector, z: Vector) -> tuple[Vector, Components, Vector]:
        """Split P - C into its component along O and the vector lambda perpendicular to O; third value: its length."""
        axial = dot(self._axis, x, y, z)
        x, y, z = x - axial * self._axis[0], y - axial * self._axis[1], z - axial * self._axis[2]
        return axial, (x, y, z), np.sqrt(x * x + y * y + z * z)

    def _radial_gradient(
        self, lateral: Components, kappa: Vector, kappa_gradient: Components
    ) -> tuple[Components, Components]:
        """Compute the gradients of column and row of O + kappa lambda; `lateral` is lambda."""
        lateral_image = [dot(vector, *lateral) for vector in (self.h, self.v, self.a)]
        axis_image = self._axis_image
        depth = axis_image[2] + kappa * lateral_image[2]

        gradients = []
        for k, vector in enumerate((self.h, self.v)):
            pixel = (axis_image[k] + kappa * lateral_image[k]) / depth
            slope = (lateral_image[k] - pixel * lateral_image[2]) / depth
            x, y, z = (
                kappa
                * ((vector[i] - axis_image[k] * self._axis[i]) - pixel * (self.a[i] - axis_image[2] * self._axis[i]))
                / depth
                + slope * kappa_gradient[i]
                for i in range(3)
            )
            gradients.append((x, y, z))
        return gradients[0], gradients[1]


@final
@dataclass(frozen=True, eq=False)
class Cahvor(RadialModel):
    """A camera with radial distortion about an optical axis O.

    A point P is moved to P' = P + mu lambda before the linear projection of `Cahv`, with omega = (P - C).O,
    lambda = P - C - omega O, tau = lambda.lambda / omega^2 and mu = rho0 + rho1 tau + rho2 tau^2. The distorted
    distance (1 + mu) sqrt(tau) from the axis grows with tau up to a maximum; points beyond it are not visible.

    - c, a, h, v, size: as in `CameraModel`
    - o: unit vector O of the optical axis; only its direction is used
    - r: (rho0, rho1, rho2)

    Raises ValueError as `Cahv` does; also if O is not a unit vector, O.A <= 0, or rho0 <= -1.
    """

    c: Float[np.ndarray, "3"]
    a: Float[np.ndarray, "3"]
    h: Float[np.ndarray, "3"]
    v: Float[np.ndarray, "3"]
    o: Float[np.ndarray, "3"]
    r: Float[np.ndarray, "3"]
    size: tuple[int, int]

    @classmethod
    def from_cahv(cls, cahv: Cahv, r: Vector3Like, o: Vector3Like | None = None) -> Cahvor:
        """Add distortion `r` (rho0, rho1, rho2) about the unit vector `o` (A by default) to a pinhole camera."""
        axis = cahv.a if o is None else np.asarray(o, dtype=np.float64)
        return cls(cahv.c, cahv.a, cahv.h, cahv.v, axis, np.asarray(r, dtype=np.float64), cahv.size)

    def _compute_pixels(self, x: Vector, y: Vector, z: Vector) -> tuple[Vector, Vector, NDArray[np.bool_]]:
        omega = dot(self._axis, x, y, z)
        tau = np.maximum((x * x + y * y + z * z) / (omega * omega) - 1.0, 0.0)
        mu = self.r[0] + tau * (self.r[1] + tau * self.r[2])
        column, row, depth = (
            undistorted + mu * (undistorted - image * omega)
            for image, undistorted in zip(
                self._axis_image, (dot(vector, x, y, z) for vector in (self.h, self.v, self.a)), strict=True
            )
        )
        return column / depth, row / depth, (omega > 0.0) & (tau < self._limits[0]) & (depth > 0.0)

    def _compute_gradients(self, x: Vector, y: Vector, z: Vector) -> tuple[Components, Components]:
        omega = dot(self._axis, x, y, z)
        tau = np.maximum((x * x + y * y + z * z) / (omega * omega) - 1, 0)
        kappa = (1 + (self.r[0] + tau * (self.r[1] + tau * self.r[2]))) / omega
        mu_slope = (self.r[1] + 2 * self.r[2] * tau) * 2 / omega**3
        axial, lateral, _ = self._split_at_axis(x, y, z)
        # d tau = 2 (lambda / omega^2 - tau / omega O).dP, because lambda is perpendicular to O
        kappa_x, kappa_y, kappa_z = (
            mu_slope * (lateral[i] - tau * omega * self._axis[i]) - kappa / axial * self._axis[i] for i in range(3)
        )
        return self._radial_gradient(lateral, kappa, (kappa_x, kappa_y, kappa_z))

    def _compute_rays(self, u: Vector, v: Vector) -> tuple[Components, Vector | None]:
        axial, (x, y, z), _ = self._split_at_axis(*self._compute_linear_directions(u, v))
        tau = (x * x + y * y + z * z) / (axial * axial)
        ratio = self._compute_undistortion_ratios(np.where(axial > 0.0, tau, np.nan))
        direction = [axial * self._axis[i] + ratio * lateral for i, lateral in enumerate((x, y, z))]
        return (direction[0], direction[1], direction[2]), None
