"""Tests of the figures of a landing: positions, colours and missing stages."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex, to_rgb

from marsyard.reports.dimes.case_figures import is_dimes_case
from marsyard.reports.hda.case_figures import (
    BLACK,
    BLUE,
    FIGURES,
    GREEN,
    HAZARD_COLOURS,
    PURPLE,
    RED,
    SAFETY_COLOURS,
    UNKNOWN,
    YELLOW,
    available_figures,
    draw_epipolar,
    draw_maps,
    draw_motion,
    draw_site,
    draw_tracks,
)
from marsyard.reports.hda.presentation import view
from marsyard.reports.hda.products import is_hda_case, read_ground_truth, read_landing_maps
from marsyard.reports.presentation import write_case_figures


def test_all_figures_of_a_complete_case_are_written(hda_products: dict[str, Any], tmp_path: Path) -> None:
    paths = write_case_figures(tmp_path, hda_products)
    names = ["fig1-tracks", "fig2-motion", "fig3-epipolar", "fig4-elevation", "fig5-maps", "fig7-site"]
    assert [path.name for path in paths] == [f"{name}.png" for name in names]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)


def test_tracks_are_drawn_in_both_images(hda_products: dict[str, Any]) -> None:
    left, right = draw_tracks(hda_products).axes
    is_accepted = hda_products["tracks_accepted"]
    accepted_features, rejected_features = (np.array(line.get_data()).T for line in left.lines[:2])
    np.testing.assert_array_equal(accepted_features, hda_products["features"][is_accepted])
    np.testing.assert_array_equal(rejected_features, hda_products["features"][~is_accepted])
    np.testing.assert_array_equal(np.array(right.lines[-1].get_data()).T, hda_products["tracked"][is_accepted])


def test_second_camera_is_drawn_at_the_estimated_motion(hda_products: dict[str, Any]) -> None:
    top_view = draw_motion(hda_products).axes[0]
    lines = {line.get_label(): np.array(line.get_data()) for line in top_view.lines}
    # the field of view moves with the camera: 1 m estimated, 1.1 m true
    first, second, true = (lines[name] for name in ("first camera", "second camera", "second camera, true"))
    np.testing.assert_allclose(second[0] - first[0], 1.0, atol=1e-12)
    np.testing.assert_allclose(true[0] - first[0], 1.1, atol=1e-12)
    # y is up in the figure and down in the camera frame
    np.testing.assert_allclose(lines["features"][1], -hda_products["sparse_points"][:, 1])


def test_only_accepted_matches_are_drawn(hda_products: dict[str, Any]) -> None:
    left, right = draw_epipolar(hda_products).axes
    grid = np.array(left.lines[0].get_data()).T
    (squares,) = (line for line in right.lines if line.get_marker() == "s")
    assert to_hex(squares.get_color()) == BLUE
    accepted_matches = {
        tuple(point) for point in hda_products["grid"][hda_products["matches_accepted"]] + np.array([30.0, 0.0])
    }
    drawn_matches = {tuple(point) for point in np.array(squares.get_data()).T}
    # at most 600 grid points are drawn
    assert 0 < len(grid) <= 600
    assert drawn_matches == accepted_matches & {tuple(point) for point in grid + np.array([30.0, 0.0])}


def test_maps_have_the_colours_of_the_paper(hda_products: dict[str, Any]) -> None:
    figure = draw_maps(hda_products)
    elevation, roughness, slope, safety = (axes.get_images()[0] for axes in figure.axes[:4])
    # high ground is dark
    high, low = elevation.to_rgba(np.array([0.5, -0.5]))
    assert sum(high[:3]) < sum(low[:3])
    for image, limit in ((roughness, 0.2), (slope, 15.0)):
        colours = [to_hex(colour) for colour in image.to_rgba(limit * np.array([0.2, 0.95]))]
        assert colours == [GREEN, YELLOW]
        (hazard_colour,) = image.to_rgba(np.array([1.01 * limit]))
        assert hazard_colour[0] > 1.8 * hazard_colour[1]  # red
    assert [to_hex(colour) for colour in safety.to_rgba(np.arange(3))] == [GREEN, UNKNOWN, RED]


def test_safety_colours_differ_in_luminance() -> None:
    """The colour of unknown cells differs from green and red in luminance; hatching marks red."""
    luminance = [float(np.dot(to_rgb(colour), (0.2126, 0.7152, 0.0722))) for colour in (GREEN, UNKNOWN, RED)]
    assert luminance[1] > 1.5 * max(luminance[0], luminance[2])
    assert SAFETY_COLOURS.N == 3
    assert to_hex(HAZARD_COLOURS(np.nan)) == UNKNOWN


def test_sites_are_marked_in_image_and_map(hda_products: dict[str, Any]) -> None:
    image_axes = draw_site(hda_products).axes[0]
    markers = {line.get_marker(): line for line in image_axes.lines}
    assert to_hex(markers["x"].get_color()) == BLACK
    assert to_hex(markers["+"].get_color()) == PURPLE
    site = np.array(markers["+"].get_data()).ravel()
    np.testing.assert_allclose(site, hda_products["map_pixels"][18, 5])
    map_marker = next(line for line in draw_maps(hda_products).axes[3].lines if line.get_marker() == "+")
    np.testing.assert_allclose(np.array(map_marker.get_data()).ravel(), [5.0, 18.0])


def test_true_terrain_is_aligned_with_the_map(hda_products: dict[str, Any]) -> None:
    """The highest point of the true terrain lies at the highest map cell."""
    maps, truth = read_landing_maps(hda_products), read_ground_truth(hda_products)
    peak_cell = maps.world_to_cell(truth.offset_from_nadir_m.reshape(-1, 2)[np.argmax(truth.elevation_m)])
    np.testing.assert_allclose(
        peak_cell, np.unravel_index(np.argmax(maps.elevation_m), maps.elevation_m.shape), atol=1.0
    )
    assert abs(float(truth.elevation_m.max() - maps.elevation_m.max())) < 0.2


def test_figure_without_safe_site_has_no_site_marker(hda_products: dict[str, Any]) -> None:
    image_axes = draw_site({**hda_products, "site": np.array(())}).axes[0]
    assert [line.get_marker() for line in image_axes.lines] == ["x"]
    captions = [figure.caption for figure in view({**hda_products, "site": np.array(())}).figures]
    assert captions[-1] == "Fig. 7: safe landing map. Black X: a-priori site."


def test_map_without_known_cells_is_described(hda_products: dict[str, Any]) -> None:
    products = {**hda_products, "safety": np.ones_like(hda_products["safety"])}
    case_view = view(products)
    assert "unknown everywhere" in case_view.figures[3].caption
    assert ["Safe landing map", "safe 0.0 %, hazard 0.0 %, unknown 100.0 %"] in [row.values for row in case_view.rows]
    assert not any("unknown everywhere" in figure.caption for figure in view(hda_products).figures)


@pytest.mark.parametrize(
    ("missing", "n_figures"),
    [
        (("elevation",), 3),
        (("elevation", "grid"), 2),
        (("elevation", "grid", "rotation"), 1),
        (("elevation", "grid", "rotation", "features"), 0),
    ],
)
def test_missing_stages_have_no_figure(hda_products: dict[str, Any], missing: tuple[str, ...], n_figures: int) -> None:
    products = {name: value for name, value in hda_products.items() if name not in missing}
    assert len(available_figures(products)) == n_figures
    case_view = view(products)
    # the page omits Fig. 1 of the landing paper; without other figures it shows the images
    assert len(case_view.figures) == max(1, n_figures - 1)
    assert is_hda_case(products)


@pytest.mark.parametrize("changes", [{"image_2": None}, {"true_positions": "none"}, {"camera_true": np.zeros(3)}])
def test_incomplete_products_are_not_a_landing(hda_products: dict[str, Any], changes: dict[str, Any]) -> None:
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
def test_invalid_maps_are_omitted(hda_products: dict[str, Any], changes: dict[str, Any]) -> None:
    assert available_figures({**hda_products, **changes}) == ["fig1-tracks", "fig2-motion", "fig3-epipolar"]


@pytest.mark.parametrize(
    ("missing", "names"),
    [
        ("image_2", ["fig2-motion", "fig4-elevation", "fig5-maps"]),
        ("true_heights", [name for name in FIGURES if name != "fig5-maps"]),
    ],
)
def test_only_figures_whose_products_are_complete_are_available(
    hda_products: dict[str, Any], missing: str, names: list[str]
) -> None:
    products = {name: value for name, value in hda_products.items() if name != missing}
    assert available_figures(products) == names
    assert all(FIGURES[name](products).axes for name in names)


def test_maps_with_unknown_cells_are_drawn(hda_products: dict[str, Any]) -> None:
    elevation = hda_products["elevation"].copy()
    elevation[3:6, 4:9] = np.nan
    unknown = {name: np.where(np.isnan(elevation), np.nan, hda_products[name]) for name in ("roughness", "slope")}
    pixels = np.where(np.isnan(elevation)[..., None], np.nan, hda_products["map_pixels"])
    case_view = view({**hda_products, **unknown, "elevation": elevation, "map_pixels": pixels})
    # all figures except Fig. 1, which the page omits
    assert len(case_view.figures) == 5
