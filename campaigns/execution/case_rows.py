"""Rows of cases: the columns of finished and unfinished cases, checked so that they can be stored and evaluated."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from marsyard.campaigns.definition.campaign_file import Requirement
from marsyard.campaigns.definition.parameter_paths import leaves
from marsyard.campaigns.hidden_folders import hide_folders
from marsyard.campaigns.outcomes import ENGINE_FAILURES
from marsyard.campaigns.store.rows import LEADING_COLUMNS, TRAILING_COLUMNS, Row
from marsyard.scenarios.interface import CaseResult, Scalar

#: Maximum bit length of stored integers: a float64 is below 2 ** 1024.
_MAX_INT_BITS = 1023
#: Maximum characters of an error's text, or of a traceback, in a row; the middle of a longer text is omitted.
_MAX_TEXT = 8000


def list_draws(values: Mapping[str, Any]) -> dict[str, Scalar]:
    """List the sampled values of a case by parameter path, the values of a table by their own paths."""
    return _convert_columns({path: value for path, value in leaves(dict(values)) if value is not None and value != []})


def make_unfinished_row(
    case: int, outcome: str, error: str, trace: str, draws: Mapping[str, Scalar] | None = None
) -> Row:
    """Create the row of an unfinished case, with its sampled values."""
    return {
        "case": case,
        "outcome": outcome,
        "answered": False,
        **(draws or {}),
        "error": _clean_text(error),
        "traceback": _clean_text(trace),
    }


def _clean_text(text: str) -> str:
    """Shorten a text; remove lone surrogates, and object addresses and folders, which change from run to run."""
    text = hide_folders(text)
    if len(text) > _MAX_TEXT:
        half = _MAX_TEXT // 2
        text = f"{text[:half]}\n... {len(text) - 2 * half} characters omitted ...\n{text[-half:]}"
    text = re.sub(r"\b0x[0-9a-fA-F]{4,}\b", "0x...", text)
    return _replace_surrogates(text)


def make_finished_row(
    case: int, result: CaseResult, draws: Mapping[str, Scalar], requirements: Sequence[Requirement]
) -> Row:
    """Create the row of a finished case, in plain Python values.

    A column of the scenario takes precedence over a sampled value of this name, which shows that it applied.
    Raises TypeError or ValueError if a column cannot be stored, or if a metric or population column has a wrong type.
    One value of a wrong type would convert the stored column to text, so that the requirement could not be evaluated.
    """
    failure = result.failure
    if (result.outcome in ENGINE_FAILURES) != (failure is not None):
        raise ValueError(f"the outcome {result.outcome} is reserved for cases that do not finish")
    columns = {**draws, **_convert_columns(result.row)}
    for requirement in requirements:
        metrics, has_bound = requirement.metric_columns, requirement.bound is not None
        for name in (*requirement.population_columns, *(() if has_bound else metrics)):
            if type(columns.get(name, True)) is not bool:
                raise TypeError(f"column {name} contains {columns[name]!r:.100}; {requirement.id} needs true or false")
        for name in metrics if has_bound else ():
            if type(columns.get(name, 0.0)) is str:
                raise TypeError(f"column {name} contains {columns[name]!r:.100}; {requirement.id} needs a number")
    error, trace = ("", "") if failure is None else (_clean_text(failure.error), _clean_text(failure.trace))
    engine_columns: Row = {
        "case": case,
        "outcome": _replace_surrogates(str(result.outcome)),
        "answered": bool(result.answered),
    }
    return {**engine_columns, **columns, "error": error, "traceback": trace}


def _convert_columns(row: Mapping[str, Any]) -> dict[str, Scalar]:
    """Convert the columns of a scenario, including NumPy scalars, to plain Python values.

    Raises ValueError or TypeError if a column cannot be stored.
    """
    reserved_names = sorted({*LEADING_COLUMNS, *TRAILING_COLUMNS}.intersection(row))
    if reserved_names:
        raise ValueError(f"the scenario's row has columns that the engine writes: {', '.join(reserved_names)}")
    columns: dict[str, Scalar] = {}
    for name, value in row.items():
        scalar = value.item() if hasattr(value, "item") and getattr(value, "ndim", 0) == 0 else value
        if type(scalar) not in (float, int, bool, str):
            raise TypeError(f"column {name} contains a {type(value).__name__}; allowed: float, int, str, bool")
        if type(scalar) is int and scalar.bit_length() > _MAX_INT_BITS:
            bits = scalar.bit_length()
            raise ValueError(f"column {name} contains an integer of {bits} bits, beyond the range of a float")
        columns[_replace_surrogates(str(name))] = _replace_surrogates(scalar) if isinstance(scalar, str) else scalar
    return columns


def _replace_surrogates(text: str) -> str:
    """Replace lone surrogates, which UTF-8 cannot represent."""
    return text.encode("utf-8", errors="replace").decode("utf-8")
