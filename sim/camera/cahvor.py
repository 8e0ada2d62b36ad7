"""CAHVOR: CAHV with radial distortion about an optical axis (Gennery 2001; 2006, section 2)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from marsyard.sim.camera import kernels
from marsyard.sim.camera.base import UNIT_TOLERANCE, CameraModel
from marsyard.sim.camera.cahv import Cahv
from marsyard.sim.camera.radial import RadialPolynomial
from marsyard.sim.camera.vectors import Gradient, Triple, Vector, dot


class RadialModel(CameraModel):
    """What CAHVOR and CAHVORE share: an optical axis O, and the point moved radially from it before the image is taken.

    The image of P is that of the direction O + kappa lambda, where lambda is the part of P - C perpendicular to O: all
    that the models differ in is kappa.
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
            raise ValueError(
                f"r must begin with a number above -1 (1 + r[0] scales the image), not {float(self.r[0])!r}"
            )

    @cached_property
    def _axis(self) -> NDArray[np.float64]:
        """O to full length: labels round it to six digits, and lambda is perpendicular only to a unit vector."""
        return np.asarray(self.o / np.linalg.norm(self.o))

    @property
    def _pupil_axis(self) -> NDArray[np.float64]:
        return self._axis

    @cached_property
    def _axis_image(self) -> tuple[float, float, float]:
        """(O.H, O.V, O.A)."""
        return float(self._axis @ self.h), float(self._axis @ self.v), float(self._axis @ self.a)

    @cached_property
    def _polynomial(self) -> RadialPolynomial:
        return RadialPolynomial(1 + float(self.r[0]), float(self.r[1]), float(self.r[2]))

    def _off_axis(self, x: Vector, y: Vector, z: Vector) -> tuple[Vector, Gradient]:
        """Distance along O and the vector lambda perpendicular to it."""
        along = dot(self._axis, x, y, z)
        return along, (x - along * self._axis[0], y - along * self._axis[1], z - along * self._axis[2])

    def _radial_gradient(self, off: Gradient, kappa: Vector, kappa_gradient: Gradient) -> tuple[Gradient, Gradient]:
        """Gradients of the pixel of O + kappa lambda, from kappa's."""
        across = [dot(vector, *off) for vector in (self.h, self.v, self.a)]
        onto = self._axis_image
        depth = onto[2] + kappa * across[2]

        def gradient(k: int, vector: NDArray[np.float64]) -> Gradient:
            pixel = (onto[k] + kappa * across[k]) / depth
            slope = (across[k] - pixel * across[2]) / depth
            x, y, z = (
                kappa * ((vector[i] - onto[k] * self._axis[i]) - pixel * (self.a[i] - onto[2] * self._axis[i])) / depth
                + slope * kappa_gradient[i]
                for i in range(3)
            )
            return x, y, z

        return gradient(0, self.h), gradient(1, self.v)


@final
@dataclass(frozen=True, eq=False)
class Cahvor(RadialModel):
    """A camera with radial distortion.

    A point P is moved to P' = P + mu lambda before the linear projection, with omega = (P - C).O,
    lambda = P - C - omega O, tau = lambda.lambda / omega^2 and mu = rho0 + rho1 tau + rho2 tau^2. Points beyond the tau
    at which the distance (1 + mu) sqrt(tau) from the axis stops growing are not visible.

    Attributes
    ----------
    c, a, h, v, size
        See `CameraModel`.
    o
        Unit vector O of the optical axis, shape (3,). Its direction alone is used.
    r
        (rho0, rho1, rho2), shape (3,).

    Raises
    ------
    ValueError
        As `Cahv`; or if O is not a unit vector or does not look to A's side, or rho0 <= -1.
    """

    c: Float[np.ndarray, "3"]
    a: Float[np.ndarray, "3"]
    h: Float[np.ndarray, "3"]
    v: Float[np.ndarray, "3"]
    o: Float[np.ndarray, "3"]
    r: Float[np.ndarray, "3"]
    size: tuple[int, int]

    @classmethod
    def from_cahv(cls, cahv: Cahv, r: Triple, o: Triple | None = None) -> Cahvor:
        """A linear camera with distortion `r` (rho0, rho1, rho2) added about the unit vector `o` (A if not given)."""
        axis = cahv.a if o is None else np.asarray(o, dtype=np.float64)
        return cls(cahv.c, cahv.a, cahv.h, cahv.v, axis, np.asarray(r, dtype=np.float64), cahv.size)

    def _image(self, x: Vector, y: Vector, z: Vector) -> tuple[Vector, Vector, NDArray[np.bool_]]:
        image: tuple[Vector, Vector, NDArray[np.bool_]] = kernels.radial_image(
            (x, y, z), self._axis, (self.h, self.v, self.a), self._axis_image, self.r, self._polynomial.tau_limit
        )
        return image

    def _image_gradient(self, x: Vector, y: Vector, z: Vector) -> tuple[Gradient, Gradient]:
        omega = dot(self._axis, x, y, z)
        tau = np.maximum((x * x + y * y + z * z) / (omega * omega) - 1, 0)
        kappa = (1 + (self.r[0] + tau * (self.r[1] + tau * self.r[2]))) / omega
        mu_slope = (self.r[1] + 2 * self.r[2] * tau) * 2 / omega**3
        along, off = self._off_axis(x, y, z)
        # d tau = 2 (lambda / omega^2 - tau / omega O).dP, because lambda is perpendicular to O
        kappa_x, kappa_y, kappa_z = (
            mu_slope * (off[i] - tau * omega * self._axis[i]) - kappa / along * self._axis[i] for i in range(3)
        )
        return self._radial_gradient(off, kappa, (kappa_x, kappa_y, kappa_z))

    def _sight(self, u: Vector, v: Vector) -> tuple[Gradient, Vector | None]:
        polynomial = self._polynomial
        sight: Gradient = kernels.radial_sight(
            u, v, self._direction_from_pixel, self._axis, polynomial.coefficients, polynomial.limits
        )
        return sight, None
