"""The camera model CAHVORE: a wide-angle lens with a moving entrance pupil.

Gennery 2006, "Generalized camera calibration including fish-eye lenses", IJCV 68(3), sections 3 to 5.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from marsyard.sim.camera.base import Components, Number, Vector, Vector3Like, dot
from marsyard.sim.camera.models import Cahv, RadialModel

#: Maximum number of Newton steps for the angle of a ray.
_NEWTON_STEPS = 30
#: A linearity of at most this magnitude is treated as 0, as in JPL's cmod.
_ZERO_LINEARITY = 1e-15
#: Newton step of an angle, radians, that ends the iteration; the remaining error is of the order of its square.
_STEP_TOLERANCE_RAD = 1e-9


@final
@dataclass(frozen=True, eq=False)
class Cahvore(RadialModel):
    """A wide-angle camera whose entrance pupil moves along the optical axis.

    A ray that makes the angle theta with O starts at C + s O, with
    s = (theta / sin theta - 1) (e0 + e1 theta^2 + e2 theta^4). With the linearity L its radial coordinate is

        chi = tan(L theta) / L   (L > 0; L = 1 is a perspective lens)
        chi = theta              (L = 0, an equidistant fisheye)
        chi = sin(L theta) / L   (L < 0; L = -1 is orthographic)

    The distortion changes chi to (1 + rho0) chi + rho1 chi^3 + rho2 chi^5, followed by the linear projection of `Cahv`.
    A point is not visible if the distortion is not one-to-one at its chi, or if not exactly one ray passes through it.

    - c, a, h, v, size: as in `CameraModel`; C is the entrance pupil for rays along the axis
    - o, r: as in `Cahvor`
    - e: coefficients (e0, e1, e2) of the pupil's motion, metres
    - linearity: L, from -1 to 1

    Raises ValueError as `Cahvor` does; also if the linearity is not from -1 to 1.
    """

    c: Float[np.ndarray, "3"]
    a: Float[np.ndarray, "3"]
    h: Float[np.ndarray, "3"]
    v: Float[np.ndarray, "3"]
    o: Float[np.ndarray, "3"]
    r: Float[np.ndarray, "3"]
    e: Float[np.ndarray, "3"]
    linearity: Number = field(kw_only=True)
    size: tuple[int, int] = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "linearity", float(self.linearity) + 0.0)
        if not -1 <= self.linearity <= 1:
            raise ValueError(f"linearity must lie between -1 and 1, not {self.linearity!r}")

    @classmethod
    def from_cahv(
        cls,
        cahv: Cahv,
        r: Vector3Like,
        e: Vector3Like = (0.0, 0.0, 0.0),
        *,
        linearity: Number,
        o: Vector3Like | None = None,
    ) -> Cahvore:
        """Add a wide-angle lens about the unit vector `o` (A by default) to a pinhole camera."""
        axis = cahv.a if o is None else np.asarray(o, dtype=np.float64)
        radial, pupil = np.asarray(r, dtype=np.float64), np.asarray(e, dtype=np.float64)
        return cls(cahv.c, cahv.a, cahv.h, cahv.v, axis, radial, pupil, linearity=linearity, size=cahv.size)

    @cached_property
    def _theta_limit(self) -> float:
        """Angle from the axis up to which the lens is one-to-one, radians."""
        chi = np.sqrt(self._limits[0])
        return min(float(self._theta_from_chi(np.array([chi]))[0]), np.pi)

    def _chi_from_theta(self, theta: Vector) -> Vector:
        """Compute the radial coordinate of rays at an angle from O."""
        linearity = self.linearity
        if linearity > _ZERO_LINEARITY:
            return np.tan(linearity * theta) / linearity
        return np.sin(linearity * theta) / linearity if linearity < -_ZERO_LINEARITY else theta

    def _theta_from_chi(self, chi: Vector) -> Vector:
        """Compute the angle from O of rays with a radial coordinate."""
        linearity = self.linearity
        if linearity > _ZERO_LINEARITY:
            return np.arctan(linearity * chi) / linearity
        return np.arcsin(np.maximum(linearity * chi, -1)) / linearity if linearity < -_ZERO_LINEARITY else chi

    def _pupil_series(self, theta: Vector) -> tuple[Vector, Vector]:
        """Compute e0 + e1 theta^2 + e2 theta^4, metres, and its derivative with respect to theta."""
        theta2 = theta * theta
        series = self.e[0] + theta2 * (self.e[1] + theta2 * self.e[2])
        return series, theta * (2 * self.e[1] + 4 * self.e[2] * theta2)

    def _solve_theta(self, axial: Vector, radius: Vector) -> tuple[Vector, Vector]:
        """Compute the angle theta of the ray through a point (NaN if there is none), and the slope upsilon there.

        The point has the coordinate `axial` along the axis and the distance `radius` from it. Newton's method finds the
        root of axial sin theta - radius cos theta - (theta - sin theta) (e0 + e1 theta^2 + e2 theta^4); upsilon is the
        derivative of this function.
        """
        theta = np.arctan2(radius, axial)
        upsilon = step = np.zeros_like(theta)
        for _ in range(_NEWTON_STEPS):
            sine, cosine = np.sin(theta), np.cos(theta)
            series, slope = self._pupil_series(theta)
            theta_minus_sine = theta - sine
            upsilon = axial * cosine + radius * sine - (1 - cosine) * series - theta_minus_sine * slope
            step = (axial * sine - radius * cosine - theta_minus_sine * series) / upsilon
            theta = theta - step
            if not np.any(np.abs(step) > _STEP_TOLERANCE_RAD):
                break
        is_solved = (np.abs(step) <= _STEP_TOLERANCE_RAD) & (upsilon > 0) & (theta >= 0) & (theta < self._theta_limit)
        return np.where(is_solved, theta, np.nan), upsilon

    def _compute_pixels(self, x: Vector, y: Vector, z: Vector) -> tuple[Vector, Vector, NDArray[np.bool_]]:
        axial, lateral, radius = self._split_at_axis(x, y, z)
        theta, _ = self._solve_theta(axial, radius)
        kappa = self._compute_kappa(self._chi_from_theta(theta), axial, radius)
        axis_image = self._axis_image
        depth = axis_image[2] + kappa * dot(self.a, *lateral)
        u = (axis_image[0] + kappa * dot(self.h, *lateral)) / depth
        v = (axis_image[1] + kappa * dot(self.v, *lateral)) / depth
        return u, v, depth > 0

    def _compute_kappa(self, chi: Vector, axial: Vector, radius: Vector) -> Vector:
        """Compute kappa = f(chi) / radius, with its limit (1 + rho0) / axial on the axis."""
        (k1, k3, k5), tau = self._polynomial, chi * chi
        gain = k1 + tau * (k3 + tau * k5)
        return gain * np.where(radius > 0, chi / radius, 1 / axial)

    def _compute_gradients(self, x: Vector, y: Vector, z: Vector) -> tuple[Components, Components]:
        axial, lateral, radius = self._split_at_axis(x, y, z)
        theta, upsilon = self._solve_theta(axial, radius)
        chi = self._chi_from_theta(theta)
        kappa = self._compute_kappa(chi, axial, radius)
        (k1, k3, k5), tau = self._polynomial, chi * chi
        cosine = np.cos(self.linearity * theta)
        chi_slope = 1 / (cosine * cosine) if self.linearity > _ZERO_LINEARITY else cosine
        slope = (k1 + tau * (3 * k3 + tau * 5 * k5)) * chi_slope
        # kappa = f(chi) / radius, and d theta = (cos theta d radius - sin theta d axial) / upsilon
        # on the axis lambda is zero, and the gradient of kappa has no effect
        inverse = np.where(radius > 0, 1 / radius, 0.0)
        kappa_by_radius = (slope * np.cos(theta) / upsilon - kappa) * inverse
        kappa_by_axial = -slope * np.sin(theta) / upsilon * inverse
        kappa_x, kappa_y, kappa_z = (
            kappa_by_radius * lateral[i] * inverse + kappa_by_axial * self._axis[i] for i in range(3)
        )
        return self._radial_gradient(lateral, kappa, (kappa_x, kappa_y, kappa_z))

    def _compute_rays(self, u: Vector, v: Vector) -> tuple[Components, Vector | None]:
        axial, lateral, radius = self._split_at_axis(*self._compute_linear_directions(u, v))
        distorted_chi = radius / np.where(axial > 0, axial, np.nan)
        ratio = self._compute_undistortion_ratios(distorted_chi * distorted_chi)
        theta = self._theta_from_chi(distorted_chi * ratio)
        theta = np.where(theta < self._theta_limit, theta, np.nan)
        sine, cosine = np.sin(theta), np.cos(theta)
        lateral_scale = np.where(radius > 0, sine / radius, 0.0)
        x, y, z = (cosine * self._axis[i] + lateral_scale * lateral[i] for i in range(3))
        shift = np.where(theta > 0, theta / sine - 1, 0.0) * self._pupil_series(theta)[0]
        return (x, y, z), shift[:, np.newaxis] * self._axis
