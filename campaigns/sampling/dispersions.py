"""Every dispersion that a campaign's file may state: our own by their names, others by theirs in `scipy.stats`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any, Self

from pydantic import ConfigDict, Discriminator, Field, Tag, field_validator, model_validator

from marsyard.campaigns.errors import near_match
from marsyard.campaigns.sampling.dispersion import Dispersion
from marsyard.campaigns.sampling.levels import Choice, Derived, Fixed, Grid
from marsyard.campaigns.sampling.ranges import Integer, InTurn, Normal, Uniform
from marsyard.campaigns.sampling.shapes import Frozen, Shape, parameters_of, scipy_distributions, truncated_quantile
from marsyard.campaigns.sampling.stated import Limits, Number, limits_of


class Scipy(Dispersion):
    """A distribution of `scipy.stats` by its name there, with its parameters and cut to `truncate`.

    Discrete ones (`poisson`, `binom`, ...) give whole numbers; their limits are included.
    """

    model_config = ConfigDict(extra="allow", frozen=True)
    __pydantic_extra__: dict[str, Number] = Field(init=False)

    distribution: str
    truncate: Limits | None = None

    @field_validator("distribution")
    @classmethod
    def _known(cls, name: str) -> str:
        names = scipy_distributions()
        if name not in names:
            hint = near_match(name, [*FRIENDLY, *names])
            raise ValueError(
                f"unknown distribution '{name}'{hint}; allowed: {', '.join(FRIENDLY)}, "
                "or a distribution of one variable of scipy.stats by its name there (norm, beta, poisson, ...)"
            )
        return name

    @model_validator(mode="after")
    def _drawable(self) -> Self:
        given = self.__pydantic_extra__ or {}
        required, allowed = parameters_of(self.distribution)
        problems = [f"unknown parameter '{name}'{near_match(name, allowed)}" for name in given if name not in allowed]
        problems += [f"parameter '{name}' is missing" for name in required if name not in given]
        if problems:
            raise ValueError(f"{', '.join(problems)}; {self.distribution} takes {', '.join(allowed)}")
        if not self.formulas:
            truncated_quantile(self._shape, limits_of(self.truncate), 0.5)
        return self

    @property
    def continuous(self) -> bool:  # type: ignore[override]  # known only with the distribution's name
        """Whether it is a density's."""
        return not scipy_distributions()[self.distribution]

    @cached_property
    def _shape(self) -> Shape:
        stated = {name: float(value) for name, value in (self.__pydantic_extra__ or {}).items()}
        return Frozen(self.distribution, stated)

    def quantile(self, probability: float) -> float | int:
        """See `Dispersion.quantile`."""
        return truncated_quantile(self._shape, limits_of(self.truncate), probability)

    def bounds(self) -> tuple[float, float] | None:
        """See `Dispersion.bounds`."""
        if self.formulas:
            return None
        low, high = self._shape.support()
        limits = limits_of(self.truncate) or (-math.inf, math.inf)
        return max(low, limits[0]), min(high, limits[1])


#: The distributions with their own names and parameters; every other name is looked up in `scipy.stats`.
FRIENDLY: Mapping[str, type[Dispersion]] = {
    "uniform": Uniform,
    "normal": Normal,
    "choice": Choice,
    "integer": Integer,
    "in-turn": InTurn,
    "fixed": Fixed,
    "derived": Derived,
    "grid": Grid,
}


def _kind(stated: Any) -> str:
    """The model that reads a dispersion: by its name, `scipy` where it is none of ours."""
    name = stated.get("distribution") if isinstance(stated, Mapping) else getattr(stated, "distribution", None)
    return name if isinstance(name, str) and name in FRIENDLY else "scipy"


AnyDispersion = Annotated[
    Annotated[Uniform, Tag("uniform")]
    | Annotated[Normal, Tag("normal")]
    | Annotated[Choice, Tag("choice")]
    | Annotated[Integer, Tag("integer")]
    | Annotated[InTurn, Tag("in-turn")]
    | Annotated[Fixed, Tag("fixed")]
    | Annotated[Derived, Tag("derived")]
    | Annotated[Grid, Tag("grid")]
    | Annotated[Scipy, Tag("scipy")],
    Discriminator(_kind),
]
