"""Selection of columns for sections: metric, its signed components, conditions that affect it, and categories."""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from marsyard.reports.column_values import is_number, numbers
from marsyard.reports.statistics.drivers import explained_fraction
from marsyard.scenarios.columns import split_unit

_AXES = ("x", "y", "z")
#: Pattern of columns that describe the run or the results, in scenarios that do not declare their columns.
_EXCLUDED_COLUMNS = re.compile(
    r"time|hash|^case$|^outcome$|^answered$|^error$|^traceback$|^gl_|^processor|version|host|estimated|_true_"
    r"|^firing_|^touchdown_|^site_|^fault_size$|^update_\d|^(range|cross|worst)_error|^drift|^false_|^lost_"
    r"|\.|^algorithm$|^stderr$|^velocity_(?:nees|normalised|sd|correlation)"
)
#: Prefixes of the condition columns that `driver_columns` lists first.
_PREFERRED_DRIVERS = (
    "off_nadir_max", "attitude_rate_max", "altitude_1", "horizontal_speed", "sun_elevation", "slip_mean",
    "pose_error_fraction", "rock_diameter", "disparity_error_goal",
)  # fmt: skip
#: Maximum number of distinct values of a column that divides the cases into categories.
_MAX_CATEGORIES = 6


def axis_columns(metric: str, columns: Sequence[str]) -> list[str]:
    """List the signed components of a metric among the columns: ``velocity_error_x_m_s`` for ``velocity_error_m_s``."""
    name, _ = split_unit(metric)
    ending = metric[len(name) :]
    return [part for axis in _AXES if (part := f"{name}_{axis}{ending}") in columns]


def primary_metric(frame: pd.DataFrame, requirements: Sequence[Mapping[str, Any]]) -> str | None:
    """Return the page's metric: the first numeric metric of a requirement, else the first error column, else None."""
    requirement_metrics = [str(requirement.get("metric", "")) for requirement in requirements]
    error_columns = [str(column) for column in frame.columns if "error_" in str(column) and split_unit(str(column))[1]]
    names = (*requirement_metrics, *error_columns)
    return next((name for name in names if name in frame and is_number(frame, name)), None)


def looks_like_condition(name: str) -> bool:
    """Whether the name of a column, of a scenario that declares none, does not look like a result."""
    return not _EXCLUDED_COLUMNS.search(name)


def condition_columns(
    frame: pd.DataFrame, metric: str, is_condition: Callable[[str], bool] = looks_like_condition
) -> list[str]:
    """List the conditions that vary, without terrains, the metric and its components.

    A sampled value that a column of the scenario repeats is not listed again.
    """
    names = [str(name) for name in frame.columns]
    terrains = [name for name in names if name.rpartition(".")[2] == "terrain"]
    excluded_names = {metric, *axis_columns(metric, names), *terrains}
    candidates = [
        name
        for name in names
        if name not in excluded_names and is_condition(name) and is_number(frame, name) and frame[name].nunique() > 1
    ]
    return distinct_columns(frame, candidates)


def driver_columns(
    frame: pd.DataFrame, metric: str, max_columns: int = 6, is_condition: Callable[[str], bool] = looks_like_condition
) -> list[str]:
    """Select conditions that may affect a metric: `_PREFERRED_DRIVERS` first, then by the explained variance."""
    candidates = condition_columns(frame, metric, is_condition)
    preferred_names = [name for prefix in _PREFERRED_DRIVERS for name in candidates if name.startswith(prefix)]
    magnitude = np.abs(numbers(frame, metric))
    others = sorted(
        (name for name in candidates if name not in preferred_names),
        key=lambda name: -explained_fraction(numbers(frame, name), magnitude),
    )
    return [*preferred_names, *others][:max_columns]


def distinct_columns(frame: pd.DataFrame, names: Sequence[str]) -> list[str]:
    """Remove sampled values that equal another column; their names are paths of parameters."""
    others = [numbers(frame, name) for name in names if "." not in name]
    known = np.array(others).reshape(len(others), len(frame))
    return [
        name
        for name in names
        if "." not in name or not np.isclose(known, numbers(frame, name), rtol=1e-9, equal_nan=True).all(axis=1).any()
    ]


def category_column(frame: pd.DataFrame) -> str | None:
    """Return the first column with 2 to 6 distinct values: a column of text, or the terrain; None if there is none."""
    types = {str(name): dtype for name, dtype in frame.dtypes.items() if not _EXCLUDED_COLUMNS.search(str(name))}
    # pandas stores text as a type of its own, or as objects
    names = [
        name
        for name, dtype in types.items()
        if pd.api.types.is_string_dtype(dtype) or pd.api.types.is_object_dtype(dtype)
    ]
    names += ["terrain"] if "terrain" in frame else []
    return next((name for name in names if 2 <= frame[name].nunique() <= _MAX_CATEGORIES), None)
