"""Tests of the figures of errors and outcomes, and of sampled inputs.

An error axis ends at most at 3 times the bound (15 m/s for 5 m/s), unless more than a quarter of the errors exceed it.
"""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from marsyard.reports.draws import ParameterSample, draws_figure, save_figure
from marsyard.reports.figure_style import svg_markup
from marsyard.reports.figures import (
    count_beyond_axis,
    error_distribution,
    error_histogram,
    error_scatter,
    error_scatter_against,
    outcome_bars,
)
from tests.reports.synthetic_run import make_rows

METRIC = "velocity_error_m_s"


def _draw_all_figures(frame: pd.DataFrame, bound: float | None) -> list[Figure | None]:
    return [
        error_scatter(frame, METRIC, bound),
        error_scatter(frame, METRIC, bound, enlarged=True),
        error_histogram(frame, METRIC, bound),
        error_distribution(frame, METRIC, bound),
        error_scatter_against(frame, METRIC, "off_nadir_max_deg", bound),
        outcome_bars(frame),
    ]


@pytest.mark.slow
@pytest.mark.parametrize(("cases", "bound"), [(1, 5.0), (24, None), (24, 0.0), (1500, 5.0)])
def test_figures_are_well_formed(cases: int, bound: float | None) -> None:
    for index, figure in enumerate(_draw_all_figures(make_rows(cases, answer_rate=1.0), bound)):
        assert figure is not None
        root = ET.fromstring(svg_markup(figure, f"f{index}", 'errors & "more" <of them>'))  # noqa: S314
        assert root.get("aria-label") == 'errors & "more" <of them>'
        assert root.get("viewBox")


def test_all_figures_have_the_style_of_the_page() -> None:
    for figure in _draw_all_figures(make_rows(24, answer_rate=1.0), 5.0):
        assert figure is not None
        # the page's style has no upper spine; matplotlib's own style has one
        assert not figure.axes[0].spines["top"].get_visible()


def test_missing_data_give_no_figure() -> None:
    frame = make_rows(5, answer_rate=0.0)
    assert error_scatter(frame, METRIC, 5.0) is None
    assert error_histogram(frame, METRIC, 5.0) is None
    assert error_scatter_against(frame, METRIC, "off_nadir_max_deg", 5.0) is not None
    assert error_scatter_against(frame, METRIC, "no_such_column", 5.0) is None
    without_outcomes = pd.DataFrame({"case": [0, 1], METRIC: [1.0, 2.0]})
    assert error_scatter(without_outcomes, METRIC, 5.0) is None
    assert outcome_bars(without_outcomes) is None
    assert error_histogram(without_outcomes, METRIC, 5.0) is not None


def test_figures_have_distinct_identifiers() -> None:
    figure = error_histogram(make_rows(24), METRIC, 5.0)
    assert figure is not None
    names = [
        {element.get("id") for element in ET.fromstring(svg_markup(figure, key, "")).iter() if element.get("id")}  # noqa: S314
        for key in ("one", "two")
    ]
    assert names[0]
    assert not names[0] & names[1]


def test_figures_are_reproducible() -> None:
    frame = make_rows(24)
    first, second = (svg_markup(error_scatter(frame, METRIC, 5.0) or Figure(), "s", "") for _ in range(2))
    assert first == second


def test_scatter_shows_the_bound_as_a_circle() -> None:
    figure = error_scatter(make_rows(24), METRIC, 5.0)
    assert figure is not None
    circles = [patch for patch in figure.axes[0].patches if isinstance(patch, Circle)]
    assert 5.0 in [circle.get_radius() for circle in circles]
    assert figure.axes[0].get_aspect() == 1.0


def test_texts_in_figures_are_escaped() -> None:
    frame = make_rows(6).assign(outcome="<script>alert(1)</script> $\\frac$ \N{ROCKET}")
    figure = outcome_bars(frame)
    assert figure is not None
    markup = svg_markup(figure, "x", "")
    assert "<script>" not in markup
    assert "&lt;script&gt;" in markup
    assert "$\\frac$" in markup


def _scale_errors(frame: pd.DataFrame, rows: slice) -> pd.DataFrame:
    """Multiply the errors of some rows by 100."""
    error_columns = [METRIC, "velocity_error_x_m_s", "velocity_error_y_m_s"]
    frame.loc[frame.index[rows], error_columns] *= 100.0
    return frame


def test_histogram_has_an_overflow_bar() -> None:
    frame = _scale_errors(make_rows(60, answer_rate=1.0), slice(0, 60, 12))
    figure = error_histogram(frame, METRIC, 5.0)
    assert figure is not None
    bars = [patch for patch in figure.axes[0].patches if isinstance(patch, Rectangle)]
    (overflow,) = [bar for bar in bars if bar.get_hatch()]
    assert overflow.get_height() == (frame[METRIC] > 15.0).sum() >= 4
    # the other bars end at the largest error on the axis
    assert sum(bar.get_height() for bar in bars) == 60
    largest = frame[METRIC][frame[METRIC] <= 15.0].max()
    assert max(bar.get_x() + bar.get_width() for bar in bars if bar is not overflow) == pytest.approx(largest)
    assert any("> 15" in text.get_text() for text in figure.axes[0].texts)


def test_error_axis_is_extended_to_the_95_percent_quantile() -> None:
    frame = _scale_errors(make_rows(60, answer_rate=1.0), slice(None))
    for draw in (error_histogram, error_distribution):
        figure = draw(frame, METRIC, 5.0)
        assert figure is not None
        assert figure.axes[0].get_xlim()[1] >= frame[METRIC].quantile(0.95)
    distribution = error_distribution(frame, METRIC, 5.0)
    assert distribution is not None
    axes = distribution.axes[0]
    errors, fractions = (np.asarray(values) for values in axes.lines[0].get_data())
    assert fractions[errors <= axes.get_xlim()[1]].max() > 0.9
    assert any("beyond" in text.get_text() for text in axes.texts)


def _count_hollow_marks(figure: Figure) -> int:
    lines = [line for line in figure.axes[0].lines if line.get_markerfacecolor() == "none"]
    return sum(np.size(line.get_xdata()) for line in lines)


def test_points_beyond_the_axes_are_marked_and_counted() -> None:
    frame = _scale_errors(make_rows(60, answer_rate=1.0), slice(0, 60, 12))
    figure = error_scatter(frame, METRIC, 5.0)
    assert figure is not None
    count = _count_hollow_marks(figure)
    assert count >= 4
    legend = figure.axes[0].get_legend()
    assert legend is not None
    assert f"{count} beyond the axes" in [text.get_text() for text in legend.texts]
    driver_figure = error_scatter_against(frame, METRIC, "off_nadir_max_deg", 5.0)
    assert driver_figure is not None
    assert (
        _count_hollow_marks(driver_figure)
        == count_beyond_axis(frame, METRIC, "off_nadir_max_deg", 5.0)
        == (frame[METRIC] > 15.0).sum()
    )


def test_constant_parameter_has_a_visible_bar() -> None:
    figure = draws_figure("constant", [ParameterSample("sun.optical_depth", [1.0 / 3.0] * 20)])
    (bar,) = (patch for patch in figure.axes[0].patches if isinstance(patch, Rectangle))
    assert bar.get_width() == pytest.approx(0.7)
    assert bar.get_height() == 20.0


def _make_draws() -> list[ParameterSample]:
    rng = np.random.default_rng(1)
    wind_east = rng.normal(size=300)
    # correlation of the wind components: 0.9 / sqrt(0.9^2 + 0.1^2) = 0.99; other parameters are independent or constant
    return [
        ParameterSample("wind.east_m_s", wind_east.tolist(), rng.normal(size=1000).tolist()),
        ParameterSample("wind.north_m_s", (0.9 * wind_east + 0.1 * rng.normal(size=300)).tolist()),
        ParameterSample("heights_m.1", rng.uniform(size=300).tolist()),
        ParameterSample(
            "kind", [["rough", "plain", {"a": 1}][index % 3] for index in range(300)], ["rough", "plain", {"a": 1}]
        ),
        ParameterSample("sleep_s", [0.0] * 300),
    ]


def test_figure_shows_marginals_and_pairs() -> None:
    figure = draws_figure("a campaign", _make_draws())
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles[:5] == ["wind.east (m/s)", "wind.north (m/s)", "heights_m.1", "kind", "sleep (s)"]
    bars = [[patch for patch in axes.patches if isinstance(patch, Rectangle)] for axes in figure.axes[:5]]
    assert [sum(bar.get_height() for bar in group) for group in bars] == [300.0] * 5
    pair_axes = figure.axes[5]
    texts = {text.get_text(): text.get_fontweight() for text in pair_axes.texts}
    assert {"east", "north", "heights\nm\n1", "kind"} <= set(texts)
    assert [text for text, weight in texts.items() if weight == "bold"] == ["+0.99"]
    points = next(collection for collection in pair_axes.collections if isinstance(collection, PathCollection))
    # four parameters vary: six pairs
    assert np.shape(points.get_offsets())[0] == 6 * 300


def test_figure_of_one_parameter_has_no_pairs(tmp_path: Path) -> None:
    figure = draws_figure("[a] $x$", _make_draws()[:1])
    assert len(figure.axes) == 1
    for name in ("one.svg", "one.png"):
        save_figure(figure, tmp_path / name)
        assert (tmp_path / name).stat().st_size > 1000
