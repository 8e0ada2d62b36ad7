"""Number of terrains that the cases of a campaign can use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from marsyard.reports.stored import table
from marsyard.reports.wording import count, format_fraction


@dataclass(frozen=True)
class TerrainSupply:
    """Number of terrains that the cases of a campaign can use.

    - key: parameter that sets this number: size of the terrain bank, or range of the dispersed terrain number
    - in_turn: whether the cases use the terrains in turn; otherwise terrains are drawn at random with replacement
    """

    terrains: int
    key: str
    in_turn: bool = False

    def advice(self, min_terrains: int, probability: float, confidence: float) -> str:
        """Explain that the campaign needs at least `min_terrains` terrains, not more cases; state the options."""
        requirement = f"{format_fraction(probability)} at {format_fraction(confidence)} confidence"
        supply_text = f"{count(self.terrains, 'terrain')} ({self.key} = {self.terrains})"
        shortage = f"The campaign has only {supply_text}."
        if self.terrains >= min_terrains:
            shortage = (
                f"Terrains are drawn at random and can repeat, so the {supply_text} are unlikely to give as many."
            )
        # "location" or "world": table of the parameters `bank` and `terrain`
        table_name = self.key.removeprefix('dispersions."').partition(".")[0]
        options = f"--set {table_name}.bank={min_terrains}"
        if not self.in_turn or not self.key.endswith(".bank"):
            dispersion = f'{{distribution="in-turn",low=0,high={min_terrains - 1}}}'
            options += f" --set 'dispersions.\"{table_name}.terrain\"={dispersion}'"
        return (
            f"To show a success rate of {requirement}, the cases must include at least {min_terrains:,} different "
            f"terrains. {shortage} Run the campaign again with {min_terrains:,} cases, each on a terrain of its own: "
            f"{options} -n {min_terrains}."
        )


def read_terrain_supply(definition: Mapping[str, Any]) -> TerrainSupply | None:
    """Read the number of available terrains from a definition; None if unknown."""
    parameters, dispersions = table(definition.get("parameters")), table(definition.get("dispersions"))
    for name in ("location", "world"):
        bank = table(parameters.get(name)).get("bank")
        if not isinstance(bank, int):
            continue
        path = f"{name}.terrain"
        dispersion = table(dispersions.get(path))
        if not dispersion:
            return TerrainSupply(1, path)
        in_turn = dispersion.get("distribution") == "in-turn"
        low, high = dispersion.get("low"), dispersion.get("high")
        if isinstance(low, int) and isinstance(high, int):  # otherwise a formula of the bank's size
            return TerrainSupply(min(high - low + 1, bank), f'dispersions."{path}"', in_turn)
        return TerrainSupply(bank, f"{name}.bank", in_turn)
    return None
