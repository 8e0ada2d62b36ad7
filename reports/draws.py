"""Figure of the sampled parameters before a run: marginal distributions and all pairs (`marsyard show --figure`)."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from marsyard.reports.figure_style import GRID, INK, MAX_VECTOR_POINTS, MUTED, RASTER_DPI, SERIES, in_page_style
from marsyard.reports.statistics.drivers import rank_correlation
from marsyard.reports.wording import count
from marsyard.scenarios.columns import split_unit

#: Width and height of the panel of one distribution, inches, and number of panels that always fit in a row.
_WIDTH_IN, _HEIGHT_IN, _MIN_PER_ROW = 3.0, 1.9, 4
#: Margins between the axes and the edges of their panel, which contain tick labels and title, inches.
_LEFT_IN, _RIGHT_IN, _BOTTOM_IN, _TOP_IN = 0.3, 0.25, 0.45, 0.4
#: Height of a heading, and margin of the figure, inches.
_HEADING_HEIGHT_IN, _MARGIN_IN = 0.45, 0.15
#: Side of the panel of two parameters, inches, and maximum number of parameters that are drawn in pairs.
_CELL_SIDE_IN, MAX_PAIRED = 0.95, 24
_CENTERED_TEXT: dict[str, Any] = {"ha": "center", "va": "center", "color": INK}
#: Numbers of at most this many values, all with few decimals, have a bar for each value, not a histogram.
_MAX_LEVELS = 12
#: Maximum number of bars with labels, and of characters of a label; maximum number of histogram bins.
_MAX_LABELS, _MAX_LABEL_LENGTH, _MAX_BINS = 8, 14, 24

Values = Float[np.ndarray, " _"]


@dataclass(frozen=True)
class ParameterSample:
    """Sampled values of one parameter.

    - values: value of each case
    - expected: quantiles of the distribution at evenly spaced probabilities; None if it differs between cases
    """

    path: str
    values: Sequence[Any]
    expected: Sequence[Any] | None = None

    @property
    def name(self) -> str:
        """The parameter in words, with its unit."""
        name, unit = split_unit(self.path)
        return f"{name} ({unit})" if unit else name

    @property
    def short_name(self) -> str:
        """The last name of the path without unit; for an element of a list, with its index."""
        table, _, last = self.path.rpartition(".")
        return f"{table.rpartition('.')[2]}_{last}" if last.isdigit() else split_unit(last)[0]

    @property
    def categories(self) -> list[str] | None:
        """Distinct values in order; None for numbers."""
        if all(isinstance(value, int | float) and not isinstance(value, bool) for value in self.values):
            return None
        return list(dict.fromkeys(_format_value(value) for value in [*(self.expected or ()), *self.values]))

    def to_numbers(self, values: Sequence[Any]) -> Values:
        """Convert values of this parameter to numbers; categories to their index."""
        categories = self.categories
        if categories is None:
            return np.array([float(value) for value in values])
        return np.array([float(categories.index(_format_value(value))) for value in values])


@in_page_style
def draws_figure(title: str, samples: Sequence[ParameterSample]) -> Figure:
    """Draw the marginal distributions of at least one parameter, and below them all pairs of parameters that vary."""
    pair_samples = [sample for sample in samples if len(set(sample.to_numbers(sample.values).tolist())) > 1]
    pair_samples = pair_samples[:MAX_PAIRED]
    pairs_side = len(pair_samples) * _CELL_SIDE_IN if len(pair_samples) > 1 else 0.0
    width = max(min(len(samples), _MIN_PER_ROW) * _WIDTH_IN, pairs_side, 2.0 * _WIDTH_IN)
    n_columns = min(len(samples), int(width / _WIDTH_IN))
    n_rows = math.ceil(len(samples) / n_columns)
    upper_height = n_rows * _HEIGHT_IN + _HEADING_HEIGHT_IN
    lower_height = pairs_side + _HEADING_HEIGHT_IN if pairs_side else 0.0
    figure = Figure(figsize=(width + 2.0 * _MARGIN_IN, upper_height + lower_height))
    cases = count(len(samples[0].values), "case")
    heading = f"{title}: {cases} as sampled. Line: expected from the distribution"
    _write_heading(figure, upper_height + lower_height, heading)
    for index, sample in enumerate(samples):
        row, column = divmod(index, n_columns)
        left, bottom = _MARGIN_IN + column * width / n_columns, lower_height + (n_rows - 1 - row) * _HEIGHT_IN
        size = width / n_columns - _LEFT_IN - _RIGHT_IN, _HEIGHT_IN - _BOTTOM_IN - _TOP_IN
        _draw_marginal(_add_axes(figure, (left + _LEFT_IN, bottom + _BOTTOM_IN), size), sample)
    if pairs_side:
        _write_heading(figure, lower_height, "Pairs. Lower left: values; upper right: Spearman's rank correlation")
        left = _MARGIN_IN + 0.5 * (width - pairs_side)
        _draw_pairs(_add_axes(figure, (left, 0.5 * _MARGIN_IN), (pairs_side, pairs_side)), pair_samples)
    return figure


def _add_axes(figure: Figure, corner: tuple[float, float], size: tuple[float, float]) -> Axes:
    """Add axes at a position in inches; much faster than a layout engine for many panels."""
    width, height = figure.get_size_inches()
    return figure.add_axes((corner[0] / width, corner[1] / height, size[0] / width, size[1] / height))


def _write_heading(figure: Figure, top: float, text: str) -> None:
    width, height = figure.get_size_inches()
    figure.text(_MARGIN_IN / width, (top - 0.1) / height, text, fontsize=12, fontweight="bold", color=INK, va="top")


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure on white as SVG or PNG, by the file's ending; raises OSError if it cannot be written."""
    figure.savefig(path, dpi=RASTER_DPI, facecolor="white")


def _draw_marginal(axes: Axes, sample: ParameterSample) -> None:
    """Draw the distribution of a parameter, and the expected one."""
    categories, values = sample.categories, sample.to_numbers(sample.values)
    expected = None if sample.expected is None else sample.to_numbers(sample.expected)
    all_values = values if expected is None else np.concatenate([values, expected])
    levels = np.unique(all_values)
    are_round = levels.size <= _MAX_LEVELS and np.all(levels == np.round(levels, 9))
    # categories, constants and few round numbers as bars, other numbers as a histogram with about 1.5 sqrt(n) bins
    if categories is not None or levels.size == 1 or are_round:
        positions = np.arange(levels.size)
        axes.bar(positions, [(values == level).sum() for level in levels], width=0.7, color=SERIES[0])
        if expected is not None:
            heights = [(expected == level).mean() * values.size for level in levels]
            axes.plot(positions, heights, linestyle="none", marker="_", markersize=14, color=INK, markeredgewidth=1.6)
        names = [f"{level:g}" if categories is None else categories[int(level)] for level in levels]
        if len(names) <= _MAX_LABELS:
            axes.set_xticks(positions, [_shorten(name) for name in names])
    else:
        n_bins = min(_MAX_BINS, max(5, int(math.sqrt(values.size) * 1.5)))
        edges = np.linspace(all_values.min(), all_values.max(), n_bins + 1)
        axes.hist(values, bins=edges.tolist(), color=SERIES[0], alpha=0.85)
        if expected is not None:
            counts = np.histogram(expected, bins=edges)[0] * (values.size / expected.size)
            axes.stairs(counts, edges, color=INK, linewidth=1.4)
    axes.set_title(sample.name, fontsize=9)
    axes.set_ylim(0.0, None)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=4, integer=True))
    axes.tick_params(labelsize=8)


def _draw_pairs(axes: Axes, samples: Sequence[ParameterSample]) -> None:
    """Draw pairs of parameters: scatter in the lower left, rank correlations in the upper right."""
    n = len(samples)
    numbers = [sample.to_numbers(sample.values) for sample in samples]
    # each value is scaled to its cell of side 1, with margins of 0.08
    scaled = [0.08 + 0.84 * (values - values.min()) / np.ptp(values) for values in numbers]
    pairs = [(row, column) for row in range(n) for column in range(row)]
    x = np.concatenate([column + scaled[column] for row, column in pairs])
    y = np.concatenate([row + 1.0 - scaled[row] for row, column in pairs])
    marker_style: dict[str, Any] = {"s": 4.0, "color": SERIES[0], "alpha": 0.7, "linewidths": 0.0}
    axes.scatter(x, y, rasterized=x.size > MAX_VECTOR_POINTS, **marker_style)
    cells = [Rectangle((column + 0.03, row + 0.03), 0.94, 0.94) for row, column in pairs]
    axes.add_collection(PatchCollection(cells, facecolor="none", edgecolor=GRID, linewidth=0.8))
    for index, sample in enumerate(samples):
        axes.text(index + 0.5, index + 0.5, sample.short_name.replace("_", "\n"), fontsize=8, **_CENTERED_TEXT)
    for row, column in pairs:
        correlation = rank_correlation(numbers[row], numbers[column])
        if math.isnan(correlation):
            continue
        # bold above 3.3 standard deviations 1 / sqrt(n - 1) of the correlation of independent values (p = 0.001)
        is_significant = abs(correlation) > 3.3 / math.sqrt(max(numbers[0].size - 1, 1))
        text = f"{correlation + 0.0:+.2f}".replace("-", "−") if abs(correlation) >= 0.005 else "0.00"
        weight, color = ("bold", SERIES[1]) if is_significant else ("normal", MUTED)
        style = _CENTERED_TEXT | {"fontweight": weight, "color": color}
        axes.text(row + 0.5, column + 0.5, text, fontsize=8, **style)
    axes.set(xlim=(0, n), ylim=(n, 0))
    axes.set_axis_off()


def _shorten(name: str) -> str:
    """Shorten a label to `_MAX_LABEL_LENGTH` characters."""
    return name if len(name) <= _MAX_LABEL_LENGTH else f"{name[: _MAX_LABEL_LENGTH - 1]}…"


def _format_value(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str)
