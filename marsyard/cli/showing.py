"""A campaign on the terminal: its definition, and the draws of its dispersions."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from marsyard.campaigns.definition.campaign import Campaign, leaves, value_at
from marsyard.campaigns.definition.configuration import CampaignConfiguration, description_at
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.sampling.design import describe_design
from marsyard.campaigns.sampling.dispersion import Dispersion
from marsyard.reports.columns import split_unit
from marsyard.reports.wording import asked_text, count

if TYPE_CHECKING:
    from marsyard.reports.section import Grid

#: Width of a column of drawn values with what sets it apart.
_VALUE_WIDTH = 12
_EXTENT = ("least", "mean", "greatest")
#: Probabilities at which a distribution is taken as a whole, for the figure.
_QUANTILES = 2000
_FIGURES = (".svg", ".png")


def show_campaign(campaign: Campaign, console: Console) -> None:
    """Print a campaign: description, parameters, dispersions and requirements."""
    configuration = campaign.configuration
    _print_head(configuration, console)
    console.print(_parameters(configuration))
    console.print(_dispersions(campaign))
    if configuration.correlations:
        console.print(_correlations(configuration))
    console.print(_requirements(configuration))


def show_draws(campaign: Campaign, cases: int, console: Console) -> None:
    """Print the draws of the first cases."""
    drawn = drawn_values(campaign, cases)
    _print_head(campaign.configuration, console)
    console.print(_draws(campaign, drawn, console.width))


def described(campaign: Campaign, cases: int | None) -> dict[str, Any]:
    """A campaign as plain data, optionally with the draws of its first cases; infinite bounds are None."""
    configuration = campaign.configuration
    data: dict[str, Any] = configuration.model_dump(mode="json")
    data["design"]["text"] = _sampling_text(configuration)
    data["dispersions"] = [_dispersion_data(campaign, path) for path in configuration.dispersions]
    if cases is not None:
        drawn = drawn_values(campaign, cases)
        data["draws"] = [
            {"case": case, "values": {path: values[case] for path, values in drawn.items()}} for case in range(cases)
        ]
    return data


def write_draws_figure(campaign: Campaign, cases: int, path: Path) -> None:
    """Plot the draws of the first cases to an SVG or PNG file.

    Raises CampaignError where the file has another ending or cannot be written, or there is nothing to draw.
    """
    from marsyard.reports.draws import Drawn, draws_figure, save_figure

    if path.suffix not in _FIGURES:
        raise CampaignError(f"--figure {path}: unknown kind of picture; allowed: {', '.join(_FIGURES)}")
    nominal = int(campaign.configuration.design.nominal)
    drawn = {name: values[nominal:] for name, values in drawn_values(campaign, cases).items()}
    if not any(drawn.values()):
        raise CampaignError(f"--figure {path}: nothing is drawn in {count(cases, 'case')}")
    of_each = [Drawn(name, values, _quantiles(campaign.marginals[name])) for name, values in drawn.items()]
    try:
        save_figure(draws_figure(campaign.configuration.name, of_each), path)
    except OSError as error:
        raise CampaignError(f"--figure {path}: cannot be written: {error.strerror or error}") from error


def _quantiles(dispersion: Dispersion) -> list[Any] | None:
    if dispersion.formulas:
        return None
    return [dispersion.quantile((place + 0.5) / _QUANTILES) for place in range(_QUANTILES)]


def drawn_values(campaign: Campaign, cases: int) -> dict[str, list[Any]]:
    """The draws of each dispersion in the first cases, by parameter.

    Raises CampaignError where the campaign has fewer cases, or a case cannot be drawn.
    """
    there = campaign.configuration.total_cases
    if not 1 <= cases <= there:
        raise CampaignError(f"--draw {cases}: the campaign has {count(there, 'case')}; allowed: 1 to {there}")
    drawn: dict[str, list[Any]] = {path: [] for path in campaign.configuration.dispersions}
    for case in range(cases):
        try:
            values = campaign.draws(case)
        except ValueError as error:
            raise CampaignError(f"case {case} cannot be drawn: {error}") from error
        for path, value in values.items():
            drawn[path].append(value)
    return drawn


def _print_head(configuration: CampaignConfiguration, console: Console) -> None:
    for line in (
        f"{configuration.name}: {configuration.description}",
        f"scenario {configuration.scenario}, {count(configuration.total_cases, 'case')}, seed {configuration.seed}",
        f"sampling: {_sampling_text(configuration)}",
    ):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _sampling_text(configuration: CampaignConfiguration) -> str:
    design = configuration.design
    return describe_design(design.kind, list(configuration.grids), nominal=design.nominal)


def _parameters(configuration: CampaignConfiguration) -> Table:
    table = _table("Parameters", "parameter", "value")
    nominal = configuration.design.nominal
    for path, value in leaves(configuration.parameters):
        shown = "dispersed" if path in configuration.dispersions else str(value)
        table.add_row(Text(path), Text(f"dispersed; nominal {value}" if nominal and shown == "dispersed" else shown))
    return table


def _dispersions(campaign: Campaign) -> Table:
    table = _table("Dispersions", "parameter", "distribution", "bounds", "unit", "source")
    for path, dispersion in campaign.marginals.items():
        data = _dispersion_data(campaign, path)
        name = Text(path)
        if data["description"]:
            name.append(f"\n{data['description']}", style="dim")
        source = Text(dispersion.source) if dispersion.source else Text("not stated", style="yellow")
        table.add_row(name, Text(dispersion.describe()), Text(_bounds_text(dispersion)), Text(data["unit"]), source)
    return table


def _dispersion_data(campaign: Campaign, path: str) -> dict[str, Any]:
    """One dispersion as plain data, with unit and description of the parameter where it states none itself."""
    dispersion = campaign.marginals[path]
    bounds = dispersion.bounds()
    groups = (group.parameters for group in campaign.configuration.correlations if path in group.parameters)
    stated = dispersion.description
    return {
        "parameter": path,
        **dispersion.model_dump(mode="json", exclude_none=True),
        "text": dispersion.describe(),
        "bounds": None if bounds is None else [value if math.isfinite(value) else None for value in bounds],
        "unit": split_unit(path.rstrip(".0123456789"))[1] if dispersion.unit is None else dispersion.unit,
        "description": description_at(campaign.scenario.parameters_type, path) if stated is None else stated,
        "source": dispersion.source,
        "correlated_with": [name for group in groups for name in group if name != path],
        "nominal": value_at(campaign.configuration.parameters, path),
    }


def _bounds_text(dispersion: Dispersion) -> str:
    bounds = dispersion.bounds()
    if bounds is None:
        return "by formula" if dispersion.formulas else "kinds"
    low, high = bounds
    if math.isinf(low) and math.isinf(high):
        return "none"
    if math.isinf(high):
        return f"≥ {low:g}"
    return f"≤ {high:g}" if math.isinf(low) else f"{low:g} to {high:g}"


def _correlations(configuration: CampaignConfiguration) -> Table:
    table = _table("Correlated", "parameters", "by", "matrix", "source")
    for group in configuration.correlations:
        rows = "\n".join(" ".join(f"{value:8.3g}" for value in row) for row in getattr(group, group.kind))
        table.add_row(Text("\n".join(group.parameters)), Text(group.kind), Text(rows), Text(group.source))
    return table


def _draws(campaign: Campaign, drawn: Mapping[str, Sequence[Any]], width: int) -> Table:
    """Draws, a row for each parameter: its range over all cases, then as many cases as fit the terminal."""
    cases, nominal = len(next(iter(drawn.values()), [])), int(campaign.configuration.design.nominal)
    names = {path: _with_unit(path, campaign.marginals[path]) for path in drawn}
    longest = max((len(name) for name in names.values()), default=0)
    shown = min(cases, max(1, (width - longest) // _VALUE_WIDTH - len(_EXTENT)))
    title = f"Draws of {count(cases - nominal, 'case')}" + ("" if shown == cases else "; all of them with --json")
    table = _table(title, "parameter")
    table.box = box.SIMPLE_HEAD
    headings = ["nominal" if nominal and case == 0 else f"case {case}" for case in range(shown)]
    for heading in (*_EXTENT, *headings):
        table.add_column(heading, justify="right", overflow="fold")
    for path, values in drawn.items():
        table.add_row(
            Text(names[path]), *map(Text, _extent(values[nominal:])), *(Text(_value(v)) for v in values[:shown])
        )
    return table


def _with_unit(path: str, dispersion: Dispersion) -> str:
    """A parameter's path, with the unit if the file states one."""
    return f"{path} ({dispersion.unit})" if dispersion.unit else path


def _extent(values: Sequence[Any]) -> tuple[str, str, str]:
    """Minimum, mean and maximum of numbers; the number of kinds of other values."""
    if not values:
        return "", "", ""
    if any(isinstance(value, bool) or not isinstance(value, int | float) for value in values):
        return "", count(len({_value(value) for value in values}), "kind"), ""
    return _value(min(values)), _value(sum(values) / len(values)), _value(max(values))


def _value(value: Any) -> str:
    """A drawn value, numbers with five digits."""
    if isinstance(value, float):
        return f"{value:.5g}"
    return value if isinstance(value, str) else json.dumps(value, default=str)


def _requirements(configuration: CampaignConfiguration) -> Table:
    table = _table("Requirements", "id", "statement", "asked")
    for asked in configuration.requirements:
        table.add_row(Text(asked.id), Text(asked.statement), Text(asked_text(asked, asked.metric)))
    return table


def _table(title: str, *headings: str) -> Table:
    table = Table(title=title or None, title_justify="left")
    for heading in headings:
        table.add_column(heading, overflow="fold")
    return table


def grid_table(title: str, grid: Grid) -> Table:
    """A report's table on the terminal: names to the left, numbers to the right."""
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left")
    for place, heading in enumerate(grid.head):
        table.add_column(heading, justify="right" if place else "left", overflow="fold")
    for row in grid.rows:
        table.add_row(*map(Text, row))
    return table
