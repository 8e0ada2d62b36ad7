"""How a campaign's cases were drawn, and what may be said of them: only independent draws carry a probability."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from campaigns.sampling.design import said_of
from reports.statistics.sequential import looks_of, spent_share
from reports.stored import table

#: The design of cases that are drawn independently.
RANDOM = "random"


@dataclass(frozen=True)
class Sampled:
    """How cases were laid out.

    Attributes
    ----------
    design
        `random`, `latin-hypercube` or `sobol`.
    grids
        Paths of the parameters that were swept as a grid.
    nominal
        Whether case 0 is the nominal one, which nothing was drawn for.
    most_cases
        Cases of the last look at a campaign that stops itself when it is decided; None where it does not.
    """

    design: str = RANDOM
    grids: tuple[str, ...] = ()
    nominal: bool = False
    most_cases: int | None = None

    @property
    def independent(self) -> bool:
        """Whether the cases, the nominal one aside, are independent random draws."""
        return self.design == RANDOM and not self.grids

    @property
    def text(self) -> str:
        """How the cases were laid out, in words."""
        return said_of(self.design, self.grids, nominal=self.nominal)

    @property
    def no_probability(self) -> str:
        """Why the cases carry no probability statement; empty where they do."""
        if self.independent:
            return ""
        return (
            f"No probability statement: the design is {said_of(self.design, self.grids, nominal=False)}, and only "
            "independent random draws carry one."
        )

    def risk_share(self, cases: int) -> float:
        """Which share of the risk that a confidence leaves may be spent on a judgement of so many cases."""
        return 1.0 if self.most_cases is None else spent_share(looks_of(self.most_cases), cases)

    def drawn(self, frame: pd.DataFrame) -> pd.DataFrame:
        """The rows of the cases that were drawn: all but the nominal one."""
        if not self.nominal or "case" not in frame:
            return frame
        return frame[frame["case"] != 0].reset_index(drop=True)


#: Independent random draws, as of campaigns that state no design.
INDEPENDENT = Sampled()


def sampled(configuration: Mapping[str, Any]) -> Sampled:
    """How the cases of a stored campaign were drawn, by its configuration; anything odd in it counts as not stated."""
    design = table(configuration.get("design"))
    dispersions = table(configuration.get("dispersions"))
    grids = tuple(str(path) for path, one in dispersions.items() if table(one).get("distribution") == "grid")
    most = configuration.get("most_cases")
    most_cases = most if isinstance(most, int) and not isinstance(most, bool) and most > 0 else None
    return Sampled(str(design.get("kind") or RANDOM), grids, design.get("nominal") is True, most_cases)
