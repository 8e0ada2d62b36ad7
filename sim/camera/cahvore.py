"""CAHVORE: CAHVOR for wide angles, with a moving entrance pupil (Gennery 2006, sections 3 to 5)."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from marsyard.sim.camera.cahv import Cahv
from marsyard.sim.camera.cahvor import RadialModel
from marsyard.sim.camera.vectors import Gradient, Real, Triple, Vector, dot

_NEWTON_STEPS = 30
#: A linearity nearer to 0 than this is 0, as in cmod.
_LINEAR = 1e-15


@final
@dataclass(frozen=True, eq=False)
class Cahvore(RadialModel):
    """A wide-angle camera whose entrance pupil moves along the optical axis.

    A ray that makes the angle theta with O starts at C + s O, with
    s = (theta / sin theta - 1) (e0 + e1 theta^2 + e2 theta^4). Its "distance" from the axis, L being the linearity, is

        chi = tan(L theta) / L   (L > 0; L = 1 is a perspective lens)
        chi = theta              (L = 0, an equidistant fisheye)
        chi = sin(L theta) / L   (L < 0; L = -1 is orthographic)

    It is moved to (1 + rho0) chi + rho1 chi^3 + rho2 chi^5 and projected linearly. Points outside the range in which
    this is one-to-one, or so near that the pupil's motion leaves no ray or several, are not visible.

    Attributes
    ----------
    c, a, h, v, size
        See `CameraModel`; C is the entrance pupil for rays along the axis.
    o, r
        As for `Cahvor`.
    e
        (e0, e1, e2) of the pupil's motion, metres, shape (3,).
    linearity
        L, from -1 to 1.

    Raises
    ------
    ValueError
        As `Cahvor`; or if the linearity is not from -1 to 1.
    """

    c: Float[np.ndarray, "3"]
    a: Float[np.ndarray, "3"]
    h: Float[np.ndarray, "3"]
    v: Float[np.ndarray, "3"]
    o: Float[np.ndarray, "3"]
    r: Float[np.ndarray, "3"]
    e: Float[np.ndarray, "3"]
    linearity: Real = field(kw_only=True)
    size: tuple[int, int] = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "linearity", float(self.linearity) + 0.0)
        if not -1 <= self.linearity <= 1:
            raise ValueError(f"linearity must lie between -1 and 1, not {self.linearity!r}")

    @classmethod
    def from_cahv(
        cls, cahv: Cahv, r: Triple, e: Triple = (0.0, 0.0, 0.0), *, linearity: Real, o: Triple | None = None
    ) -> Cahvore:
        """A linear camera's image plane behind a wide-angle lens, about the unit vector `o` (A if not given)."""
        axis = cahv.a if o is None else np.asarray(o, dtype=np.float64)
        radial, pupil = np.asarray(r, dtype=np.float64), np.asarray(e, dtype=np.float64)
        return cls(cahv.c, cahv.a, cahv.h, cahv.v, axis, radial, pupil, linearity=linearity, size=cahv.size)

    # ----- the lens: angle theta, "distance" chi, shift of the pupil -----

    @cached_property
    def _theta_limit(self) -> float:
        """Angle from the axis up to which the lens is one-to-one, radians."""
        chi = np.sqrt(self._polynomial.tau_limit)
        return min(float(self._theta(np.array([chi]))[0]), np.pi)

    def _chi(self, theta: Vector) -> Vector:
        scale = self.linearity
        if scale > _LINEAR:
            return np.tan(scale * theta) / scale
        return np.sin(scale * theta) / scale if scale < -_LINEAR else theta

    def _chi_slope(self, theta: Vector) -> Vector:
        cosine = np.cos(self.linearity * theta)
        return 1 / (cosine * cosine) if self.linearity > _LINEAR else cosine

    def _theta(self, chi: Vector) -> Vector:
        """The inverse of `_chi`; at the end of its range, or beyond it, the angle at the end."""
        scale = self.linearity
        if scale > _LINEAR:
            return np.arctan(scale * chi) / scale
        return np.arcsin(np.maximum(scale * chi, -1)) / scale if scale < -_LINEAR else chi

    def _pupil(self, theta: Vector) -> tuple[Vector, Vector]:
        """e0 + e1 theta^2 + e2 theta^4 and its derivative."""
        square = theta * theta
        series = self.e[0] + square * (self.e[1] + square * self.e[2])
        return series, theta * (2 * self.e[1] + 4 * self.e[2] * square)

    def _angle(self, along: Vector, across: Vector) -> tuple[Vector, Vector]:
        """Angle theta of the ray through a point `along` the axis and `across` from it (NaN: none), and upsilon.

        Newton on along sin theta - across cos theta - (theta - sin theta) (e0 + e1 theta^2 + e2 theta^4) = 0.
        """
        theta = np.arctan2(across, along)
        upsilon = step = np.zeros_like(theta)
        for _ in range(_NEWTON_STEPS):
            sine, cosine = np.sin(theta), np.cos(theta)
            series, slope = self._pupil(theta)
            lag = theta - sine
            upsilon = along * cosine + across * sine - (1 - cosine) * series - lag * slope
            step = (along * sine - across * cosine - lag * series) / upsilon
            theta = theta - step
            if not np.any(np.abs(step) > 1e-9):  # the error is of the step's square
                break
        solved = (np.abs(step) <= 1e-9) & (upsilon > 0) & (theta >= 0) & (theta < self._theta_limit)
        return np.where(solved, theta, np.nan), upsilon

    # ----- the model -----

    def _image(self, x: Vector, y: Vector, z: Vector) -> tuple[Vector, Vector, NDArray[np.bool_]]:
        along, off = self._off_axis(x, y, z)
        across = np.sqrt(off[0] * off[0] + off[1] * off[1] + off[2] * off[2])
        theta, _ = self._angle(along, across)
        kappa = self._kappa(self._chi(theta), along, across)
        onto = self._axis_image
        depth = onto[2] + kappa * dot(self.a, *off)
        u = (onto[0] + kappa * dot(self.h, *off)) / depth
        v = (onto[1] + kappa * dot(self.v, *off)) / depth
        return u, v, depth > 0

    def _kappa(self, chi: Vector, along: Vector, across: Vector) -> Vector:
        tau = chi * chi
        gain = self._polynomial.k1 + tau * (self._polynomial.k3 + tau * self._polynomial.k5)
        return gain * np.where(across > 0, chi / across, 1 / along)

    def _image_gradient(self, x: Vector, y: Vector, z: Vector) -> tuple[Gradient, Gradient]:
        along, off = self._off_axis(x, y, z)
        across = np.sqrt(off[0] * off[0] + off[1] * off[1] + off[2] * off[2])
        theta, upsilon = self._angle(along, across)
        chi = self._chi(theta)
        kappa = self._kappa(chi, along, across)
        tau = chi * chi
        polynomial = self._polynomial
        slope = (polynomial.k1 + tau * (3 * polynomial.k3 + tau * 5 * polynomial.k5)) * self._chi_slope(theta)
        # kappa = f(chi) / across; on the axis lambda vanishes and with it all that kappa's gradient does
        inverse = np.where(across > 0, 1 / across, 0.0)
        by_across = (slope * np.cos(theta) / upsilon - kappa) * inverse
        by_along = -slope * np.sin(theta) / upsilon * inverse
        kappa_x, kappa_y, kappa_z = (by_across * off[i] * inverse + by_along * self._axis[i] for i in range(3))
        return self._radial_gradient(off, kappa, (kappa_x, kappa_y, kappa_z))

    def _sight(self, u: Vector, v: Vector) -> tuple[Gradient, Vector | None]:
        along, off = self._off_axis(*self._image_plane_direction(u, v))
        along = np.where(along > 0, along, np.nan)
        across = np.sqrt(off[0] * off[0] + off[1] * off[1] + off[2] * off[2])
        distorted = across / along
        theta = self._theta(distorted * self._polynomial.undistortion(distorted * distorted))
        theta = np.where(theta < self._theta_limit, theta, np.nan)
        sine, cosine = np.sin(theta), np.cos(theta)
        outward = np.where(across > 0, sine / across, 0.0)
        x, y, z = (cosine * self._axis[i] + outward * off[i] for i in range(3))
        shift = np.where(theta > 0, theta / sine - 1, 0.0) * self._pupil(theta)[0]
        return (x, y, z), shift
