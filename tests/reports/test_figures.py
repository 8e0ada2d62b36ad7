from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from reports.dimes_figures import MATCH, TEMPLATE, draw_dimes_case, draw_dimes_pair, is_dimes_case, tracks
from reports.figures import (
    error_against,
    error_distribution,
    error_histogram,
    error_scatter,
    outcome_bars,
)
from reports.svg import svg_markup

Rows = Callable[..., pd.DataFrame]
METRIC = "velocity_error_m_s"


def _all_figures(frame: pd.DataFrame, bound: float | None) -> list[Figure | None]:
    return [
        error_scatter(frame, METRIC, bound),
        error_scatter(frame, METRIC, bound, close=True),
        error_histogram(frame, METRIC, bound),
        error_distribution(frame, METRIC, bound),
        error_against(frame, METRIC, "off_nadir_max_deg", bound),
        outcome_bars(frame),
    ]


@pytest.mark.parametrize(("cases", "bound"), [(1, 5.0), (24, None), (24, 0.0), (1500, 5.0)])
def test_figures_are_well_formed(make_rows: Rows, cases: int, bound: float | None) -> None:
    for place, figure in enumerate(_all_figures(make_rows(cases, answered=1.0), bound)):
        assert figure is not None
        root = ET.fromstring(svg_markup(figure, f"f{place}", 'errors & "more" <of them>'))  # noqa: S314  (our own)
        assert root.get("aria-label") == 'errors & "more" <of them>'
        assert root.get("viewBox")


def test_figures_of_what_is_not_there(make_rows: Rows) -> None:
    silent = make_rows(5, answered=0.0)
    assert error_scatter(silent, METRIC, 5.0) is None
    assert error_histogram(silent, METRIC, 5.0) is None
    assert error_against(silent, METRIC, "off_nadir_max_deg", 5.0) is not None
    assert error_against(silent, METRIC, "nonesuch", 5.0) is None
    bare = pd.DataFrame({"case": [0, 1], METRIC: [1.0, 2.0]})
    assert error_scatter(bare, METRIC, 5.0) is None
    assert outcome_bars(bare) is None
    assert error_histogram(bare, METRIC, 5.0) is not None


def test_identifiers_of_figures_are_apart(make_rows: Rows) -> None:
    figure = error_histogram(make_rows(24), METRIC, 5.0)
    assert figure is not None
    names = [
        {element.get("id") for element in ET.fromstring(svg_markup(figure, key, "")).iter() if element.get("id")}  # noqa: S314
        for key in ("one", "two")
    ]
    assert names[0]
    assert not names[0] & names[1]


def test_same_rows_same_bytes(make_rows: Rows) -> None:
    frame = make_rows(24)
    first, second = (svg_markup(error_scatter(frame, METRIC, 5.0) or Figure(), "s", "") for _ in range(2))
    assert first == second


def test_scatter_shows_the_requirement_to_scale(make_rows: Rows) -> None:
    figure = error_scatter(make_rows(24), METRIC, 5.0)
    assert figure is not None
    (circle,) = figure.axes[0].patches
    assert circle.get_radius() == 5.0  # type: ignore[attr-defined]
    assert figure.axes[0].get_aspect() == 1.0


def test_hostile_texts_are_drawn_as_text(make_rows: Rows) -> None:
    frame = make_rows(6).assign(outcome="<script>alert(1)</script> $\\frac$ \N{PILE OF POO}")
    figure = outcome_bars(frame)
    assert figure is not None
    markup = svg_markup(figure, "x", "")
    assert "<script>" not in markup
    assert "&lt;script&gt;" in markup
    assert "$\\frac$" in markup


def _squares(figure: Figure, colour: str) -> list[Rectangle]:
    from matplotlib.colors import to_rgba

    drawn = [patch for axes in figure.axes for patch in axes.patches if isinstance(patch, Rectangle)]
    return [patch for patch in drawn if patch.get_edgecolor() == to_rgba(colour)]


def test_dimes_case(dimes_products: dict[str, Any]) -> None:
    figure = draw_dimes_case(dimes_products)
    # Four templates; four matches in the pictures and four in the windows; the last track is not valid, hence dashed.
    assert len(_squares(figure, TEMPLATE)) == 4
    assert len(_squares(figure, MATCH)) == 8
    assert sum(patch.get_linestyle() != "-" for patch in _squares(figure, TEMPLATE)) == 1


def test_dimes_pictures_are_binned_to_square_pixels(dimes_products: dict[str, Any]) -> None:
    figure = draw_dimes_pair(dimes_products, 0)
    sizes = [image.get_size() for axes in figure.axes for image in axes.get_images()]
    assert sizes == [(17, 17), (61, 61), (17, 17), (61, 61), (256, 256), (256, 256)]


def test_squares_stand_where_the_tracks_are(dimes_products: dict[str, Any]) -> None:
    table = np.asarray(dimes_products["tracks"])
    square = _squares(draw_dimes_pair(dimes_products, 0), TEMPLATE)[0]
    middle = (square.get_x() + square.get_width() / 2, square.get_y() + square.get_height() / 2)
    assert middle == pytest.approx(tuple(table[0, 2:4]))


@pytest.mark.parametrize(
    "changes",
    [
        {"tracks": None},
        {"tracks": "none"},
        {"tracks": np.zeros((0, 13))},
        {"tracks_columns": ["pair"]},
        {"tracks": [[np.nan] * 13]},
        {"template_0_0": None, "window_0_1": "lost", "match_1_0": [1.0]},
        {"image_1": np.zeros((256, 256), dtype=np.uint16)},
        {"image_2": np.full((8, 8), np.nan)},
    ],
)
def test_dimes_case_with_parts_missing(dimes_products: dict[str, Any], changes: dict[str, Any]) -> None:
    assert draw_dimes_case({**dimes_products, **changes}).axes


def test_what_is_no_dimes_case(dimes_products: dict[str, Any]) -> None:
    assert is_dimes_case(dimes_products)
    assert not is_dimes_case({})
    assert not is_dimes_case({**dimes_products, "image_3": np.zeros(3)})
    assert tracks({}) == []
    with pytest.raises(ValueError, match="image_3"):
        draw_dimes_pair({**dimes_products, "image_3": None}, 1)
