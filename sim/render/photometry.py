"""How bright the ground looks: parameters of the reflectance law and the light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Sun:
    """Direct sunlight from one direction (unit vector towards the sun, world axes)."""

    direction: Float[np.ndarray, "3"]

    def __post_init__(self) -> None:
        if abs(float(np.linalg.norm(self.direction)) - 1.0) > 1e-9:
            raise ValueError(f"the sun's direction {self.direction} is not a unit vector")


@dataclass(frozen=True)
class Photometry:
    """A Lunar-Lambert surface with an opposition surge, under direct sun and an even sky.

    Radiance factor (I/F) of ground of albedo A under incidence i, emission e, phase angle g::

        I/F = A S(g) [2 L cos i / (cos i + cos e) + (1 - L) cos i] + A D (1 + n_z) / 2
        S(g) = (1 + B0 / (1 + tan(g / 2) / h)) / (1 + B0 / (1 + tan(g0 / 2) / h))

    The Lunar-Lambert law is that of McEwen (1991); the surge has the form of Hapke's shadow-hiding term (1986),
    normalised to 1 at phase g0 = 45 deg.

    Attributes
    ----------
    lunar_share
        L, between 0 (Lambert) and 1 (Lommel-Seeliger). About 0.55 for Mars at small phase (McEwen 1991).
    surge_amplitude, surge_width
        B0 and h.
    sky_share
        D, diffuse irradiance from the sky over the direct sun's on a plane facing it.
    sky_radiance
        Radiance factor of the sky, where a pixel sees no ground.
    """

    lunar_share: float = 0.55
    surge_amplitude: float = 0.7
    surge_width: float = 0.06
    sky_share: float = 0.15
    sky_radiance: float = 0.1
