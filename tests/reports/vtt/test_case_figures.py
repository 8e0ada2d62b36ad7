"""Pictures of a tracking case: what is drawn where, and what is shown where something is missing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from marsyard.reports.presentation import write_case_figures
from marsyard.reports.vtt.case_figures import TARGET, WINDOW, draw_path, draw_stops, is_vtt_case, path_of, stops_of
from marsyard.reports.vtt.presentation import view
from tests.reports.vtt.tracking_rows import products


def _squares(figure: Figure, colour: str) -> list[Rectangle]:
    drawn = [patch for axes in figure.axes for patch in axes.patches if isinstance(patch, Rectangle)]
    return [patch for patch in drawn if patch.get_edgecolor() == to_rgba(colour)]


def test_squares_stand_on_the_target_and_the_window() -> None:
    figure = draw_stops(products())
    left, right = _squares(figure, TARGET)[:2]
    # Found at (480, 370) of a subframe that begins at (400, 300); pixels are drawn about their middles.
    assert left.get_xy() == (80.0 - 10.5, 70.0 - 10.5)
    assert (left.get_width(), left.get_height()) == (21.0, 21.0)
    assert right.get_xy() == (70.0 - 10.5, 69.0 - 10.5)
    assert len(_squares(figure, TARGET)) == 4  # none at the stop that lost the target
    window = _squares(figure, WINDOW)[0]
    assert (window.get_xy(), window.get_width()) == ((9.5, 9.5), 141.0)
    assert window.get_linestyle() != left.get_linestyle()  # not told by colour alone


def test_what_was_found_is_enlarged() -> None:
    kept = products()
    counts = np.zeros((161, 161), dtype=np.uint16)
    counts[70, 80] = 4000
    figure = draw_stops(kept | {"stop_1_left": counts})
    enlarged = np.asarray(figure.axes[1].get_images()[0].get_array())[..., 0]
    bright = np.argwhere(enlarged > 128)
    # One of 21 pixels over 126 drawn ones: six in the middle.
    assert bright.min(axis=0).tolist() == [60, 60]
    assert bright.max(axis=0).tolist() == [65, 65]


def test_numbers_stand_above_their_stop() -> None:
    figure = draw_stops(products())
    titles = [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]
    assert titles[0].startswith("1: 10.00 m, azimuth +0.0°")  # no minus before nought
    assert titles[1].startswith("2: 6.00 m")
    assert "NCC 0.90" in titles[1]
    assert titles[2].startswith("3 (lost): 2.00 m")
    assert "not found" in [text.get_text() for axes in figure.axes for text in axes.texts]


def test_a_few_stops_hold_the_first_and_the_last() -> None:
    titles = [axes.get_title(loc="left") for axes in draw_stops(products(9), max_stops=4).axes]
    assert [title.split(":")[0].split(" ")[0] for title in titles if title] == ["1", "4", "6", "9"]


def test_the_way_and_the_estimates_are_drawn_in_their_places() -> None:
    above, close = draw_path(products(4)).axes
    drawn = {line.get_label(): np.column_stack(line.get_data()) for line in above.lines}
    assert drawn["stops"][-1].tolist() == [8.0, 0.0]
    assert drawn["stops as believed"][0].tolist() == pytest.approx([0.05, 0.05])
    assert drawn["designated target"].tolist() == [[10.0, 0.0]]
    # Three of four stops found it, 0, 3 and 6 cm east of the designated point.
    (name,) = [str(line.get_label()) for line in close.lines if "estimated" in str(line.get_label())]
    assert name == "target as estimated (6 cm from first to last)"
    offsets = next(np.column_stack(line.get_data()) for line in close.lines if line.get_label() == name)
    assert offsets == pytest.approx(np.array([[0.0, 0.0], [3.0, 0.0], [6.0, 0.0]]), abs=1e-9)
    for axes in (above, close):
        assert axes.get_aspect() == 1.0


def test_figures_are_written(tmp_path: Path) -> None:
    paths = write_case_figures(tmp_path, products())
    assert [path.name for path in paths] == ["stops.png", "way.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)
    assert [path.name for path in write_case_figures(tmp_path, products() | {"target_m": None})] == ["stops.png"]


@pytest.mark.parametrize(
    "changes",
    [
        {"figures": None},
        {"figures": {"range_m": "far", "azimuth_deg": [1.0]}},
        {"states": "lost", "stop_1_right": None},
        {"stop_1_corners": None, "stop_2_window": np.zeros(3), "stop_1_point": "there"},
        {"stop_1_left": np.zeros((161, 161)), "stop_2_found": None},
        {"rocks_m": None, "heading_deg": None, "path_true_m": np.empty((0, 2))},
        {"target_believed_m": np.full((3, 3), np.nan)},
    ],
)
def test_cases_with_parts_missing(changes: dict[str, Any]) -> None:
    kept = products() | changes
    assert draw_stops(kept).axes
    assert draw_path(kept).axes
    assert len(view(kept, "case1").rows) == 3


def test_what_is_no_tracking_case() -> None:
    assert is_vtt_case(products())
    assert not is_vtt_case({})
    assert not is_vtt_case(products() | {"template_px": None})
    assert stops_of({}) == []
    assert path_of(products() | {"rover_true_m": np.zeros((2, 3))}) is None
    with pytest.raises(ValueError, match="no picture"):
        draw_stops({})
    with pytest.raises(ValueError, match="no way"):
        draw_path({})


def test_the_page_shows_every_stop_in_its_table() -> None:
    shown = view(products(), "case7")
    assert [row.succeeded for row in shown.rows] == [True, True, False]
    assert shown.head == ["Stop", "State", "range (m)", "azimuth (deg)", "match score"]
    assert list(shown.rows[1].values)[:3] == ["2", "normal", "6.000"]
