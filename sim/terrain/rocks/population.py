"""Parameters of a rock population, and its size-frequency distribution."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field, model_validator

from marsyard.sim.parameters import Parameters, Positive

#: Largest number of rocks on one terrain; more are an error of the configuration.
MAX_ROCKS = 2_000_000


class PlacedRock(Parameters):
    """A rock at a stated position: a rover's target, a landing hazard."""

    name: Annotated[str, Field(min_length=1, description="what scenarios call it; unique on its terrain")]
    east_m: Annotated[float, Field(description="x of its centre, m, on the periodic terrain")]
    north_m: Annotated[float, Field(description="y of its centre, m, on the periodic terrain")]
    diameter_m: Annotated[float, Field(gt=0.0, le=50.0, description="mean of longest and shortest diameter, m")]
    height_m: Annotated[
        Positive | None, Field(description="height above the ground, m; by default half the diameter")
    ] = None
    shape: Annotated[
        int | None, Field(ge=0, description="its shape: 0 to 15 blocks from angular to rounded, 16 to 31 clinker")
    ] = None
    yaw_deg: Annotated[float | None, Field(description="turn about its vertical, deg; drawn where not given")] = None


class RockParameters(Parameters):
    """Rocks of a terrain: the size-frequency distribution of Golombek & Rapp (1997), and rocks at stated places.

    The share of the ground covered by rocks of at least diameter D is ``F_k(D) = k exp(-q D)``,
    ``q = 1.79 + 0.152 / k`` (D in metres), fitted to the Viking landing sites.
    The number of rocks per area and diameter follows: ``n(D) = -dF/dD / (pi D**2 / 4)``.
    """

    abundance: Annotated[float, Field(ge=0.0, le=0.4, description="k, share of the ground covered by all rocks")] = 0.05
    smallest_m: Annotated[Positive, Field(description="diameter of the smallest rocks that are made, m")] = 0.05
    largest_m: Annotated[Positive, Field(description="diameter of the largest, m")] = 3.0
    height_ratio: Annotated[
        float, Field(gt=0.0, le=1.0, description="mean height above the ground over diameter (Golombek & Rapp 1997)")
    ] = 0.5
    height_spread: Annotated[
        float, Field(ge=0.0, lt=1.0, description="half-width of its uniform spread, as a share of the mean")
    ] = 0.3
    form: Annotated[
        Literal["block", "clinker"], Field(description="blocks, angular to rounded, or the jagged clinker of a'a")
    ] = "block"
    placed: Annotated[tuple[PlacedRock, ...], Field(description="rocks at stated places")] = ()

    @model_validator(mode="after")
    def _check_consistency(self) -> RockParameters:
        if self.largest_m <= self.smallest_m:
            raise ValueError(f"largest_m is {self.largest_m:g}; it must be larger than smallest_m, {self.smallest_m:g}")
        names = [rock.name for rock in self.placed]
        duplicates = sorted({name for name in names if names.count(name) > 1})
        if duplicates:
            raise ValueError(f"more than one placed rock is called {', '.join(duplicates)}; names must be unique")
        return self


def decay_per_m(abundance: float) -> float:
    """q(k) of Golombek & Rapp (1997), 1/m."""
    return 1.79 + 0.152 / abundance


def _cumulative(
    abundance: float, smallest_m: float, largest_m: float
) -> tuple[Float64[np.ndarray, "grid"], Float64[np.ndarray, "grid"]]:
    """Diameters, and the number of smaller rocks per square metre, by Simpson's rule in the logarithm."""
    if abundance == 0.0:
        return np.array([smallest_m, largest_m]), np.zeros(2)
    diameter = np.geomspace(smallest_m, largest_m, 2001)
    step = np.log(largest_m / smallest_m) / 2000
    q = decay_per_m(abundance)

    def per_log(d: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
        return np.asarray(abundance * q * np.exp(-q * d) / (np.pi * d / 4.0))

    middle = np.sqrt(diameter[1:] * diameter[:-1])
    pieces = step / 6.0 * (per_log(diameter[:-1]) + 4.0 * per_log(middle) + per_log(diameter[1:]))
    return diameter, np.concatenate([[0.0], np.cumsum(pieces)])


def draw_diameters(parameters: RockParameters, area_m2: float, rng: np.random.Generator) -> Float64[np.ndarray, "n"]:
    """Draw the diameters of the rocks on an area, metres, the largest first; their number is Poisson.

    Raises ValueError where there would be more than `MAX_ROCKS`.
    """
    diameter, number = _cumulative(parameters.abundance, parameters.smallest_m, parameters.largest_m)
    expected = number[-1] * area_m2
    if expected > MAX_ROCKS:
        raise ValueError(
            f"{expected:.3g} rocks of at least {parameters.smallest_m:g} m on {area_m2:.3g} m2; at most "
            f"{MAX_ROCKS:g} can be made: choose a larger rocks.smallest_m"
        )
    quantile = rng.random(int(rng.poisson(expected)))
    drawn = np.exp(np.interp(quantile * number[-1], number, np.log(diameter)))
    return np.asarray(np.sort(drawn)[::-1])
