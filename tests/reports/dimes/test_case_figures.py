"""Pictures of a DIMES case: what is drawn where."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from marsyard.reports.dimes.case_figures import (
    MATCH,
    TEMPLATE,
    WINDOW,
    draw_dimes_case,
    draw_dimes_pair,
    is_dimes_case,
    tracks,
    write_dimes_figures,
)
from marsyard.reports.dimes.presentation import view
from marsyard.reports.presentation import write_case_figures


def _squares(figure: Figure, colour: str) -> list[Rectangle]:
    drawn = [patch for axes in figure.axes for patch in axes.patches if isinstance(patch, Rectangle)]
    return [patch for patch in drawn if patch.get_edgecolor() == to_rgba(colour)]


def _middle(square: Rectangle) -> tuple[float, float]:
    return square.get_x() + square.get_width() / 2, square.get_y() + square.get_height() / 2


def test_dimes_case(dimes_products: dict[str, Any]) -> None:
    figure = draw_dimes_case(dimes_products)
    # Four templates, four windows and four matches, in the pictures and in the rectified ones, and the matches in the
    # windows too; the last track is not valid, hence dashed.
    assert len(_squares(figure, TEMPLATE)) == 8
    assert len(_squares(figure, WINDOW)) == 4
    assert len(_squares(figure, MATCH)) == 12
    assert sum(patch.get_linestyle() != "-" for patch in _squares(figure, TEMPLATE)) == 2


def test_dimes_pictures_are_binned_to_square_pixels(dimes_products: dict[str, Any]) -> None:
    figure = draw_dimes_pair(dimes_products, 0)
    sizes = [image.get_size() for axes in figure.axes for image in axes.get_images()]
    patches = [(17, 17), (61, 61), (17, 17), (61, 61)]
    assert sizes == [(384, 384), (384, 384), *patches, (256, 256), (256, 256)]


def test_squares_stand_where_the_tracks_are(dimes_products: dict[str, Any]) -> None:
    table = np.asarray(dimes_products["tracks"])
    rectified, _, square, _ = _squares(draw_dimes_pair(dimes_products, 0), TEMPLATE)
    assert _middle(square) == pytest.approx(tuple(table[0, 2:4]))
    # The virtual camera is the picture's own, shifted by 64 px: 384 drawn pixels over 384 of the picture's.
    assert _middle(rectified) == pytest.approx(tuple(table[0, 2:4] + 64.0))
    assert rectified.get_width() == pytest.approx(17.0)


def test_rectified_tracks_stand_in_their_windows(dimes_products: dict[str, Any]) -> None:
    figure = draw_dimes_pair(dimes_products, 0)
    window, match = _squares(figure, WINDOW)[0], _squares(figure, MATCH)[0]
    # Matched at row 33.4 and column 39.2 of a window of 61.
    offset = np.array(_middle(match)) - np.array(_middle(window))
    assert offset == pytest.approx([39.2 - 30.0, 33.4 - 30.0])
    assert window.get_width() == pytest.approx(61.0)


def test_rectification_shows_the_picture_through_the_lattice(dimes_products: dict[str, Any]) -> None:
    counts = np.zeros((256, 256))
    counts[100:110, 40:60] = 1000.0
    figure = draw_dimes_pair({**dimes_products, "image_1": counts}, 0)
    shown = np.asarray(figure.axes[0].get_images()[0].get_array())[..., 0]
    bright = np.argwhere(shown > 128)
    assert bright.min(axis=0).tolist() == [164, 104]
    assert bright.max(axis=0).tolist() == [173, 123]


def test_figure_of_a_case_is_written(dimes_products: dict[str, Any], tmp_path: Path) -> None:
    (path,) = write_case_figures(tmp_path, dimes_products)
    assert path == tmp_path / "dimes.png"
    assert path.read_bytes().startswith(b"\x89PNG")
    assert write_case_figures(tmp_path, {}) == []


@pytest.mark.parametrize(
    "changes",
    [
        {"tracks": None},
        {"tracks": "none"},
        {"tracks": np.zeros((0, 17))},
        {"tracks_columns": ["pair"]},
        {"tracks": [[np.nan] * 17]},
        {"template_0_0": None, "window_0_1": "lost", "match_1_0": [1.0]},
        {"image_1": np.zeros((256, 256), dtype=np.uint16)},
        {"image_2": np.full((8, 8), np.nan)},
        {"rectified_0_0": np.zeros((3, 3)), "rectified_frame_1": None, "gsd_0": "none"},
        {"rectified_0_0": np.full((9, 9, 2), np.nan)},
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


def test_a_case_without_details_shows_its_pictures_alone(dimes_products: dict[str, Any]) -> None:
    plain = {name: value for name, value in dimes_products.items() if name.startswith(("image_", "velocity_"))}
    shown = view(plain, "k")
    (pictures,) = shown.plates
    assert pictures.wide
    assert "templates" not in str(pictures.svg)
    assert "Picture 3" in str(pictures.svg)
    assert (shown.head, shown.rows) == ([], [])
    assert shown.legend is not None
    assert "squares mark" not in shown.legend
    assert [name for name, _ in shown.facts] == ["Estimated velocity", "True velocity"]


def test_figures_leave_out_rows_that_have_nothing_to_show(dimes_products: dict[str, Any]) -> None:
    # a case that ended before any template was chosen
    early = {name: value for name, value in dimes_products.items() if name.startswith("image_")}
    early |= {"tracks": np.zeros((0, 13)), "tracks_columns": dimes_products["tracks_columns"]}
    whole, short = (draw_dimes_pair(products, 0) for products in (dimes_products, early))
    assert len(short.get_axes()) == 2
    assert short.get_figheight() < 0.5 * whole.get_figheight()


def test_replay_writes_the_pictures_of_a_case_without_details(dimes_products: dict[str, Any], tmp_path: Path) -> None:
    plain = {name: value for name, value in dimes_products.items() if name.startswith("image_")}
    assert write_dimes_figures(tmp_path, plain) == [tmp_path / "pictures.png"]
    assert (tmp_path / "pictures.png").stat().st_size > 1000
