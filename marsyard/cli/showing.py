"""A campaign on the terminal: its definition and draws; the stages of a case as files."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from marsyard.campaigns.definition.campaign import Campaign, leaves, value_at
from marsyard.campaigns.definition.configuration import CampaignConfiguration, description_at
from marsyard.campaigns.errors import CampaignError, report_write_errors
from marsyard.campaigns.sampling.design import describe_design
from marsyard.reports.wording import count, requirement_text, split_unit

if TYPE_CHECKING:
    from marsyard.reports.section import Grid
import re
from collections.abc import Mapping

import numpy as np

#: Width of a column of drawn values with its margin.
_VALUE_WIDTH = 12
_EXTENT = ("minimum", "mean", "maximum")
#: Number of quantiles of a distribution in the figure.
_QUANTILES = 2000
_FIGURES = (".svg", ".png")


def show_campaign(campaign: Campaign, console: Console) -> None:
    """Print a campaign: description, parameters, dispersions and requirements."""
    configuration = campaign.configuration
    _print_head(configuration, console)
    table = _table("Parameters", "parameter", "value")
    for path, value in leaves(configuration.parameters):
        nominal = f"; nominal {value}" if configuration.design.nominal else ""
        table.add_row(Text(path), Text(f"dispersed{nominal}" if path in configuration.dispersions else str(value)))
    console.print(table)
    table = _table("Dispersions", "parameter", "distribution", "bounds", "unit", "source")
    for path, dispersion in campaign.marginals.items():
        data, bounds = _dispersion_data(campaign, path), dispersion.bounds()
        name = Text(path)
        if data["description"]:
            name.append(f"\n{data['description']}", style="dim")
        source = Text(dispersion.source) if dispersion.source else Text("not stated", style="yellow")
        if bounds is None:
            bounds_text = "by formula" if dispersion.formulas else "kinds"
        else:
            low, high = bounds
            lower, upper = "" if math.isinf(low) else f"≥ {low:g}", "" if math.isinf(high) else f"≤ {high:g}"
            bounds_text = f"{low:g} to {high:g}" if lower and upper else lower or upper or "none"
        table.add_row(name, Text(dispersion.describe()), Text(bounds_text), Text(data["unit"]), source)
    console.print(table)
    if configuration.correlations:
        table = _table("Correlated", "parameters", "by", "matrix", "source")
        for group in configuration.correlations:
            rows = "\n".join(" ".join(f"{value:8.3g}" for value in row) for row in getattr(group, group.kind))
            table.add_row(Text("\n".join(group.parameters)), Text(group.kind), Text(rows), Text(group.source))
        console.print(table)
    table = _table("Requirements", "id", "statement", "asked")
    for asked in configuration.requirements:
        table.add_row(Text(asked.id), Text(asked.statement), Text(requirement_text(asked, asked.metric)))
    console.print(table)


def show_draws(campaign: Campaign, cases: int, console: Console) -> None:
    """Print the draws of the first cases: a row for each parameter, with as many cases as fit the terminal.

    A row begins with minimum, mean and maximum over all cases; of values other than numbers, the number of kinds.
    """
    drawn, nominal = list_drawn_values(campaign, cases), int(campaign.configuration.design.nominal)
    _print_head(campaign.configuration, console)
    cases = cases if drawn else 0
    units = {path: campaign.marginals[path].unit for path in drawn}
    names = {path: f"{path} ({unit})" if unit else path for path, unit in units.items()}
    longest = max((len(name) for name in names.values()), default=0)
    shown = min(cases, max(1, (console.width - longest) // _VALUE_WIDTH - len(_EXTENT)))
    title = f"Draws of {count(cases - nominal, 'case')}" + ("" if shown == cases else "; all of them with --json")
    table = _table(title, "parameter")
    table.box = box.SIMPLE_HEAD
    headings = ["nominal" if nominal and case == 0 else f"case {case}" for case in range(shown)]
    for heading in (*_EXTENT, *headings):
        table.add_column(heading, justify="right", overflow="fold")
    for path, values in drawn.items():
        random = values[nominal:]
        extent = ["", "", ""]
        if any(isinstance(value, bool) or not isinstance(value, int | float) for value in random):
            extent[1] = count(len({_value(value) for value in random}), "kind")
        elif random:
            extent = [_value(value) for value in (min(random), sum(random) / len(random), max(random))]
        table.add_row(Text(names[path]), *map(Text, extent), *(Text(_value(value)) for value in values[:shown]))
    console.print(table)


def describe_campaign(campaign: Campaign, cases: int | None) -> dict[str, Any]:
    """A campaign as plain data, optionally with the draws of its first cases; infinite bounds are None."""
    configuration = campaign.configuration
    data: dict[str, Any] = configuration.model_dump(mode="json")
    data["design"]["text"] = _sampling_text(configuration)
    data["dispersions"] = [_dispersion_data(campaign, path) for path in configuration.dispersions]
    if cases is not None:
        drawn = list_drawn_values(campaign, cases)
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
    drawn = {name: values[nominal:] for name, values in list_drawn_values(campaign, cases).items()}
    if not any(drawn.values()):
        raise CampaignError(f"--figure {path}: nothing is drawn in {count(cases, 'case')}")
    of_each = []
    for name, values in drawn.items():
        dispersion, quantiles = campaign.marginals[name], None
        if not dispersion.formulas:
            quantiles = [dispersion.quantile((index + 0.5) / _QUANTILES) for index in range(_QUANTILES)]
        of_each.append(Drawn(name, values, quantiles))
    with report_write_errors(f"--figure {path}:"):
        save_figure(draws_figure(campaign.configuration.name, of_each), path)


def list_drawn_values(campaign: Campaign, cases: int) -> dict[str, list[Any]]:
    """The draws of each dispersion in the first cases, by parameter.

    Raises CampaignError where the campaign has fewer cases, or a case cannot be drawn.
    """
    total = campaign.configuration.total_cases
    if not 1 <= cases <= total:
        raise CampaignError(f"--draw {cases}: the campaign has {count(total, 'case')}; allowed: 1 to {total}")
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


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.5g}"
    return value if isinstance(value, str) else json.dumps(value, default=str)


def _table(title: str, *headings: str) -> Table:
    table = Table(title=title or None, title_justify="left")
    for heading in headings:
        table.add_column(heading, overflow="fold")
    return table


def grid_table(title: str, grid: Grid) -> Table:
    """A report's table on the terminal: names to the left, numbers to the right."""
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left")
    for index, heading in enumerate(grid.head):
        table.add_column(heading, justify="right" if index else "left", overflow="fold")
    for row in grid.rows:
        table.add_row(*map(Text, row))
    return table


_PIXELS = (np.uint8, np.uint16)


def write_stages(directory: Path, products: Mapping[str, Any]) -> int:
    """Write each product to its own file, numbered in the order of the stages; return the number of files.

    A picture (8 or 16 bits, two dimensions, or three with three bands) is a PNG with unchanged counts; any other array
    is `.npy`; all else is JSON. A table or list of products is a folder. Raises StoreError.
    """
    with report_write_errors(directory):
        return _write(directory, products)


def _write(directory: Path, products: Mapping[str, Any]) -> int:
    directory.mkdir(parents=True, exist_ok=True)
    written = 0
    for position, (name, value) in enumerate(products.items(), start=1):
        path = directory / f"{position:02d}-{re.sub(r'[^A-Za-z0-9_.-]', '_', name)}"
        if isinstance(value, list) and any(isinstance(inner, np.ndarray | Mapping) for inner in value):
            value = {str(number): inner for number, inner in enumerate(value)}
        if isinstance(value, Mapping) and _holds_arrays(value):
            written += _write(path, value)
            continue
        written += 1
        if not isinstance(value, np.ndarray):
            path.with_name(f"{path.name}.json").write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")
        elif (value.ndim == 2 or value.shape[2:] == (3,)) and value.dtype in _PIXELS and min(value.shape[:2]) > 1:
            import cv2

            cv2.imwrite(f"{path}.png", value)
        else:
            np.save(path.with_name(f"{path.name}.npy"), value, allow_pickle=False)
    return written


def _holds_arrays(value: Any) -> bool:
    if isinstance(value, Mapping):
        return any(_holds_arrays(inner) for inner in value.values())
    return isinstance(value, np.ndarray) or (isinstance(value, list) and any(_holds_arrays(inner) for inner in value))
