"""Consistency of the reported position covariance with the errors."""

from __future__ import annotations

import pandas as pd

from marsyard.reports.common_sections import evaluate_consistency
from marsyard.reports.rates import finite_values
from marsyard.reports.section import Block, Grid
from marsyard.reports.wording import number

#: Degrees of freedom: the components of the horizontal position.
_DEGREES_OF_FREEDOM = 2
#: Probability of the interval of the mean, and of the error ellipse.
_PROBABILITY = 0.9


def create_consistency_block(frame: pd.DataFrame) -> Block | None:
    """Compare the normalised squared errors (NEES) with the chi-square distribution with two degrees of freedom."""
    nees = finite_values(frame, "position_nees")
    if nees.size == 0:
        return None
    result = evaluate_consistency(nees, _DEGREES_OF_FREEDOM, _PROBABILITY)
    rows = [
        ["Descents with a final position", f"{nees.size:,}"],
        ["Mean of the normalised squared error", number(result["mean"])],
        [
            f"{100 * _PROBABILITY:.0f} % interval of this mean for a correct covariance",
            f"{result['lower']:.2f} to {result['upper']:.2f}",
        ],
        [f"Errors within the {100 * _PROBABILITY:.0f} % ellipse", f"{100.0 * result['inside']:.1f} %"],
    ]
    note = (
        "The normalised squared error is e' P^-1 e with the horizontal error e and its reported covariance P. Its mean "
        "is 2 for a correct covariance; larger values mean that the errors are larger than reported. The interval "
        "assumes independent descents."
    )
    data = {"nees": {name: result[name] for name in ("n", "mean", "lower", "upper", "inside")}}
    return Block(heading="Consistency of the covariance", grid=Grid(["", ""], rows), note=note, data=data)
