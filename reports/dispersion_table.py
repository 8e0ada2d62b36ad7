"""Table of the dispersions of a campaign."""

from collections.abc import Mapping
from typing import Any

import pandas as pd
from pydantic import BaseModel

from marsyard.campaigns.definition.toml_models import description_at
from marsyard.reports.section import Grid
from marsyard.reports.stored import StoredRun, table
from marsyard.reports.wording import NOTHING, format_value
from marsyard.scenarios.columns import split_unit
from marsyard.scenarios.systems import scenario, scenario_names

#: Keys of a dispersion that are not parameters of its distribution.
_NON_PARAMETER_KEYS = ("distribution", "source", "unit", "description")


def dispersion_grid(run: StoredRun) -> Grid:
    """Create a table of the dispersions, with the minimum, mean and maximum of the stored values."""
    rows, model = [], _parameters_type(run)
    for path, entry in table(run.recorded("dispersions")).items():
        dispersion, path_parts = table(entry), str(path).split(".")
        statistics = [NOTHING] * 3
        if path in run.frame:
            values = pd.to_numeric(run.frame[path], errors="coerce").dropna()
            statistics[1] = f"{run.frame[path].nunique()} values"
            if len(values) and not pd.api.types.is_bool_dtype(run.frame[path].dtype):
                statistics = [format_value(float(value)) for value in (values.min(), values.mean(), values.max())]
                if path_parts[-1] == "terrain":
                    statistics[1] = NOTHING  # the mean of numbers of terrains has no meaning
        # defaults, which follow a semicolon, do not apply to dispersed parameters
        meaning = str(dispersion.get("description") or (model and description_at(model, str(path))) or NOTHING)
        meaning, unit = meaning.split(";")[0], split_unit(path_parts[-1])[1]
        meaning += f" ({unit})" if unit and not meaning.endswith(f", {unit}") else ""
        source = str(dispersion.get("source") or NOTHING)
        rows.append([meaning, str(path), _distribution_text(dispersion), *statistics, source])
    return Grid(["Quantity", "Parameter", "Distribution", "Minimum", "Mean", "Maximum", "Source"], rows)


def _distribution_text(dispersion: Mapping[str, Any]) -> str:
    """Describe a recorded distribution: ``uniform, 0.6 to 1.2``."""
    name = str(dispersion.get("distribution", "?"))
    items = {key: value for key, value in dispersion.items() if key not in _NON_PARAMETER_KEYS and value is not None}
    if name == "choice" and set(items) == {"values"}:
        return f"one of {', '.join(str(value) for value in items['values'])}"
    texts = [f"{items.pop('low')} to {items.pop('high')}"] if {"low", "high"} <= set(items) else []
    limits = items.pop("truncate", None)
    texts += [f"{'SD' if key == 'sd' else key.replace('_', ' ')} {value}" for key, value in items.items()]
    if limits is not None:
        texts.append(f"from {limits[0]} to {limits[1]}")
    return ", ".join((name, *texts))


def _parameters_type(run: StoredRun) -> type[BaseModel] | None:
    """Return the parameters of the run's scenario; None for a scenario that is not installed.

    A custom scenario is not imported: a report runs no code that a folder names.
    """
    name = str(run.recorded("scenario"))
    return scenario(name).parameters_type if name in scenario_names() else None
