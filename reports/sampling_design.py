"""Sampling design of a stored campaign: only independent random samples allow probability statements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool

from marsyard.campaigns.sampling.design import describe_design
from marsyard.campaigns.sampling.dispersions import list_sequences
from marsyard.reports.statistics.sequential import planned_looks, risk_fraction_at
from marsyard.reports.stored import table
from marsyard.reports.wording import count, format_fraction
from marsyard.scenarios.interface import HasRecordedCases
from marsyard.scenarios.systems import UnknownScenarioError, scenario, scenario_names


@dataclass(frozen=True)
class TerrainSupply:
    """Number of terrains that the cases of a campaign can use.

    - table_name: table of the parameters `bank` and `terrain`: `location` or `world`; empty in reports that lack it
    - key: parameter that sets this number: size of the terrain bank, or range of the dispersed terrain number
    - is_bank_size: whether this parameter is the size of the terrain bank
    - in_turn: whether the cases use the terrains in turn; otherwise terrains are drawn at random with replacement
    """

    terrains: int
    key: str
    is_bank_size: bool = False
    in_turn: bool = False
    table_name: str = ""

    def advice(self, min_terrains: int, probability: float, confidence: float) -> str:
        """Explain that the campaign needs at least `min_terrains` terrains, not more cases; state the options."""
        requirement = f"{format_fraction(probability)} at {format_fraction(confidence)} confidence"
        supply_text = f"{count(self.terrains, 'terrain')} ({self.key} = {self.terrains})"
        shortage = f"The campaign has only {supply_text}."
        if self.terrains >= min_terrains:
            shortage = (
                f"Terrains are drawn at random and can repeat, so the {supply_text} are unlikely to give as many."
            )
        options = f"--set {self.table_name}.bank={min_terrains}"
        if not self.in_turn or not self.is_bank_size:
            dispersion = f'{{distribution="in-turn",low=0,high={min_terrains - 1}}}'
            options += f" --set 'dispersions.\"{self.table_name}.terrain\"={dispersion}'"
        return (
            f"To show a success rate of {requirement}, the cases must include at least {min_terrains:,} different "
            f"terrains. {shortage} Run the campaign again with {min_terrains:,} cases, each on a terrain of its own: "
            f"{options} -n {min_terrains}."
        )


def read_terrain_supply(definition: Mapping[str, Any]) -> TerrainSupply | None:
    """Read the number of available terrains from a definition; None if unknown."""
    parameters, dispersions = table(definition.get("parameters")), table(definition.get("dispersions"))
    for table_name in ("location", "world"):
        bank = table(parameters.get(table_name)).get("bank")
        if not isinstance(bank, int):
            continue
        path = f"{table_name}.terrain"
        dispersion = table(dispersions.get(path))
        if not dispersion:
            return TerrainSupply(1, path, table_name=table_name)
        in_turn = dispersion.get("distribution") == "in-turn"
        low, high = dispersion.get("low"), dispersion.get("high")
        if isinstance(low, int) and isinstance(high, int):  # otherwise a formula of the bank's size
            key = f'dispersions."{path}"'
            return TerrainSupply(min(high - low + 1, bank), key, in_turn=in_turn, table_name=table_name)
        key = f"{table_name}.bank"
        return TerrainSupply(bank, key, is_bank_size=True, in_turn=in_turn, table_name=table_name)
    return None


#: Design with independent random cases.
RANDOM = "random"


@dataclass(frozen=True)
class SamplingDesign:
    """The sampling design of a campaign.

    - design: `random`, `latin-hypercube` or `sobol`
    - grids: paths of the parameters that were swept as a grid
    - sequences: paths of the parameters, other than terrains, whose values were used in turn
    - recorded: whether the cases are recorded, and not drawn
    - nominal: whether case 0 is the nominal case, with nominal parameters instead of sampled ones
    - max_cases: number of cases at the last look (planned evaluation) of a sequential campaign; otherwise None
    - first_look: number of cases at the first verdict if cases were appended after it; otherwise None
    - terrains: the terrains that the cases can use; None if unknown
    """

    design: str = RANDOM
    grids: tuple[str, ...] = ()
    nominal: bool = False
    max_cases: int | None = None
    first_look: int | None = None
    terrains: TerrainSupply | None = None
    sequences: tuple[str, ...] = ()
    recorded: bool = False

    @property
    def independent(self) -> bool:
        """Whether the cases, except the nominal one, are independent random samples."""
        return self.design == RANDOM and not self.grids and not self.sequences and not self.recorded

    @property
    def text(self) -> str:
        """The design in words."""
        return describe_design(self.design, self.grids, self.sequences, nominal=self.nominal)

    @property
    def no_probability_reason(self) -> str:
        """Explanation why the cases allow no probability statement; empty for independent random samples."""
        if self.independent:
            return ""
        if self.recorded:
            return "No probability statement: recorded cases are not random draws."
        steps = [] if self.design == RANDOM else ['set design.kind = "random"']
        paths = (*self.grids, *self.sequences)
        remedy = " and ".join([*steps, *(f"define a random distribution for '{path}'" for path in paths)])
        return (
            f"No probability statement: the design is {replace(self, nominal=False).text}, and "
            f"only independent random samples allow one. {remedy[:1].upper()}{remedy[1:]}, and run it again."
        )

    @property
    def with_open_end(self) -> SamplingDesign:
        """The design of a confirmation, which later confirmations extend.

        The open end changes all looks after the first, also those that `--until-decided` has planned: they use
        `SequentialTest`, which is valid for any number of looks.
        """
        if self.max_cases is None:
            return self
        return replace(self, max_cases=None, first_look=planned_looks(self.max_cases)[0].cases)

    def allowed_risk_fraction(self, cases: int) -> float:
        """Fraction of the risk of a wrong verdict (1 - confidence) that a look at `cases` cases may use."""
        return 1.0 if self.max_cases is None else risk_fraction_at(planned_looks(self.max_cases), cases)

    def mask_first_look(self, frame: pd.DataFrame) -> Bool[np.ndarray, " n"] | None:
        """Create the mask of the rows that an earlier first look used; None at the first look."""
        # planned looks (`max_cases`) have fractions of the risk instead
        if self.first_look is None or self.max_cases is not None or "case" not in frame:
            return None
        if not bool((frame["case"] >= self.first_look).any()):
            return None
        return np.asarray(frame["case"] < self.first_look, dtype=np.bool_)

    def exclude_nominal_case(self, frame: pd.DataFrame) -> pd.DataFrame:
        """Return the rows without the nominal case."""
        return frame if not self.nominal or "case" not in frame else frame[frame["case"] != 0].reset_index(drop=True)


#: Independent random samples, the default design.
INDEPENDENT = SamplingDesign()


def read_sampling_design(definition: Mapping[str, Any]) -> SamplingDesign:
    """Read the sampling design from the definition of a campaign; invalid values are treated as missing."""
    design = table(definition.get("design"))
    dispersions = table(definition.get("dispersions"))
    grids = tuple(str(path) for path, value in dispersions.items() if table(value).get("distribution") == "grid")
    limit = definition.get("max_cases")
    max_cases = limit if isinstance(limit, int) and not isinstance(limit, bool) and limit > 0 else None
    first_look = definition.get("cases") if definition.get("appended") else None
    return SamplingDesign(
        str(design.get("kind") or RANDOM),
        grids,
        design.get("nominal") is True,
        max_cases,
        first_look if isinstance(first_look, int) else None,
        read_terrain_supply(definition),
        list_sequences(dispersions),
        _has_recorded_cases(definition.get("scenario")),
    )


def _has_recorded_cases(name: object) -> bool:
    """Return whether a scenario has recorded cases; False for the name of an unknown scenario."""
    try:
        return name in scenario_names() and isinstance(scenario(str(name)), HasRecordedCases)
    except UnknownScenarioError:
        return False
