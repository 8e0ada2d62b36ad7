"""Pictures of a landing: what is drawn where, in the paper's colours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex, to_rgb

from marsyard.reports.dimes.case_figures import is_dimes_case
from marsyard.reports.hda.case_figures import (
    BLACK,
    BLUE,
    GREEN,
    HAZARD_COLOURS,
    PURPLE,
    RED,
    SAFETY_COLOURS,
    YELLOW,
    draw_epipolar,
    draw_maps,
    draw_motion,
    draw_site,
    draw_tracks,
    figures_reached,
)
from marsyard.reports.hda.presentation import view
from marsyard.reports.hda.products import is_hda_case, landing_maps, true_ground
from marsyard.reports.presentation import write_case_figures


def test_every_figure_of_a_mapped_case_is_written(hda_products: dict[str, Any], tmp_path: Path) -> None:
    written = write_case_figures(tmp_path, hda_products)
    names = ["fig1-tracks", "fig2-motion", "fig3-epipolar", "fig4-elevation", "fig5-maps", "fig7-site"]
    assert [path.name for path in written] == [f"{name}.png" for name in names]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in written)


def test_tracks_stand_in_both_pictures(hda_products: dict[str, Any]) -> None:
    left, right = draw_tracks(hda_products).axes
    accepted = hda_products["tracks_accepted"]
    found, lost = (np.array(line.get_data()).T for line in left.lines[:2])
    np.testing.assert_array_equal(found, hda_products["features"][accepted])
    np.testing.assert_array_equal(lost, hda_products["features"][~accepted])
    np.testing.assert_array_equal(np.array(right.lines[-1].get_data()).T, hda_products["tracked"][accepted])


def test_second_camera_stands_where_the_motion_puts_it(hda_products: dict[str, Any]) -> None:
    above = draw_motion(hda_products).axes[0]
    lines = {line.get_label(): np.array(line.get_data()) for line in above.lines}
    # The camera moved 1 m to the right: its field of view did too, and the true one 1.1 m.
    first, second, true = (lines[name] for name in ("first camera", "second camera", "second, true"))
    np.testing.assert_allclose(second[0] - first[0], 1.0, atol=1e-12)
    np.testing.assert_allclose(true[0] - first[0], 1.1, atol=1e-12)
    # y is up in the picture, down in the camera's frame
    np.testing.assert_allclose(lines["features"][1], -hda_products["sparse_points"][:, 1])


def test_matches_are_the_accepted_ones_of_those_drawn(hda_products: dict[str, Any]) -> None:
    left, right = draw_epipolar(hda_products).axes
    grid = np.array(left.lines[0].get_data()).T
    (squares,) = (line for line in right.lines if line.get_marker() == "s")
    assert to_hex(squares.get_color()) == BLUE
    accepted = {tuple(one) for one in hda_products["grid"][hda_products["matches_accepted"]] + np.array([30.0, 0.0])}
    drawn = {tuple(one) for one in np.array(squares.get_data()).T}
    assert 0 < len(grid) <= 600
    assert drawn == accepted & {tuple(one) for one in grid + np.array([30.0, 0.0])}


def test_maps_have_the_papers_colours(hda_products: dict[str, Any]) -> None:
    figure = draw_maps(hda_products)
    elevation, roughness, slope, safety = (axes.get_images()[0] for axes in figure.axes[:4])
    high, low = elevation.to_rgba(np.array([0.5, -0.5]))
    assert sum(high[:3]) < sum(low[:3])
    for image, limit in ((roughness, 0.2), (slope, 15.0)):
        colours = [to_hex(one) for one in image.to_rgba(limit * np.array([0.2, 0.95]))]
        assert colours == [GREEN, YELLOW]
        (beyond,) = image.to_rgba(np.array([1.01 * limit]))
        assert beyond[0] > 1.8 * beyond[1]
    assert [to_hex(one) for one in safety.to_rgba(np.arange(3))] == [GREEN, YELLOW, RED]


def test_tones_are_apart_without_hue() -> None:
    """Luminance alone tells yellow from the others, and hatching marks what is red."""
    luminance = [float(np.dot(to_rgb(colour), (0.2126, 0.7152, 0.0722))) for colour in (GREEN, YELLOW, RED)]
    assert luminance[1] > 1.5 * max(luminance[0], luminance[2])
    assert SAFETY_COLOURS.N == 3
    assert HAZARD_COLOURS(np.nan)[:3] != HAZARD_COLOURS(0.0)[:3]


def test_sites_are_marked_on_picture_and_map(hda_products: dict[str, Any]) -> None:
    picture = draw_site(hda_products).axes[0]
    marks = {line.get_marker(): line for line in picture.lines}
    assert to_hex(marks["x"].get_color()) == BLACK
    assert to_hex(marks["+"].get_color()) == PURPLE
    site = np.array(marks["+"].get_data()).ravel()
    np.testing.assert_allclose(site, hda_products["map_pixels"][18, 5])
    on_map = next(line for line in draw_maps(hda_products).axes[3].lines if line.get_marker() == "+")
    np.testing.assert_allclose(np.array(on_map.get_data()).ravel(), [5.0, 18.0])


def test_truth_lies_on_the_map(hda_products: dict[str, Any]) -> None:
    """The true rock lies at the cells where the map has it, turned or not."""
    maps, truth = landing_maps(hda_products), true_ground(hda_products)
    assert maps is not None
    assert truth is not None
    top = maps.cells(truth.away_m.reshape(-1, 2)[np.argmax(truth.elevation_m)])
    np.testing.assert_allclose(top, np.unravel_index(np.argmax(maps.elevation_m), maps.elevation_m.shape), atol=1.0)
    assert abs(float(truth.elevation_m.max() - maps.elevation_m.max())) < 0.2


def test_without_a_safe_site_no_plus_is_drawn(hda_products: dict[str, Any]) -> None:
    picture = draw_site({**hda_products, "site": np.array(())}).axes[0]
    assert [line.get_marker() for line in picture.lines] == ["x"]


@pytest.mark.parametrize(
    ("gone", "reached"),
    [
        (("elevation",), 3),
        (("elevation", "grid"), 2),
        (("elevation", "grid", "rotation"), 1),
        (("elevation", "grid", "rotation", "features"), 0),
    ],
)
def test_stages_not_reached_have_no_figure(hda_products: dict[str, Any], gone: tuple[str, ...], reached: int) -> None:
    products = {name: value for name, value in hda_products.items() if name not in gone}
    assert len(figures_reached(products)) == reached
    shown = view(products, "case7")
    # Fig. 1 is not on the page; where no other was reached the pictures stand alone
    assert len(shown.plates) == max(1, reached - 1)
    assert is_hda_case(products)


@pytest.mark.parametrize("changes", [{"image_2": None}, {"true_places": "none"}, {"camera_true": np.zeros(3)}])
def test_other_products_are_no_landing(hda_products: dict[str, Any], changes: dict[str, Any]) -> None:
    assert not is_hda_case({**hda_products, **changes})
    assert not is_dimes_case(hda_products)


@pytest.mark.parametrize(
    "changes",
    [
        {"limits": np.zeros(3)},
        {"cell": np.array([0.0])},
        {"map_pixels": np.zeros((2, 2, 2))},
        {"corner": "lost"},
        {"safety": np.zeros(3)},
    ],
)
def test_maps_that_cannot_be_read_are_left_out(hda_products: dict[str, Any], changes: dict[str, Any]) -> None:
    assert figures_reached({**hda_products, **changes}) == ["fig1-tracks", "fig2-motion", "fig3-epipolar"]


def test_unknown_cells_are_drawn(hda_products: dict[str, Any]) -> None:
    elevation = hda_products["elevation"].copy()
    elevation[3:6, 4:9] = np.nan
    unknown = {name: np.where(np.isnan(elevation), np.nan, hda_products[name]) for name in ("roughness", "slope")}
    pixels = np.where(np.isnan(elevation)[..., None], np.nan, hda_products["map_pixels"])
    shown = view({**hda_products, **unknown, "elevation": elevation, "map_pixels": pixels}, "case1")
    assert len(shown.plates) == 5
