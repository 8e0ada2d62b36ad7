"""Sampling design of a stored campaign: only independent random draws allow probability statements."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool

from marsyard.campaigns.sampling.design import describe_design
from marsyard.reports.statistics.proportions import planned_looks, spent_fraction
from marsyard.reports.stored import table
from marsyard.reports.wording import count, format_fraction

#: The design of cases that are drawn independently.
RANDOM = "random"


@dataclass(frozen=True)
class TerrainSupply:
    """The terrains that a campaign's cases can use.

    key: parameter that sets their number: size of the bank, or dispersion of the terrain's number
    in_turn: whether cases use them in turn; otherwise drawn with replacement
    """

    terrains: int
    key: str
    in_turn: bool = False

    def advice(self, fewest: int, probability: float, confidence: float) -> str:
        """Why further cases cannot help, and the change that does; `fewest` terrains are needed."""
        level = f"{format_fraction(probability)} at {format_fraction(confidence)} confidence"
        has = f"The campaign draws from {count(self.terrains, 'terrain')} ({self.key} = {self.terrains}); {level}"
        has = f"{has} takes at least {count(fewest, 'terrain')}"
        if not self.key.endswith(".bank"):
            return f"{has}: widen the range of {self.key}, and the bank, and run the campaign again."
        # random draws from ten times as many terrains rarely repeat: 1.1 cases per terrain suffice
        bank, cases = (fewest, fewest) if self.in_turn else (10 * fewest, math.ceil(1.1 * fewest))
        return f"{has}: run the campaign again with --set {self.key}={bank} -n {cases}."


@dataclass(frozen=True)
class SamplingDesign:
    """The sampling design of a campaign.

    design: `random`, `latin-hypercube` or `sobol`
    grids: paths of the parameters that were swept as a grid
    nominal: whether case 0 is the nominal one, without draws
    max_cases: cases of the last look of a sequential campaign; else None
    first_look: cases at the first verdict if cases were appended since; else None
    terrains: the terrains that the cases draw from; None if unknown
    """

    design: str = RANDOM
    grids: tuple[str, ...] = ()
    nominal: bool = False
    max_cases: int | None = None
    first_look: int | None = None
    terrains: TerrainSupply | None = None

    @property
    def independent(self) -> bool:
        """Whether the cases, the nominal one aside, are independent random draws."""
        return self.design == RANDOM and not self.grids

    @property
    def text(self) -> str:
        """The design in words."""
        return describe_design(self.design, self.grids, nominal=self.nominal)

    @property
    def no_probability(self) -> str:
        """Why the cases allow no probability statement; empty if they do."""
        if self.independent:
            return ""
        changes = [] if self.design == RANDOM else ['set design.kind = "random"']
        remedy = " and ".join([*changes, *(f"give '{path}' a distribution that is drawn" for path in self.grids)])
        return (
            f"No probability statement: the design is {describe_design(self.design, self.grids, nominal=False)}, and "
            f"only independent random draws carry one. {remedy[:1].upper()}{remedy[1:]}, and run it again."
        )

    def risk_share(self, cases: int) -> float:
        """Fraction of the risk that a look at so many cases may spend."""
        return 1.0 if self.max_cases is None else spent_fraction(planned_looks(self.max_cases), cases)

    def mask_first_look(self, frame: pd.DataFrame, chosen: pd.DataFrame) -> Bool[np.ndarray, " n"] | None:
        """Mask of the chosen rows of an earlier first look; None at the first look."""
        if self.first_look is None or self.max_cases is not None or "case" not in frame:
            return None
        if not bool((frame["case"] >= self.first_look).any()):
            return None
        return np.asarray(chosen["case"] < self.first_look, dtype=np.bool_)

    def draw(self, frame: pd.DataFrame) -> pd.DataFrame:
        """The rows without the nominal case."""
        if not self.nominal or "case" not in frame:
            return frame
        return frame[frame["case"] != 0].reset_index(drop=True)


#: Independent random draws, the default design.
INDEPENDENT = SamplingDesign()


def read_sampling_design(configuration: Mapping[str, Any]) -> SamplingDesign:
    """Read the sampling design from a configuration; invalid values count as missing."""
    design = table(configuration.get("design"))
    dispersions = table(configuration.get("dispersions"))
    grids = tuple(str(path) for path, one in dispersions.items() if table(one).get("distribution") == "grid")
    limit = configuration.get("max_cases")
    max_cases = limit if isinstance(limit, int) and not isinstance(limit, bool) and limit > 0 else None
    first = configuration.get("cases") if configuration.get("appended") else None
    return SamplingDesign(
        str(design.get("kind") or RANDOM),
        grids,
        design.get("nominal") is True,
        max_cases,
        first if isinstance(first, int) else None,
        terrain_supply(configuration),
    )


def terrain_supply(configuration: Mapping[str, Any]) -> TerrainSupply | None:
    """Read the terrains from a configuration; None if unknown."""
    parameters, dispersions = table(configuration.get("parameters")), table(configuration.get("dispersions"))
    for name in ("location", "world"):
        bank = table(parameters.get(name)).get("bank")
        if not isinstance(bank, int):
            continue
        path = f"{name}.terrain"
        drawn = table(dispersions.get(path))
        if not drawn:
            return TerrainSupply(1, path)
        in_turn = drawn.get("distribution") == "in-turn"
        low, high = drawn.get("low"), drawn.get("high")
        if isinstance(low, int) and isinstance(high, int) and high - low + 1 < bank:
            return TerrainSupply(high - low + 1, f'dispersions."{path}"', in_turn)
        return TerrainSupply(bank, f"{name}.bank", in_turn)
    return None
