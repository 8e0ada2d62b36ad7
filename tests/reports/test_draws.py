"""Tests of the figure of sampled inputs: marginals, pairs and significant correlations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.collections import PathCollection
from matplotlib.patches import Rectangle

from marsyard.reports.draws import ParameterSample, draws_figure, save_figure


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
