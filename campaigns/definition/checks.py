"""Check a campaign against its scenario before any case runs: dispersions, requirements and calibrated options."""

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import POPULATIONS, Requirement
from marsyard.campaigns.definition.components import list_algorithms
from marsyard.campaigns.definition.parameter_paths import find_value, leaves, paths_overlap, value_at
from marsyard.campaigns.definition.toml_models import Key, key_text, validation_problems
from marsyard.campaigns.errors import unknown_name_message
from marsyard.campaigns.sampling.design import ADAPTIVE
from marsyard.campaigns.sampling.dispersions import Choice, Fixed, GridDispersion
from marsyard.scenarios.algorithm_labels import labels
from marsyard.scenarios.columns import ENGINE, Column, ColumnKind, Columns, flag
from marsyard.scenarios.declared_columns import row_columns
from marsyard.scenarios.interface import HasParts, HasRecordedCases
from marsyard.scenarios.parts.named import SCORE

#: Number of cases whose sampled values are validated before the campaign starts; ranges are always checked.
_CHECKED_CASES = 32
#: Maximum number of dispersed parameters in the formulas of a dispersion, since all combinations of their extremes are
#: checked.
_MAX_VARYING = 8
#: Types of columns in requirements, as named in messages.
FLAGS, NUMBERS = "column of true and false", "column of numbers"


def find_campaign_problems(campaign: Campaign) -> list[tuple[Key, str]]:
    """List the problems of a campaign: keys, and messages with the allowed values."""
    return [*_check_sampling(campaign), *_check_metrics(campaign), *_check_calibration(campaign)]


def find_repeated_cases(campaign: Campaign) -> list[tuple[Key, str]]:
    """List problems of a campaign that would count a recorded case more than once, or as a random draw."""
    if not isinstance(campaign.scenario, HasRecordedCases):
        return []
    path, total = campaign.scenario.recorded_case, campaign.definition.total_cases
    dispersion, recorded = campaign.definition.dispersions.get(path), 1
    if dispersion is not None:
        points = dispersion.points if isinstance(dispersion, GridDispersion) else ()
        # 1.0 is the number 1
        recorded = len({f"{point:g}" if isinstance(point, float) else str(point) for point in points})
        if recorded < max(len(points), 1):
            message = "recorded cases are not random draws, and each is run once; allowed: a grid of different numbers"
            return [(("dispersions", path), message)]
    if total <= recorded:
        return []
    message = (
        f"{total} cases repeat recorded cases, but the same images are no further evidence; allowed here: {recorded}"
    )
    return [(("cases",), message)]


def _check_sampling(campaign: Campaign) -> list[tuple[Key, str]]:
    """List problems of the campaign's dispersions: keys, and messages with the allowed values."""
    if campaign.definition.design.kind == ADAPTIVE:
        return [
            (("design", "kind"), "adaptive is for studies (marsyard rare); allowed: random, latin-hypercube, sobol")
        ]
    problems = [
        *campaign.definition.find_sampling_problems(),
        *_check_names(campaign),
        *find_repeated_cases(campaign),
    ] or _check_ranges(campaign)
    if problems or not campaign.definition.dispersions:
        return problems
    for case in range(min(campaign.definition.cases, _CHECKED_CASES)):
        try:
            error_text = _find_validation_error(campaign, campaign.draws(case))
        except ValueError as error:
            error_text = _extract_message(error)
        if error_text:
            return [(("dispersions",), f"the sampled values of case {case} are invalid in combination: {error_text}")]
    return []


def _check_calibration(campaign: Campaign) -> list[tuple[Key, str]]:
    """List unknown parameters among the calibrated options: keys, and messages with the allowed parameters."""
    calibration, problems = campaign.definition.calibration, []
    parameters = dict(leaves(campaign.definition.parameters))
    for index, run in enumerate(() if calibration is None else calibration.runs):
        for number, path in enumerate(run.options):
            if path not in parameters and not any(leaf.startswith(f"{path}.") for leaf in parameters):
                key: Key = ("calibration", "runs", index, "options", number)
                problems.append((key, _describe_unknown(path, parameters)))
    return problems


def _check_names(campaign: Campaign) -> list[tuple[Key, str]]:
    """List unknown parameters in dispersions or formulas, and cycles of formulas."""
    parameters = dict(leaves(campaign.definition.parameters))
    dispersions = campaign.definition.dispersions
    problems: list[tuple[Key, str]] = []
    for path, dispersion in dispersions.items():
        has_values = not isinstance(dispersion, GridDispersion) or dispersion.values is not None
        allows_tables = isinstance(dispersion, Choice | Fixed | GridDispersion) and has_values
        if path not in parameters and not any(leaf.startswith(f"{path}.") for leaf in parameters):
            problems.append((("dispersions", path), _describe_unknown(path, parameters)))
        elif path not in parameters and not allows_tables:
            message = "is a table; disperse one of its values, or use 'choice' or 'grid' over tables"
            problems.append((("dispersions", path), message))
        for key, name in ((key, name) for key, formula in dispersion.formulas.items() for name in formula.names):
            parent = next((table for table in dispersions if name.startswith(f"{table}.")), None)
            if parent is not None:
                message = f"'{name}' cannot be used: its table '{parent}' is dispersed as a whole"
            else:
                message = "" if name in parameters else _describe_unknown(name, parameters)
            problems += [(("dispersions", path, *key), message)] if message else []
    if not problems:
        try:
            campaign.order  # noqa: B018  (evaluates the property)
        except ValueError as error:
            problems.append((("dispersions",), str(error)))
    return problems


def _describe_unknown(path: str, parameters: Iterable[str]) -> str:
    """Create the message about an unknown path: it lists the parameters in the innermost existing table of the path."""
    allowed = names = list(parameters)
    table = path
    while table:
        table = table.rpartition(".")[0]
        prefix = f"{table}." if table else ""
        entries = [name.removeprefix(prefix).partition(".") for name in names if name.startswith(prefix)]
        if entries:
            allowed = list(dict.fromkeys(f"{prefix}{key}{'.*' if dot else ''}" for key, dot, _ in entries))
            break
    return unknown_name_message("parameter", path, names, allowed)


def _check_ranges(campaign: Campaign) -> list[tuple[Key, str]]:
    """List invalid parameter values and undefined formulas at the limits of the dispersions."""
    problems: list[tuple[Key, str]] = []
    extremes: dict[str, list[Any]] = {}
    for path in campaign.order:
        if any(name in campaign.marginals and name not in extremes for name in campaign.marginals[path].names):
            continue  # the problem of a dispersion in its formulas is already in the list
        try:
            values = _check_extremes(campaign, path, extremes)
        except ValueError as error:
            problems.append((("dispersions", path), _extract_message(error)))
            continue
        numbers = [value for value in values if isinstance(value, int | float) and not isinstance(value, bool)]
        all_numbers = len(numbers) == len(values)
        extremes[path] = list(dict.fromkeys((min(numbers), max(numbers)))) if all_numbers else values
    return problems


def _check_extremes(campaign: Campaign, path: str, extremes: Mapping[str, list[Any]]) -> list[Any]:
    """Compute the extreme values of a dispersion for all combinations of extremes of the parameters in its formulas.

    Raises ValueError for the first invalid value.
    """
    dispersion, parameters = campaign.marginals[path], campaign.definition.parameters
    varying = [name for name in dispersion.names if name in extremes]
    if len(varying) > _MAX_VARYING:
        raise ValueError(f"its formulas contain {len(varying)} varying parameters; allowed: up to {_MAX_VARYING}")
    fixed_values = {name: value_at(parameters, name) for name in dispersion.names if name not in varying}
    extreme_values: list[Any] = []
    for corner in itertools.product(*(extremes[name] for name in varying)):
        values = dict(zip(varying, corner, strict=True))
        distribution = dispersion.insert_values({**fixed_values, **values})
        for value in distribution.extremes():
            error_text = _find_validation_error(campaign, {**values, path: value})
            if error_text:
                condition = "".join(f" where {name} = {number}" for name, number in values.items())
                text = f"{distribution.describe()} includes {value!r}{condition}, which is not valid: {error_text}"
                raise ValueError(text)
            extreme_values.append(value)
    return extreme_values


def _find_validation_error(campaign: Campaign, values: Mapping[str, Any]) -> str:
    """Return the validation error of the parameters with these values; empty if they are valid."""
    infinite_paths = [path for path, value in values.items() if isinstance(value, float) and not math.isfinite(value)]
    if infinite_paths:
        return f"{infinite_paths[0]} must be finite"
    try:
        campaign.with_values(values)
    except ValidationError as error:
        problems = validation_problems(error, campaign.scenario.parameters_type)
        return "; ".join(f"{key_text(key)}: {message}" if key else message for key, message in problems)
    return ""


def _extract_message(error: ValueError) -> str:
    """Return the message of an error, without the additions of pydantic."""
    if isinstance(error, ValidationError):
        return "; ".join(str(detail["msg"]).removeprefix("Value error, ") for detail in error.errors())
    return str(error)


def _check_metrics(campaign: Campaign) -> list[tuple[Key, str]]:
    """List columns of requirements that the scenario does not declare: keys, and messages with the allowed columns.

    Columns of custom scores are accepted by their prefix. Columns of a custom scenario are unknown before a run, so its
    first finished case is checked instead (`marsyard.campaigns.running.engine.check_metrics`).
    """
    try:
        columns = _collect_columns(campaign)
    except ValueError as error:
        return [(("scenario",), str(error))]
    if columns is None:
        return []
    compared = labels(list_algorithms(campaign.definition))[1:]

    def is_known(name: str, kind: str) -> bool:
        column = next((name.removeprefix(f"{spec}.") for spec in compared if name.startswith(f"{spec}.")), name)
        return columns.has(column, float if kind == NUMBERS else bool)

    flags, numbers = columns.names(bool), columns.names(float)
    return find_unknown_columns(campaign.definition.requirements, flags, numbers, is_known)


def find_unknown_columns(
    requirements: Sequence[Requirement],
    flags: Sequence[str],
    numbers: Sequence[str],
    is_known: Callable[[str, str], bool],
) -> list[tuple[Key, str]]:
    """List columns of requirements with an unknown name or kind: keys, and messages with the allowed columns.

    - flags, numbers: names of the known columns of each kind, for the messages
    - is_known: whether a column with this name has this kind (`FLAGS` or `NUMBERS`)
    """
    problems: list[tuple[Key, str]] = []
    for index, requirement in enumerate(requirements):
        kind, allowed = (FLAGS, flags) if requirement.bound is None else (NUMBERS, numbers)
        columns = [("metric", name, kind, allowed) for name in requirement.metric_columns]
        columns += [("population", name, FLAGS, (*POPULATIONS, *flags)) for name in requirement.population_columns]
        columns += [("margin", requirement.margin, NUMBERS, numbers)] if requirement.margin is not None else []
        for key, name, required_kind, choices in columns:
            if not is_known(name, required_kind):
                problems.append((("requirements", index, key), unknown_name_message(required_kind, name, choices)))
    return problems


def _collect_columns(campaign: Campaign) -> Columns | None:
    """Collect the columns of the scenario, of the engine and of the campaign's parameters; None if they are unknown."""
    definition = campaign.definition
    columns = row_columns(definition.scenario)
    if columns is None:
        return None
    scores: list[Column] = []
    keys = campaign.scenario.part_keys if isinstance(campaign.scenario, HasParts) else {}
    for path in (path for path, kind in keys.items() if kind is SCORE):
        if any(paths_overlap(path, name) for name in definition.dispersions):
            return None
        for label in labels(find_value(definition.parameters, path)):
            scores += [Column(f"{label}_*", ColumnKind.ERROR, "custom score", type=kind) for kind in (float, bool)]
    draws = [Column(path, ColumnKind.CONDITION, "sampled value") for path in definition.dispersions]
    declared = list(columns)
    if columns.named_flags:  # flags that the campaign file names
        declared = [column for column in columns if column.type is not bool or "*" not in column.name]
        declared += [flag(str(item["name"]), "") for item in find_value(definition.parameters, columns.named_flags)]
    return Columns((*declared, *ENGINE, *draws, *scores))
