"""Tests of the figures of a tracking case: positions, titles and missing products."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from marsyard.reports.presentation import write_case_figures
from marsyard.reports.vtt.case_figures import TARGET, WINDOW, draw_path, draw_stops
from marsyard.reports.vtt.case_products import is_vtt_case, read_rover_path, read_stops
from marsyard.reports.vtt.presentation import view
from tests.reports.drawn_marks import find_boxes
from tests.reports.vtt.tracking_rows import make_products


def test_squares_mark_target_and_search_window() -> None:
    figure = draw_stops(make_products())
    # the axes are the left subframes and enlarged matches of three stops, then the right subframes
    left_square, right_square = find_boxes(figure.axes[0], TARGET)[0], find_boxes(figure.axes[6], TARGET)[0]
    # match at (480, 370), subframe origin at (400, 300), template of 21 pixels about the pixel centre
    assert left_square.corner.tolist() == [80.0 - 10.5, 70.0 - 10.5]
    assert left_square.size.tolist() == [21.0, 21.0]
    assert right_square.corner.tolist() == [70.0 - 10.5, 69.0 - 10.5]
    assert len(find_boxes(figure, TARGET)) == 4  # no square at the stop that lost the target
    window = find_boxes(figure, WINDOW)[0]
    assert (*window.corner, window.size[0]) == (9.5, 9.5, 141.0)
    assert window.is_dashed != left_square.is_dashed  # distinct without colour


def test_template_around_the_match_is_enlarged() -> None:
    case_products = make_products()
    counts = np.zeros((161, 161), dtype=np.uint16)
    counts[70, 80] = 4000
    figure = draw_stops(case_products | {"stop_1_left": counts})
    enlarged_template = np.asarray(figure.axes[1].get_images()[0].get_array())[..., 0]
    bright = np.argwhere(enlarged_template > 128)
    # 21 pixels are enlarged to 126: one bright pixel becomes 6 x 6 pixels
    assert bright.min(axis=0).tolist() == [60, 60]
    assert bright.max(axis=0).tolist() == [65, 65]


def test_titles_contain_range_roll_and_match_score() -> None:
    case_products = make_products()
    case_products["figures"]["roll_change_deg"] = np.array([np.nan, -0.04, 1.0])
    figure = draw_stops(case_products)
    titles = [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]
    assert titles[0].startswith("Stop 1: 10.00 m\n")
    # -0.04 deg is rounded to +0.0, not to -0.0
    assert titles[1].splitlines() == ["Stop 2: 6.00 m", "roll +0.0°", "NCC 0.90"]
    assert titles[2].startswith("Stop 3 (lost): 2.00 m")
    assert "not found" in [text.get_text() for axes in figure.axes for text in axes.texts]


def test_legend_contains_only_marks_of_the_figure() -> None:
    def labels(figure: Figure) -> list[str]:
        return [text.get_text() for legend in figure.legends for text in legend.get_texts()]

    truth = "true projection of the designated point"
    assert labels(draw_stops(make_products())) == ["search window", "tracked target", truth]
    lost_products = make_products(1)  # the target is lost at the only stop
    assert labels(draw_stops(lost_products)) == ["search window", truth]
    names = labels(draw_path(make_products()))
    assert {"rock of the target", "true heading"} <= {*names}
    assert "other rocks" not in names
    rocks = np.array([[10.1, 0.0, 0.4], [5.0, 0.5, 0.3], [5.0, 90.0, 0.3]])
    assert "other rocks" in labels(draw_path(make_products() | {"rocks_m": rocks}))
    distant_rocks = labels(draw_path(make_products() | {"rocks_m": rocks[[0, 2]], "heading_deg": None}))
    assert not {"other rocks", "true heading"} & {*distant_rocks}
    without_estimates = make_products() | {"target_estimated_m": np.full((3, 3), np.nan)}
    assert not [name for name in labels(draw_path(without_estimates)) if "estimated target" in name]


def test_right_subframe_is_cut_to_the_width_of_the_left_one() -> None:
    counts = np.zeros((51, 540), dtype=np.uint16)
    right_px = [700.0, 310.0]
    matches = np.array([[480.0, 370.0], right_px])
    figure = draw_stops(make_products() | {"stop_1_right": counts, "stop_1_matches": matches})
    right = figure.axes[6]
    assert np.asarray(right.get_images()[0].get_array()).shape[:2] == (51, 161)
    # the match at column 320 of the subframe is at the centre of the 161 columns from column 239
    (square,) = find_boxes(right, TARGET)
    assert square.corner.tolist() == [320.0 - 239.0 - 10.5, 8.0 - 10.5]
    assert "strip" in view(make_products() | {"stop_1_right": counts}).figures[0].caption
    assert "strip" not in view(make_products()).figures[0].caption


def test_selected_stops_include_first_and_last() -> None:
    titles = [axes.get_title(loc="left") for axes in draw_stops(make_products(9), max_stops=4).axes]
    assert [title.split(":")[0].split(" ")[1] for title in titles if title] == ["1", "4", "6", "9"]


def test_path_and_estimates_are_drawn_at_their_positions() -> None:
    top_view, detail = draw_path(make_products(4)).axes
    lines = {line.get_label(): np.column_stack(line.get_data()) for line in top_view.lines}
    assert lines["true stops"][-1].tolist() == [8.0, 0.0]
    assert lines["estimated stops"][0].tolist() == pytest.approx([0.05, 0.05])
    assert lines["designated point"].tolist() == [[10.0, 0.0]]
    # the target is tracked at three of four stops; the estimates are 0, 3 and 6 cm east of the designated point
    (name,) = [str(line.get_label()) for line in detail.lines if "estimated" in str(line.get_label())]
    assert name == "estimated target (6 cm from first to last estimate)"
    offsets = next(np.column_stack(line.get_data()) for line in detail.lines if line.get_label() == name)
    assert offsets == pytest.approx(np.array([[0.0, 0.0], [3.0, 0.0], [6.0, 0.0]]), abs=1e-9)
    for axes in (top_view, detail):
        assert axes.get_aspect() == 1.0


def test_figures_are_written(tmp_path: Path) -> None:
    paths = write_case_figures(tmp_path, make_products())
    assert [path.name for path in paths] == ["stops.png", "way.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)
    assert [path.name for path in write_case_figures(tmp_path, make_products() | {"target_m": None})] == ["stops.png"]


@pytest.mark.parametrize(
    "changes",
    [
        {"figures": None},
        {"figures": {"range_m": "far", "azimuth_deg": [1.0]}},
        {"states": "lost", "stop_1_right": None},
        {"stop_1_corners": None, "stop_2_window": np.zeros(3), "stop_1_point": "there"},
        {"stop_1_left": np.zeros((161, 161)), "stop_2_matches": None},
        {"rocks_m": None, "heading_deg": None, "path_true_m": np.empty((0, 2))},
        {"target_estimated_m": np.full((3, 3), np.nan)},
    ],
)
def test_missing_products_are_tolerated(changes: dict[str, Any]) -> None:
    case_products = make_products() | changes
    assert draw_stops(case_products).axes
    assert draw_path(case_products).axes
    assert len(view(case_products).rows) == 3


def test_incomplete_products_are_not_a_tracking_case() -> None:
    assert is_vtt_case(make_products())
    assert not is_vtt_case({})
    assert not is_vtt_case(make_products() | {"template_px": None})
    assert read_stops({}) == []
    assert read_rover_path(make_products() | {"rover_true_m": np.zeros((2, 3))}) is None
    with pytest.raises(ValueError, match="no image"):
        draw_stops({})
    with pytest.raises(ValueError, match="no path of a rover"):
        draw_path({})


def test_case_view_has_one_row_per_stop() -> None:
    case_view = view(make_products())
    assert [row.succeeded for row in case_view.rows] == [True, True, False]
    assert case_view.head == ["Stop", "State", "Range (m)", "Mast azimuth (deg)", "NCC score"]
    assert list(case_view.rows[1].values)[:3] == ["2", "normal", "6.00"]
    # the state is shown only if it varies
    normal_view = view(make_products() | {"states": ["NORMAL"] * 3})
    assert normal_view.head[:2] == ["Stop", "Range (m)"]
