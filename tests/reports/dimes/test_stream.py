"""A stream's case: its pictures, and what was known after each of them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard.reports.dimes.presentation import draw_stream_case, is_stream_case
from marsyard.reports.dimes.presentation import view_stream as view
from marsyard.reports.presentation import write_case_figures

PICTURES = 4


@pytest.fixture
def products() -> dict[str, Any]:
    """Four pictures; nothing is known after the first, then 0.5 m/s too much to the east, of the last interval."""
    numbers = np.arange(1.0, PICTURES)
    nothing = np.full((1, 2), np.nan)
    true = np.concatenate([nothing, np.stack([10.0 + numbers, -numbers], axis=1)])
    images = {f"image_{k}": np.random.default_rng(k).integers(0, 4095, (16, 64)) for k in range(1, PICTURES + 1)}
    return {
        **images,
        "after_spans_s": np.concatenate([nothing, np.stack([numbers - 1.0, numbers], axis=1)]),
        "after_velocities_m_s": true + np.array([0.5, 0.0]),
        "after_true_m_s": true,
        "velocity_true_m_s": true[-1],
    }


def test_every_picture_and_answer_is_drawn(products: dict[str, Any]) -> None:
    figure = draw_stream_case(products)
    axes = [one for part in figure.subfigs for one in part.axes]
    assert sum(bool(one.get_images()) for one in axes) == PICTURES
    east, north = axes[-2:]
    for component, (drawn, error) in enumerate(((east, 0.5), (north, 0.0))):
        answered = next(line for line in drawn.get_lines() if line.get_marker() not in ("None", "", "|"))
        np.testing.assert_allclose(np.asarray(answered.get_xdata()), np.array([0.5, 1.5, 2.5]))
        np.testing.assert_allclose(np.asarray(answered.get_ydata()), products["after_true_m_s"][1:, component] + error)


def test_a_case_is_reported_picture_by_picture(products: dict[str, Any], tmp_path: Path) -> None:
    shown = view(products, "case3")
    assert [row.succeeded for row in shown.rows] == [False, True, True, True]
    assert shown.rows[0].values[0] == "1"
    assert set(shown.rows[0].values[1:]) == {""}
    assert shown.rows[2].values[-1] == "0.500"
    assert [path.name for path in write_case_figures(tmp_path, products)] == ["stream.png"]


@pytest.mark.parametrize("lacking", ["image_3", "after_true_m_s", "after_spans_s"])
def test_what_is_no_such_case(products: dict[str, Any], lacking: str) -> None:
    assert is_stream_case(products)
    assert not is_stream_case({name: value for name, value in products.items() if name != lacking})
    assert not is_stream_case({**products, "after_true_m_s": products["after_true_m_s"][1:]})
