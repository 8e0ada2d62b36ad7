"""Print a campaign (`marsyard show`): definition and drawn values."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.definition.parameter_paths import leaves, value_at
from marsyard.campaigns.definition.toml_models import description_at
from marsyard.campaigns.errors import CampaignError, report_write_errors
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.wording import count, requirement_text
from marsyard.scenarios.columns import split_unit

#: Width of a column of drawn values including its margin, characters.
_VALUE_WIDTH = 12
_STATISTICS = ("minimum", "mean", "maximum")
#: Number of quantiles of a distribution in the figure.
_QUANTILES = 2000
_FIGURE_FORMATS = (".svg", ".png")


def show_campaign(campaign: Campaign, console: Console) -> None:
    """Print a campaign: description, parameters, dispersions and requirements."""
    definition = campaign.definition
    _print_header(definition, console)
    table = _create_table("Parameters", "parameter", "value")
    for path, value in leaves(definition.parameters):
        nominal = f"; nominal {value}" if definition.design.nominal else ""
        table.add_row(Text(path), Text(f"dispersed{nominal}" if path in definition.dispersions else str(value)))
    console.print(table)
    table = _create_table("Dispersions", "parameter", "distribution", "bounds", "unit", "source")
    for path, dispersion in campaign.marginals.items():
        data, bounds = _dispersion_data(campaign, path), dispersion.bounds()
        name = Text(path)
        if data["description"]:
            name.append(f"\n{data['description']}", style="dim")
        source = Text(dispersion.source) if dispersion.source else Text("no source", style="yellow")
        if bounds is None:
            bounds_text = "by formula" if dispersion.formulas else "categories"
        else:
            low, high = bounds
            lower, upper = "" if math.isinf(low) else f"≥ {low:g}", "" if math.isinf(high) else f"≤ {high:g}"
            bounds_text = f"{low:g} to {high:g}" if lower and upper else lower or upper or "none"
        table.add_row(name, Text(dispersion.describe()), Text(bounds_text), Text(data["unit"]), source)
    console.print(table)
    if definition.correlations:
        table = _create_table("Correlated", "parameters", "by", "matrix", "source")
        for group in definition.correlations:
            rows = "\n".join(" ".join(f"{value:8.3g}" for value in row) for row in getattr(group, group.kind))
            table.add_row(Text("\n".join(group.parameters)), Text(group.kind), Text(rows), Text(group.source))
        console.print(table)
    table = _create_table("Requirements", "id", "statement", "criterion")
    for item in definition.requirements:
        table.add_row(Text(item.id), Text(item.statement), Text(requirement_text(item)))
    console.print(table)


def show_draws(campaign: Campaign, cases: int, console: Console) -> None:
    """Print the drawn values of the first cases: a row per parameter, with as many cases as fit the terminal.

    A row starts with minimum, mean and maximum over all cases, or the number of distinct values if not numeric.
    """
    values_by_path, nominal_cases = list_drawn_values(campaign, cases), int(campaign.definition.design.nominal)
    _print_header(campaign.definition, console)
    units = {path: campaign.marginals[path].unit for path in values_by_path}
    names = {path: f"{path} ({unit})" if unit else path for path, unit in units.items()}
    name_width = max((len(name) for name in names.values()), default=0)
    visible_cases = min(cases, max(1, (console.width - name_width) // _VALUE_WIDTH - len(_STATISTICS)))
    hint = "" if visible_cases == cases else "; --json prints all cases"
    drawn_cases = cases - nominal_cases
    if not values_by_path:  # no parameter is drawn
        visible_cases, drawn_cases, hint = 0, 0, ""
    table = _create_table(f"Draws of {count(drawn_cases, 'case')}{hint}", "parameter")
    table.box = box.SIMPLE_HEAD
    headings = ["nominal" if nominal_cases and case == 0 else f"case {case}" for case in range(visible_cases)]
    for heading in (*_STATISTICS, *headings):
        table.add_column(heading, justify="right", overflow="fold")
    for path, values in values_by_path.items():
        draws = values[nominal_cases:]
        statistics = ["", "", ""]
        if any(isinstance(value, bool) or not isinstance(value, int | float) for value in draws):
            statistics[1] = count(len({_format_value(value) for value in draws}), "distinct value")
        elif draws:
            statistics = [_format_value(value) for value in (min(draws), sum(draws) / len(draws), max(draws))]
        texts = [Text(_format_value(value)) for value in values[:visible_cases]]
        table.add_row(Text(names[path]), *map(Text, statistics), *texts)
    console.print(table)


def describe_campaign(campaign: Campaign, cases: int | None) -> dict[str, Any]:
    """Convert a campaign to plain data, optionally with the draws of its first cases; infinite bounds become None."""
    definition = campaign.definition
    data: dict[str, Any] = definition.model_dump(mode="json")
    data["design"]["text"] = read_sampling_design(definition.model_dump(mode="json")).text
    data["dispersions"] = [_dispersion_data(campaign, path) for path in definition.dispersions]
    if cases is not None:
        values_by_path = list_drawn_values(campaign, cases)
        data["draws"] = [
            {"case": case, "values": {path: values[case] for path, values in values_by_path.items()}}
            for case in range(cases)
        ]
    return data


def write_draws_figure(campaign: Campaign, cases: int, path: Path) -> None:
    """Plot the drawn values of the first cases to an SVG or PNG file.

    Raises CampaignError if the file has another extension, cannot be written, or no parameter is drawn.
    """
    from marsyard.reports.draws import ParameterSample, draws_figure, save_figure

    if path.suffix not in _FIGURE_FORMATS:
        raise CampaignError(f"--figure {path}: unknown file format; allowed: {', '.join(_FIGURE_FORMATS)}")
    nominal_cases = int(campaign.definition.design.nominal)
    draws = {name: values[nominal_cases:] for name, values in list_drawn_values(campaign, cases).items()}
    if not any(draws.values()):
        raise CampaignError(f"--figure {path}: no parameter is drawn in {count(cases, 'case')}")
    marginals = []
    for name, values in draws.items():
        dispersion, quantiles = campaign.marginals[name], None
        if not dispersion.formulas:
            quantiles = [dispersion.quantile((index + 0.5) / _QUANTILES) for index in range(_QUANTILES)]
        marginals.append(ParameterSample(name, values, quantiles))
    with report_write_errors(f"--figure {path}:"):
        save_figure(draws_figure(campaign.definition.name, marginals), path)


def list_drawn_values(campaign: Campaign, cases: int) -> dict[str, list[Any]]:
    """Return the drawn values of the first cases by parameter path.

    Raises CampaignError if the campaign has fewer cases or the values of a case cannot be drawn.
    """
    total = campaign.definition.total_cases
    if not 1 <= cases <= total:
        raise CampaignError(f"--draw {cases}: the campaign has {count(total, 'case')}; allowed: 1 to {total}")
    values_by_path: dict[str, list[Any]] = {path: [] for path in campaign.definition.dispersions}
    for case in range(cases):
        try:
            values = campaign.draws(case)
        except ValueError as error:
            raise CampaignError(f"case {case} cannot be drawn: {error}") from error
        for path, value in values.items():
            values_by_path[path].append(value)
    return values_by_path


def _print_header(definition: CampaignDefinition, console: Console) -> None:
    """Print name, description, scenario, size and sampling of a campaign."""
    for line in (
        f"{definition.name}: {definition.description}",
        f"scenario {definition.scenario}, {count(definition.total_cases, 'case')}, seed {definition.seed}",
        f"sampling: {read_sampling_design(definition.model_dump(mode='json')).text}",
    ):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _dispersion_data(campaign: Campaign, path: str) -> dict[str, Any]:
    """Convert a dispersion to plain data; unit and description default to those of the parameter."""
    dispersion = campaign.marginals[path]
    bounds = dispersion.bounds()
    groups = (group.parameters for group in campaign.definition.correlations if path in group.parameters)
    description = dispersion.description
    return {
        "parameter": path,
        **dispersion.model_dump(mode="json", exclude_none=True),
        "text": dispersion.describe(),
        "bounds": None if bounds is None else [value if math.isfinite(value) else None for value in bounds],
        "unit": split_unit(path.rstrip(".0123456789"))[1] if dispersion.unit is None else dispersion.unit,
        "description": description_at(campaign.scenario.parameters_type, path) if description is None else description,
        "source": dispersion.source,
        "correlated_with": [name for group in groups for name in group if name != path],
        "nominal": value_at(campaign.definition.parameters, path),
    }


def _format_value(value: Any) -> str:
    """Format a sampled value in a few characters."""
    if isinstance(value, float):
        return f"{value:.5g}"
    return value if isinstance(value, str) else json.dumps(value, default=str)


def _create_table(title: str, *headings: str) -> Table:
    """Create an empty table with columns for the headings."""
    table = Table(title=title or None, title_justify="left")
    for heading in headings:
        table.add_column(heading, overflow="fold")
    return table
