"""Results of an error budget (`marsyard.campaigns.studies.budget`): sentences, and a section of the report."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from matplotlib.figure import Figure

from marsyard.campaigns.json_numbers import convert_to_json
from marsyard.campaigns.studies.contributions import Budget
from marsyard.campaigns.studies.results import BUDGET, BudgetResult
from marsyard.reports.figure_style import GRID, INK, SERIES, in_page_style, new_axes
from marsyard.reports.section import Block, Grid, Section, Subject, svg_figure
from marsyard.reports.wording import count, format_fraction, label, number
from marsyard.scenarios.columns import split_unit

#: Difference of the closure (contributions and remaining part divided by the total) from 1 that is reported.
MAX_CLOSURE_ERROR = 0.1
#: Title of the mean square without any source of error.
REMAINING = "remaining without any source"
#: Number of dispersions in the table of Sobol's indices.
_MAX_INDICES = 12
#: Height of a bar of the figure, whose rows have a distance of 1.
_BAR_HEIGHT = 0.62


def signed_percent(fraction: float) -> str:
    """Format a fraction of the total in per cent; contributions can be negative, and above 100 %."""
    return f"{100.0 * fraction:z.1f} %".replace("-", "−")


def budget_sentences(record: Mapping[str, Any]) -> list[str]:
    """Describe total, largest contributions and additivity of an error budget in a record; empty without a result."""
    study = BUDGET.read(record)
    if study is None:
        return []
    parameters, result = study
    sentences: list[str] = []
    budget = result.budget
    if budget is not None:
        largest_contributions = [item for item in budget.contributions[:3] if item.mean > 0.0]
        largest = ", ".join(
            f"{item.title} {signed_percent(item.mean / budget.total)}" for item in largest_contributions
        )
        sentences += [
            f"{parameters.requirement}: {_statistic(result)} of {label(result.quantity)}: "
            f"{number(math.sqrt(budget.total))} with all sources of error, {_format_root(budget.remaining)} without "
            f"any, from the {budget.common} of {count(result.cases, 'base case')} that were answered in every variant.",
            f"Largest contributions to the mean square: {largest or 'none'}; "
            f"{REMAINING} {signed_percent(budget.remaining / budget.total)}.",
            _closure_sentence(budget, parameters.confidence),
        ]
    if result.indices:
        first = ", ".join(f"{item.name} {number(item.total)}" for item in result.indices[:3])
        sentences.append(f"Largest total Sobol indices: {first}, from {count(result.index_samples, 'base sample')}.")
    elif parameters.sobol:
        sentences.append(
            "Sobol indices are not available: fewer than 8 base samples were answered in all their cases, or all "
            "errors are equal."
        )
    return [*sentences, *filter(None, [result.reason]), f"The study ran {count(result.evaluated, 'case')}."]


def _statistic(result: BudgetResult) -> str:
    """Return the name of the root of the mean square, which is centred on the mean for a margin."""
    return "standard deviation" if result.centred else "RMS"


def _closure_sentence(budget: Budget, confidence: float) -> str:
    bounds = f"{signed_percent(budget.closure_lower)} to {signed_percent(budget.closure_upper)}"
    interval = f"{format_fraction(confidence)} interval {bounds}"
    text = f"Contributions and remaining part add up to {signed_percent(budget.closure)} of the total ({interval})"
    if abs(budget.closure - 1.0) > MAX_CLOSURE_ERROR:
        return f"{text}: three or more sources interact, so that the contributions do not add up."
    return f"{text}."


def budget_section(subject: Subject) -> Section | None:
    """Create the section of an error budget; None for another run."""
    study = BUDGET.read(subject.run.record)
    if study is None:
        return None
    parameters, result = study
    blocks: list[Block] = []
    if result.budget is not None:
        blocks.append(_budget_block(result, result.budget, parameters.confidence))
    if result.indices:
        blocks.append(_index_block(result))
    if not blocks:
        blocks.append(Block(text=result.reason or "No result."))
    data = convert_to_json(asdict(result)) | {"requirement": parameters.requirement}
    return Section("budget", "Error budget", "Error budget", tuple(blocks), data)


def _budget_block(result: BudgetResult, budget: Budget, confidence: float) -> Block:
    """Create figure and table of the contributions of the sources of error."""
    unit, total, n_cases = split_unit(result.quantity)[1], budget.total, result.cases
    root_unit = f", {unit}" if unit else ""
    head = [
        "Source of error", "Contribution", f"{format_fraction(confidence)} interval", "Interaction",
        f"With it only{root_unit}", f"Without it{root_unit}", f"Answered of {n_cases}",
    ]  # fmt: skip
    rows = [
        [
            item.title,
            signed_percent(item.mean / total),
            f"{signed_percent(item.lower / total)} to {signed_percent(item.upper / total)}",
            signed_percent(0.5 * (item.removed - item.alone) / total),
            _format_root(item.alone + budget.remaining),
            _format_root(total - item.removed),
            ", ".join(map(str, reversed(item.answered))),  # with it only, without it
        ]
        for item in budget.contributions
    ]
    rows.append([REMAINING, signed_percent(budget.remaining / total), "", "", _format_root(budget.remaining), "", ""])
    statistic, name = _statistic(result), label(result.quantity).split(" (")[0]
    figure = svg_figure(
        _draw_waterfall(budget, f"mean square of {name}, ({unit})²" if unit else f"mean square of {name}"),
        "budget-waterfall",
        f"Mean square of {name} without any source of error, contributions of the sources, and "
        "mean square with all sources. Black lines: intervals.",
        wide=True,
    )
    inactive = f" Sources that this campaign does not have: {'; '.join(result.inactive)}." if result.inactive else ""
    note = (
        "Each base case runs with the same dispersions and random streams in all variants. 'With it only' is the "
        f"{statistic} with this source and no other, 'Without it' that with all other sources; both include the part "
        "that remains without any source. 'Answered' is the number of answered base cases, with the source only and "
        "without it. The contribution is the mean of two increases of the mean square: if the source is added to no "
        "other source, and if it is added to all others. The interaction is half of the second minus the first. "
        f"Intervals: bootstrap over terrains. {count(result.violations, 'base case')} with all sources "
        f"violate the requirement.{inactive}"
    )
    return Block("Sources of error", figures=[figure], grid=Grid(head, rows), note=note)


def _format_root(square: float) -> str:
    """Format the root of a mean square; 0 for a difference of mean squares that is negative by rounding."""
    return number(math.sqrt(max(square, 0.0)))


def _index_block(result: BudgetResult) -> Block:
    """Create the table of Sobol's indices."""
    indices = result.indices
    rows = [
        [
            item.name,
            f"{number(item.total)} ± {number(item.total_width)}",
            f"{number(item.first)} ± {number(item.first_width)}",
        ]
        for item in indices[:_MAX_INDICES]
    ]
    note = (
        f"Saltelli's design with {count(result.index_samples, 'complete base sample')}. The first-order index "
        "is the fraction of the variance that a variable causes alone, the total index the fraction with all its "
        "interactions. Correlated dispersions are represented by their independent variables. The "
        "intervals are bootstrap intervals; an index whose interval contains 0 is not significant."
    )
    return Block(
        "Sobol indices",
        grid=Grid(["Variable", "Total index", "First-order index"], rows, max(len(indices) - _MAX_INDICES, 0)),
        note=note,
    )


@in_page_style
def _draw_waterfall(budget: Budget, axis_label: str) -> Figure:
    """Draw horizontal bars: remaining mean square, contributions from the end of the previous bar, and total."""
    contributions = budget.contributions
    figure, axes = new_axes(9.0, 1.2 + 0.34 * (len(contributions) + 2))
    titles = [REMAINING, *(item.title for item in contributions), "all sources of error"]
    rows = range(len(titles))
    level = budget.remaining
    axes.barh(0, level, color=SERIES[5], height=_BAR_HEIGHT)
    for row, item in enumerate(contributions, start=1):
        color = SERIES[0] if item.mean >= 0.0 else SERIES[1]
        axes.barh(row, item.mean, left=level, color=color, height=_BAR_HEIGHT)
        axes.plot([level + item.lower, level + item.upper], [row, row], color=INK, linewidth=1.2)
        # connect the end of the previous bar with the start of this bar
        axes.plot(
            [level, level],
            [row - 1.0 - 0.5 * _BAR_HEIGHT, row + 0.5 * _BAR_HEIGHT],
            color=GRID,
            linewidth=0.8,
            zorder=0,
        )
        level += item.mean
    last = len(titles) - 1
    axes.barh(last, budget.total, color=SERIES[2], height=_BAR_HEIGHT)
    axes.plot([budget.total_lower, budget.total_upper], [last, last], color=INK, linewidth=1.2)
    axes.set_yticks(list(rows), titles)
    axes.invert_yaxis()
    axes.set(xlabel=axis_label)
    return figure
