"""Tests of the figures of an image stream and its velocity estimates."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard.reports.dimes.stream_case import draw_stream_case, is_stream_case, view_stream
from marsyard.reports.presentation import write_case_figures

N_IMAGES = 4


@pytest.fixture
def products() -> dict[str, Any]:
    """Return four images. Each later image has an estimate for the interval before it, 0.5 m/s too large in x."""
    interval_ends_s = np.arange(1.0, N_IMAGES)
    no_interval = np.full((1, 2), np.nan)
    true_velocities = np.concatenate([no_interval, np.stack([10.0 + interval_ends_s, -interval_ends_s], axis=1)])
    images = {
        f"image_{number}": np.random.default_rng(number).integers(0, 4095, (16, 64))
        for number in range(1, N_IMAGES + 1)
    }
    return {
        **images,
        "after_spans_s": np.concatenate([no_interval, np.stack([interval_ends_s - 1.0, interval_ends_s], axis=1)]),
        "after_velocities_m_s": true_velocities + np.array([0.5, 0.0]),
        "after_true_m_s": true_velocities,
        "velocity_true_m_s": true_velocities[-1],
    }


def test_all_images_and_estimates_are_drawn(products: dict[str, Any]) -> None:
    figure = draw_stream_case(products)
    axes = [panel for subfigure in figure.subfigs for panel in subfigure.axes]
    assert sum(bool(panel.get_images()) for panel in axes) == N_IMAGES
    east, north = axes[-2:]
    for component, (plot, error) in enumerate(((east, 0.5), (north, 0.0))):
        estimates = next(line for line in plot.get_lines() if line.get_marker() not in ("None", "", "|"))
        np.testing.assert_allclose(np.asarray(estimates.get_xdata()), np.array([0.5, 1.5, 2.5]))
        np.testing.assert_allclose(np.asarray(estimates.get_ydata()), products["after_true_m_s"][1:, component] + error)


def test_case_view_has_one_row_per_image(products: dict[str, Any], tmp_path: Path) -> None:
    case_view = view_stream(products)
    assert [row.succeeded for row in case_view.rows] == [False, True, True, True]
    assert case_view.rows[0].values[0] == "1"
    assert set(case_view.rows[0].values[1:]) == {""}
    assert case_view.rows[2].values[-1] == "0.500"
    assert [path.name for path in write_case_figures(tmp_path, products)] == ["stream.png"]


@pytest.mark.parametrize("missing", ["image_3", "after_true_m_s", "after_spans_s"])
def test_incomplete_products_are_not_a_stream(products: dict[str, Any], missing: str) -> None:
    assert is_stream_case(products)
    assert not is_stream_case({name: value for name, value in products.items() if name != missing})
    assert not is_stream_case({**products, "after_true_m_s": products["after_true_m_s"][1:]})
