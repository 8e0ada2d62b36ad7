"""Tests of the figures of a DIMES case: positions of templates, windows and matches."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard.reports.dimes.case_figures import MATCH, TEMPLATE, WINDOW, draw_dimes_case, is_dimes_case, read_tracks
from marsyard.reports.dimes.presentation import view
from marsyard.reports.presentation import write_case_figures
from tests.reports.drawn_marks import find_boxes


def test_case_figure_shows_all_tracks(dimes_products: dict[str, Any]) -> None:
    figure = draw_dimes_case(dimes_products)
    # four tracks in images, rectified images and windows; the invalid track is dashed
    assert [len(find_boxes(figure, colour)) for colour in (TEMPLATE, WINDOW, MATCH)] == [8, 4, 12]
    assert sum(box.is_dashed for box in find_boxes(figure, TEMPLATE)) == 2


def test_images_are_binned_to_square_pixels(dimes_products: dict[str, Any]) -> None:
    figure = draw_dimes_case(dimes_products, [0])
    sizes = [image.get_size() for axes in figure.axes for image in axes.get_images()]
    # two rectified images, template and window of two tracks, two images of 1024 x 256 pixels binned to squares
    patches = [(17, 17), (61, 61), (17, 17), (61, 61)]
    assert sizes == [(384, 384), (384, 384), *patches, (256, 256), (256, 256)]


def test_template_squares_are_at_the_track_positions(dimes_products: dict[str, Any]) -> None:
    table = np.asarray(dimes_products["tracks"])
    rectified_square, _, image_square, _ = find_boxes(draw_dimes_case(dimes_products, [0]), TEMPLATE)
    assert image_square.centre == pytest.approx(table[0, 2:4])
    # the rectified image is the image shifted by 64 px, at the same scale
    assert rectified_square.centre == pytest.approx(table[0, 2:4] + 64.0)
    assert rectified_square.size == pytest.approx([17.0, 17.0])


def test_rectified_matches_are_inside_their_windows(dimes_products: dict[str, Any]) -> None:
    figure = draw_dimes_case(dimes_products, [0])
    window, match = find_boxes(figure, WINDOW)[0], find_boxes(figure, MATCH)[0]
    # match at row 33.4 and column 39.2 of a window of 61 pixels
    assert match.centre - window.centre == pytest.approx([39.2 - 30.0, 33.4 - 30.0])
    assert window.size == pytest.approx([61.0, 61.0])


def test_rectified_image_is_resampled_with_the_lattice(dimes_products: dict[str, Any]) -> None:
    counts = np.zeros((256, 256))
    counts[100:110, 40:60] = 1000.0
    figure = draw_dimes_case({**dimes_products, "image_1": counts}, [0])
    image = np.asarray(figure.axes[0].get_images()[0].get_array())[..., 0]
    bright = np.argwhere(image > 128)
    # the rectified image is shifted by 64 px
    assert bright.min(axis=0).tolist() == [164, 104]
    assert bright.max(axis=0).tolist() == [173, 123]


def test_figure_of_a_case_is_written(dimes_products: dict[str, Any], tmp_path: Path) -> None:
    (path,) = write_case_figures(tmp_path, dimes_products)
    assert path == tmp_path / "dimes.png"
    assert path.read_bytes().startswith(b"\x89PNG")
    assert write_case_figures(tmp_path, {}) == []
    image_products = {name: value for name, value in dimes_products.items() if name.startswith("image_")}
    assert write_case_figures(tmp_path, image_products) == [tmp_path / "images.png"]


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
def test_missing_products_are_tolerated(dimes_products: dict[str, Any], changes: dict[str, Any]) -> None:
    assert draw_dimes_case({**dimes_products, **changes}).axes


def test_incomplete_products_are_not_a_dimes_case(dimes_products: dict[str, Any]) -> None:
    assert is_dimes_case(dimes_products)
    assert not is_dimes_case({})
    assert not is_dimes_case({**dimes_products, "image_3": np.zeros(3)})
    assert read_tracks({}) == []
    with pytest.raises(ValueError, match="image_3"):
        draw_dimes_case({**dimes_products, "image_3": None}, [1])


def test_case_without_tracks_shows_only_images(dimes_products: dict[str, Any]) -> None:
    image_products = {name: value for name, value in dimes_products.items() if name.startswith(("image_", "velocity_"))}
    case_view = view(image_products)
    (image_figure,) = case_view.figures
    assert image_figure.wide
    assert [axes.get_title(loc="left") for axes in image_figure.figure.axes] == ["Image 1", "Image 2", "Image 3"]
    assert (case_view.head, case_view.rows) == ((), ())
    assert case_view.legend is not None
    assert "squares mark" not in case_view.legend
    assert [name for name, _ in case_view.facts] == [
        "Reported velocity, mean over the time between images 2 and 3",
        "True velocity, same interval",
        "Velocity error",
    ]


def test_figure_omits_empty_rows(dimes_products: dict[str, Any]) -> None:
    # the case ended before the selection of templates
    without_tracks = {name: value for name, value in dimes_products.items() if name.startswith("image_")}
    without_tracks |= {"tracks": np.zeros((0, 13)), "tracks_columns": dimes_products["tracks_columns"]}
    full_figure, short_figure = (draw_dimes_case(products, [0]) for products in (dimes_products, without_tracks))
    assert len(short_figure.get_axes()) == 2
    assert short_figure.get_figheight() < 0.5 * full_figure.get_figheight()


def test_table_marks_the_reported_track(dimes_products: dict[str, Any]) -> None:
    combinations = np.array([[1.0, 0.0, 0.52], [0.0, 0.0, 0.61]])
    selection = {"combinations": combinations, "selected": np.array([1.0, 0.0])}
    case_view = view({**dimes_products, **selection})
    column = list(case_view.head).index("Selected")
    assert [row.values[column] for row in case_view.rows] == ["no", "yes", "yes, reported", "no"]
    assert dict(case_view.facts)["Velocity error"] == "0.583 m/s"
    difference = "Velocity change between the pairs: difference from the IMU"
    assert dict(case_view.facts)[difference] == "0.520 m/s (selected tracks); other combinations: 0.610 m/s or more"
    refused_view = view({**dimes_products, **selection, "selected": np.array([])})
    assert "Selected" not in refused_view.head
    assert dict(refused_view.facts)[difference] == "0.520 m/s or more: too large"


def test_captions_describe_only_drawn_marks(dimes_products: dict[str, Any]) -> None:
    captions = [figure.caption for figure in view(dimes_products).figures]
    assert ["Dashed" in caption for caption in captions] == [False, True]
    marks = {
        "overlap_0": np.array([[10.0, 10.0], [300.0, 10.0], [300.0, 300.0]]),
        "overlap_1": np.array([[-50.0, -50.0], [400.0, -50.0], [400.0, 400.0], [-50.0, 400.0]]),
        "zero_phase_0": np.array([[-900.0, 20.0], [30.0, 20.0]]),
        "zero_phase_1": np.full((2, 2), np.nan),
    }
    first_caption, second_caption = (figure.caption for figure in view({**dimes_products, **marks}).figures)
    assert "Dotted" in first_caption
    assert "Yellow cross" in first_caption
    assert "Dotted" not in second_caption
    assert "cross" not in second_caption
    without_tracks = {**dimes_products, "tracks": np.zeros((0, len(dimes_products["tracks_columns"])))}
    assert "Red" not in view(without_tracks).figures[0].caption
