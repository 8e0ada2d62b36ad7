"""Sampled inputs as a figure, before anything is run: how often each value was drawn, and all pairs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
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

from marsyard.reports.columns import rank_correlation, split_unit
from marsyard.reports.svg import GRID, INK, LARGEST_VECTOR_SAMPLE, MUTED, RASTER_DPI, SERIES, in_page_style
from marsyard.reports.wording import count

#: Size of a marginal, and of a heading, and the figure's margin, inches; how many a row holds if there are that many.
_WIDTH, _HEIGHT, _HEAD, _MARGIN, _FEWEST_IN_ROW = 3.0, 1.9, 0.45, 0.15, 4
#: Side of a pair's cell, inches; pairs of more parameters than this are left out.
_SIDE, MOST_PAIRED = 0.95, 24
_CENTRED: Mapping[str, Any] = {"ha": "center", "va": "center", "color": INK}
#: More kinds than this are told by their numbers.
_MOST_NAMED = 8
_BINS = 24


@dataclass(frozen=True)
class Drawn:
    """What was drawn of one parameter.

    Attributes
    ----------
    path
        The parameter.
    values
        What each case drew.
    expected
        Quantiles of the distribution at evenly spread probabilities; None where it changes from case to case.
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
        """The end of its path, without unit; with the place where it is one of a list."""
        table, _, last = self.path.rpartition(".")
        return f"{table.rpartition('.')[2]}_{last}" if last.isdigit() else split_unit(last)[0]

    @property
    def kinds(self) -> list[str] | None:
        """The kinds of value, if they are no numbers; None where they are."""
        if all(_is_number(value) for value in self.values):
            return None
        return list(dict.fromkeys(_text(value) for value in [*(self.expected or ()), *self.values]))

    def numbers(self, values: Sequence[Any]) -> Float[np.ndarray, " n"]:
        """Values as numbers: the places of their kinds where they are none."""
        kinds = self.kinds
        return np.array([float(value) if kinds is None else float(kinds.index(_text(value))) for value in values])


@in_page_style
def draws_figure(title: str, drawn: Sequence[Drawn]) -> Figure:
    """Marginals of all parameters above, and below them all pairs of those that vary.

    Parameters
    ----------
    title
        What was drawn.
    drawn
        At least one parameter.
    """
    varying = [one for one in drawn if len(set(one.numbers(one.values).tolist())) > 1][:MOST_PAIRED]
    side = len(varying) * _SIDE if len(varying) > 1 else 0.0
    width = max(min(len(drawn), _FEWEST_IN_ROW) * _WIDTH, side, 2.0 * _WIDTH)
    in_row = min(len(drawn), int(width / _WIDTH))
    rows = math.ceil(len(drawn) / in_row)
    upper, lower = rows * _HEIGHT + _HEAD, side + _HEAD if side else 0.0
    figure = Figure(figsize=(width + 2.0 * _MARGIN, upper + lower))
    cases = count(len(drawn[0].values), "case")
    said = f"{title}: {cases} as drawn. Line: what the distribution leads to expect"
    _heading(figure, upper + lower, said)
    for place, one in enumerate(drawn):
        row, column = divmod(place, in_row)
        box = (_MARGIN + column * width / in_row + 0.3, lower + (rows - 1 - row) * _HEIGHT + 0.45)
        _marginal(_placed(figure, box, (width / in_row - 0.55, _HEIGHT - 0.85)), one)
    if side:
        _heading(figure, lower, "Pairs: below, one against the other; above, Spearman's rank correlation")
        left = _MARGIN + 0.5 * (width - side)
        _pairs(_placed(figure, (left, 0.5 * _MARGIN), (side, side)), varying)
    return figure


def _placed(figure: Figure, corner: tuple[float, float], size: tuple[float, float]) -> Axes:
    """Axes at a place given in inches: far quicker for so many panels than letting them be laid out."""
    width, height = figure.get_size_inches()
    return figure.add_axes((corner[0] / width, corner[1] / height, size[0] / width, size[1] / height))


def _heading(figure: Figure, top: float, text: str) -> None:
    """A heading whose upper edge lies so many inches above the figure's lower one."""
    width, height = figure.get_size_inches()
    figure.text(_MARGIN / width, (top - 0.1) / height, text, fontsize=12, fontweight="bold", color=INK, va="top")


def save_figure(figure: Figure, path: Path) -> None:
    """Writes a figure on white as SVG or PNG, by the file's ending.

    Raises
    ------
    OSError
        Where the file cannot be written.
    """
    figure.savefig(path, dpi=RASTER_DPI, facecolor="white")


def _marginal(axes: Axes, drawn: Drawn) -> None:
    """How often which value was drawn, with what its distribution leads to expect."""
    kinds, values = drawn.kinds, drawn.numbers(drawn.values)
    expected = None if drawn.expected is None else drawn.numbers(drawn.expected)
    levels = np.unique(values if expected is None else np.concatenate([values, expected]))
    if kinds is not None or (levels.size <= 12 and np.all(levels == np.round(levels, 9))):
        _bars(axes, levels, values, expected, kinds)
    else:
        _histogram(axes, values, expected)
    axes.set_title(drawn.name, fontsize=9)
    axes.set_ylim(0.0, None)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=4, integer=True))
    axes.tick_params(labelsize=8)


def _bars(
    axes: Axes,
    levels: Float[np.ndarray, " levels"],
    values: Float[np.ndarray, " n"],
    expected: Float[np.ndarray, " m"] | None,
    kinds: list[str] | None,
) -> None:
    places = np.arange(levels.size)
    axes.bar(places, [(values == level).sum() for level in levels], width=0.7, color=SERIES[0])
    if expected is not None:
        heights = [(expected == level).mean() * values.size for level in levels]
        axes.plot(places, heights, linestyle="none", marker="_", markersize=14, color=INK, markeredgewidth=1.6)
    names = [f"{level:g}" for level in levels] if kinds is None else [kinds[int(level)] for level in levels]
    if len(names) <= _MOST_NAMED:
        axes.set_xticks(places, [name if len(name) <= 14 else f"{name[:13]}…" for name in names])


def _histogram(axes: Axes, values: Float[np.ndarray, " n"], expected: Float[np.ndarray, " m"] | None) -> None:
    known = values if expected is None else np.concatenate([values, expected])
    low, high = float(known.min()), float(known.max())
    edges = np.linspace(low, high, min(_BINS, max(5, int(math.sqrt(values.size) * 1.5))) + 1)
    axes.hist(values, bins=edges.tolist(), color=SERIES[0], alpha=0.85)
    if expected is not None:
        heights = np.histogram(expected, bins=edges)[0] * (values.size / expected.size)
        axes.stairs(heights, edges, color=INK, linewidth=1.4)


def _pairs(axes: Axes, drawn: Sequence[Drawn]) -> None:
    """A square of cells. Lower left: one against another. Upper right: the rank correlation of what was drawn."""
    size = len(drawn)
    numbers = [one.numbers(one.values) for one in drawn]
    shares = [0.08 + 0.84 * (values - values.min()) / np.ptp(values) for values in numbers]
    below = [(row, column) for row in range(size) for column in range(row)]
    x = np.concatenate([column + shares[column] for row, column in below])
    y = np.concatenate([row + 1.0 - shares[row] for row, column in below])
    marks: dict[str, Any] = {"s": 4.0, "color": SERIES[0], "alpha": 0.7, "linewidths": 0.0}
    axes.scatter(x, y, rasterized=x.size > LARGEST_VECTOR_SAMPLE, **marks)
    cells = [Rectangle((column + 0.03, row + 0.03), 0.94, 0.94) for row, column in below]
    axes.add_collection(PatchCollection(cells, facecolor="none", edgecolor=GRID, linewidth=0.8))
    for place, one in enumerate(drawn):
        axes.text(place + 0.5, place + 0.5, one.short_name.replace("_", "\n"), fontsize=8, **_CENTRED)
    for row, column in below:
        _correlation(axes, (row + 0.5, column + 0.5), rank_correlation(numbers[row], numbers[column]), numbers[0].size)
    axes.set(xlim=(0, size), ylim=(size, 0))
    axes.set_axis_off()


def _correlation(axes: Axes, place: tuple[float, float], found: float, size: int) -> None:
    """A correlation as a number, in bold where chance alone would hardly make it: beyond 3.3 / sqrt(n - 1)."""
    if math.isnan(found):
        return
    beyond = abs(found) > 3.3 / math.sqrt(max(size - 1, 1))
    text = f"{found + 0.0:+.2f}".replace("-", "−") if abs(found) >= 0.005 else "0.00"
    weight, colour = ("bold", SERIES[1]) if beyond else ("normal", MUTED)
    axes.text(*place, text, fontsize=8, fontweight=weight, **{**_CENTRED, "color": colour})


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _text(value: Any) -> str:
    """A value as the figure and the terminal name it."""
    return value if isinstance(value, str) else json.dumps(value, default=str)
