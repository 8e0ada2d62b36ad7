"""Figures of a localisation case: errors over time, the map with the track, and the landmarks of the last image."""

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from marsyard.algorithms.localisation.interface import PositionOutcome
from marsyard.reports.figure_style import INK, MUTED, REQUIREMENT, SERIES, in_page_style
from marsyard.reports.images import Mark, Panel, draw_panels
from marsyard.reports.products import Products, check_shape, read_arrays, to_matrix

_AXES = ("east", "north", "up")
#: Enlargement of the landmarks' residuals.
_RESIDUAL_SCALE = 20.0


def is_localisation_case(products: Products) -> bool:
    """Return whether products contain the track of a localisation case and its map, with the outcomes of the track."""
    shapes = {"track": ("n", 7), "inliers": ("n",), "true_xy_m": (None, 2), "estimated_xy_m": (None, 2)}
    arrays = read_arrays(products, shapes)
    extent = read_arrays(products, {"map_extent_m": (4,)}, finite=True)
    if arrays is None or extent is None or to_matrix(products.get("map")) is None:
        return False
    outcomes = products.get("outcomes")
    names = [str(name) for name in outcomes] if isinstance(outcomes, list | tuple | np.ndarray) else []
    return len(arrays[0]) == len(names) and set(names) <= set(PositionOutcome.__members__)


def read_track(products: Products) -> Float[np.ndarray, "n 7"]:
    """Read the track: time, errors east, north, up, and their standard deviations; NaN for a refusal."""
    track = check_shape(products.get("track"), None, 7)
    if track is None:
        raise ValueError("the products contain no track of a localisation case")
    return track


@in_page_style
def draw_errors(products: Products) -> Figure:
    """Draw the position error of each component over time, with bands of three standard deviations."""
    track = read_track(products)
    valid = track[np.isfinite(track[:, 0])]
    figure = Figure(figsize=(12.0, 3.2), layout="constrained")
    for component, (name, axes) in enumerate(zip(_AXES, figure.subplots(1, 3), strict=True)):
        band = 3.0 * valid[:, 4 + component]
        axes.fill_between(valid[:, 0], -band, band, color=MUTED, alpha=0.25, linewidth=0.0)
        axes.axhline(0.0, color=INK, linewidth=0.8)
        axes.plot(valid[:, 0], valid[:, 1 + component], marker="o", color=SERIES[component])
        axes.set(xlabel="Time after the start (s)", ylabel=f"Position error {name} (m)")
    return figure


@in_page_style
def draw_map(products: Products) -> Figure:
    """Draw the map with true and estimated positions."""
    figure = Figure(figsize=(6.0, 6.0), layout="constrained")
    axes = figure.add_subplot()
    extent = np.asarray(products["map_extent_m"], dtype=np.float64) / 1e3
    axes.imshow(products["map"], cmap="gray", origin="lower", extent=tuple(extent), interpolation="antialiased")
    true, estimated = (np.asarray(products[name], dtype=np.float64) / 1e3 for name in ("true_xy_m", "estimated_xy_m"))
    initial = check_shape(products.get("initial_xy_m"), 2)
    if initial is not None:
        axes.plot(*initial / 1e3, marker="X", color=SERIES[3], linestyle="none", markersize=9.0, label="initial")
    axes.plot(*true.T, color=SERIES[0], linewidth=3.0, label="true")
    axes.plot(*estimated.T, marker="o", color=SERIES[1], linestyle="none", markersize=4.0, label="estimated")
    axes.set(xlabel="East (km)", ylabel="North (km)")
    axes.grid(visible=False)
    axes.legend(frameon=True, facecolor="white", framealpha=1.0, labelcolor="black")
    return figure


def draw_landmarks(products: Products) -> Figure | None:
    """Draw the last image with its landmarks and their residuals; None without landmarks."""
    shapes = {"landmarks_px": ("n", 2), "landmarks_residual_px": ("n", 2), "landmarks_used": ("n",)}
    arrays, image = read_arrays(products, shapes), to_matrix(products.get("image_2"))
    if arrays is None or image is None:
        return None
    pixels, residuals, flags = arrays
    used = flags > 0.5
    marks = []
    for mask, colour, marker in ((used, SERIES[2], "o"), (~used, REQUIREMENT, "x")):
        style = {"marker": marker, "linestyle": "none", "markersize": 4.0, "fillstyle": "none"}
        segments = np.stack([pixels[mask], pixels[mask] + _RESIDUAL_SCALE * residuals[mask]])
        marks += [Mark(pixels[mask], style | {"color": colour}), Mark(segments, {"color": colour, "linewidth": 0.8})]
    return draw_panels([[Panel(image, marks=marks)]], (6.0, 6.0))
