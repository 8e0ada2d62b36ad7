"""Analytic grounds for rover tests, on which the pose of a rover at rest has a closed form: planes and mounds."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from marsyard.sim.dynamics.driving import SlipParameters

#: Wheels that follow their commands exactly.
NO_SLIP = SlipParameters(
    flat=0.0, full_slope_deg=89.0, exponent=100.0, downhill=0.0, across=0.0, turn=0.0, turn_slope=0.0,
    soil_spread=0.0, step_spread=0.0, wander_deg_m=0.0,
)  # fmt: skip


@dataclass(frozen=True)
class Plane:
    """A plane with a height at the origin and the slopes dz/dx (east) and dz/dy (north)."""

    slope_east: float = 0.0
    slope_north: float = 0.0
    height_m: float = 0.0

    def height(self, x: Float[np.ndarray, "*batch"], y: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        return self.height_m + self.slope_east * x + self.slope_north * y


@dataclass(frozen=True)
class Mounds:
    """Level ground with mounds (x, y, height), m; a top is flat up to a radius of 0.2 m, the slope ends at 0.3 m."""

    mounds: tuple[tuple[float, float, float], ...]

    def height(self, x: Float[np.ndarray, "*batch"], y: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        ground = np.zeros(np.broadcast_shapes(x.shape, y.shape))
        for east, north, mound_height in self.mounds:
            distance = np.hypot(x - east, y - north)
            ground = ground + mound_height * np.clip((0.3 - distance) / 0.1, 0.0, 1.0)
        return ground


def uphill_east(slope_deg: float) -> Plane:
    """Return a plane that rises to the east."""
    return Plane(float(np.tan(np.radians(slope_deg))))
