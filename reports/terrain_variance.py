"""Share of a metric's variance that lies between terrains."""

from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from marsyard.reports import populations, rates
from marsyard.reports.column_values import numbers


def terrain_variance(frame: pd.DataFrame, column: str) -> dict[str, Any] | None:
    """Analyse the variance of an error column with terrains as random effects; None without repeated terrains.

    Keys: `part` (the column), `terrains` (their number), `within_sd` of errors within a terrain, `between_sd` of the
    terrains' means, `fraction` of the variance between terrains (intraclass correlation), `p_value` of equal means
    (F-test).
    """
    groups = rates.terrain_groups(frame)
    values = numbers(frame, column)
    finite = np.isfinite(values) & populations.population_mask(frame, "valid")
    if groups is None or not finite.any():
        return None
    _, index = np.unique(groups[finite], return_inverse=True)
    errors, sizes = values[finite], np.bincount(index).astype(np.float64)
    cases, terrains = errors.size, sizes.size
    if terrains < 2 or cases == terrains:
        return None
    means = np.bincount(index, weights=errors) / sizes
    # mean squares; the expectation of `between` is `within` + effective_size * (variance between terrains)
    within = float(((errors - means[index]) ** 2).sum()) / (cases - terrains)
    between = float((sizes * (means - errors.mean()) ** 2).sum()) / (terrains - 1)
    # effective number of cases per terrain, for terrains with unequal numbers of cases
    effective_size = (cases - float((sizes**2).sum()) / cases) / (terrains - 1)
    variance_between = max(between - within, 0.0) / effective_size
    p_value = float(stats.f.sf(between / within, terrains - 1, cases - terrains)) if within > 0.0 else float("nan")
    return {
        "part": column,
        "terrains": terrains,
        "within_sd": float(np.sqrt(within)),
        "between_sd": float(np.sqrt(variance_between)),
        "fraction": variance_between / (variance_between + within) if variance_between + within > 0.0 else 0.0,
        "p_value": p_value,
    }
