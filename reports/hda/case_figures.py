"""Figures of one landing, as Figs. 1 to 5 and 7 of Johnson, Montgomery & Matthies, "Vision Guided Landing".

Colours are those of the paper's text, in shades that colour-blind readers can distinguish. Fig. 2: cameras red and
green, features white. Fig. 3: structure pixels red, segments green, matches blue. Maps: green, yellow and red. Unknown
parts of all maps are light blue; the paper marks them yellow in the safe landing map. A black X marks the a-priori
site, a purple plus the reported site. The true maps in Fig. 5 and the true motion in Fig. 2 are additions. The
functions that draw a figure raise ValueError if its products are missing; `available_figures` lists the others.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.colors import LightSource, LinearSegmentedColormap, ListedColormap, to_rgb
from matplotlib.figure import Figure

from marsyard.reports.figure_style import MUTED, in_page_style
from marsyard.reports.hda.products import (
    EstimatedMotion,
    LandingMaps,
    StoredGroundTruth,
    read_ground_truth,
    read_images,
    read_landing_maps,
    read_matches,
    read_motion,
    read_tracked_features,
)
from marsyard.reports.images import Mark, Panel, draw_panels, show_image
from marsyard.reports.products import Products

Product = TypeVar("Product")

#: Green, yellow and red that readers with any colour vision can distinguish (after Okabe & Ito).
GREEN, YELLOW, RED = "#009e73", "#f0e442", "#c83a12"
BLUE, PURPLE, BLACK, WHITE = "#3da5ff", "#8f1fb0", "#000000", "#ffffff"
#: Unknown parts of maps: not grey as elevation, and not yellow as slope or roughness near the limit.
UNKNOWN = "#b9d3ee"
TRACKED_COLOUR, LOST_COLOUR = "#f0a202", "#c9d1d9"
#: Colours of slope and roughness, from 0 to twice the limit (1.0): green for small values, yellow up to the limit
#: (0.5), red above.
HAZARD_COLOURS = LinearSegmentedColormap.from_list(
    "hazard", [(0.0, GREEN), (0.2, GREEN), (0.42, YELLOW), (0.5, YELLOW), (0.5, RED), (1.0, "#7d1f06")]
).with_extremes(bad=UNKNOWN)
SAFETY_COLOURS = ListedColormap([GREEN, UNKNOWN, RED])
#: High ground is dark, low ground is bright.
ELEVATION_COLOURS = "gray_r"
#: Maximum number of drawn structure pixels; the paper's Table I has 600.
_MAX_MATCHES = 600
#: Maximum number of drawn cells along the terrain's longer side.
_MAX_DRAWN_CELLS = 90
#: Minimum ratio of the drawn relief to the terrain's side; heights are exaggerated up to ten times.
_MIN_RELIEF = 0.12
_BACKGROUND = "#15191e"
#: Size of a figure of both images, inches, and styles of their marks.
_PAIR_SIZE_IN = (9.0, 3.6)
_SEGMENT: dict[str, Any] = {"linewidth": 0.8}
_SQUARE: dict[str, Any] = {
    "marker": "s", "linestyle": "", "markersize": 2.6, "markerfacecolor": "none", "markeredgewidth": 0.9,
}  # fmt: skip
_TRACKED = _SQUARE | {"markersize": 5.5, "markeredgewidth": 1.3, "color": TRACKED_COLOUR, "label": "tracked"}
_LOST: dict[str, Any] = {
    "marker": "x", "linestyle": "", "markersize": 5.0, "color": LOST_COLOUR, "markeredgewidth": 1.2,
    "label": "not tracked",
}  # fmt: skip
_SITE_MARKERS: Mapping[str, Mapping[str, Any]] = {
    "apriori": {"marker": "x", "color": BLACK, "markersize": 8, "markeredgewidth": 2.0, "linestyle": ""},
    "site": {"marker": "+", "color": PURPLE, "markersize": 11, "markeredgewidth": 2.6, "linestyle": ""},
}
#: Names of the sites in legends.
SITE_NAMES: Mapping[str, str] = {"apriori": "a-priori site", "site": "reported site"}
_WHITE_OUTLINE = [patheffects.Stroke(linewidth=3.6, foreground=WHITE), patheffects.Normal()]


def draw_tracks(products: Products) -> Figure:
    """Draw Fig. 1: features in the first image, their tracks in the second."""
    images = _require(read_images(products), "images")
    tracks = _require(read_tracked_features(products), "tracks")
    is_tracked = tracks.accepted
    features = [Mark(tracks.first[is_tracked], _TRACKED)]
    if not is_tracked.all():
        features.append(Mark(tracks.first[~is_tracked], _LOST))
    left = Panel(images[0], f"First image: {len(tracks.first)} features", features)
    segments = np.stack([tracks.first[is_tracked], tracks.second[is_tracked]])
    track_style = _SEGMENT | {"color": TRACKED_COLOUR, "alpha": 0.9}
    marks = [Mark(segments, track_style), Mark(tracks.second[is_tracked], _TRACKED)]
    right = Panel(images[1], f"Second image: {int(is_tracked.sum())} tracks", marks)
    figure = draw_panels([[left, right]], _PAIR_SIZE_IN)
    style: dict[str, Any] = {"frameon": True, "facecolor": BLACK, "framealpha": 0.5, "fontsize": 8}
    figure.axes[0].legend(loc="lower left", labelcolor=WHITE, **style)
    return figure


@in_page_style
def draw_motion(products: Products) -> Figure:
    """Draw Fig. 2: three orthographic views of motion and structure."""
    motion, maps = _require(read_motion(products), "motion"), read_landing_maps(products)
    # without a map the vertical is unknown; the first camera's optical axis replaces it
    upright_from_camera = np.diag([1.0, -1.0, -1.0]) if maps is None else maps.surface_from_camera
    figure = Figure(figsize=(9.0, 3.6), layout="constrained", facecolor="none")
    views = (("from above", 0, 1), ("along y", 0, 2), ("along x", 1, 2))
    for axes, (name, *axis_pair) in zip(figure.subplots(1, 3), views, strict=True):
        _draw_motion_view(axes, motion, upright_from_camera, axis_pair)
        axes.set_title(f"View {name}", fontsize=9)
    figure.axes[0].legend(loc="upper left", fontsize=7, labelcolor=WHITE)
    return figure


def draw_epipolar(products: Products) -> Figure:
    """Draw Fig. 3: structure pixels in the first image, their segments and matches in the second."""
    images = _require(read_images(products), "images")
    matches = _require(read_matches(products), "matches")
    # draw every `step`-th row and column of the grid, so that at most `_MAX_MATCHES` are drawn
    step, indices = 1, np.arange(len(matches.grid))
    v, u = (np.unique(matches.grid[:, index], return_inverse=True)[1] for index in (1, 0))
    while len(indices) > _MAX_MATCHES:
        step += 1
        indices = np.flatnonzero((v % step == step // 2) & (u % step == step // 2))
    n_pixels, n_matches = f"{len(matches.grid):,}", f"{int(matches.accepted.sum()):,}"
    if len(indices) < len(matches.grid):
        n_pixels = f"{len(indices):,} of {n_pixels}"
        n_matches = f"{int(matches.accepted[indices].sum()):,} of {n_matches}"
    segments = np.stack([matches.starts[indices], matches.ends[indices]])
    matched = matches.matched[indices][matches.accepted[indices]]
    first_marks = [Mark(matches.grid[indices], _SQUARE | {"color": "#ff4b3e"})]
    second_marks = [Mark(segments, _SEGMENT | {"color": "#35d46b"}), Mark(matched, _SQUARE | {"color": BLUE})]
    left = Panel(images[0], f"First image: {n_pixels} structure pixels", first_marks)
    right = Panel(images[1], f"Second image: {n_matches} matches", second_marks)
    return draw_panels([[left, right]], _PAIR_SIZE_IN)


@in_page_style
def draw_elevation(products: Products) -> Figure:
    """Draw Fig. 4: two views of the elevation map."""
    maps = _require(read_landing_maps(products), "maps")
    figure = Figure(figsize=(9.0, 3.9), layout="constrained")
    for index, (azimuth, name) in enumerate(((-115.0, "Elevation map (m)"), (-25.0, "The same from another side"))):
        axes = figure.add_subplot(1, 2, index + 1, projection="3d", computed_zorder=False)
        colours = np.broadcast_to(np.array(to_rgb("#b9bec4")), (*maps.elevation_m.shape, 3))
        _draw_terrain(axes, maps, colours, azimuth, name)
    return figure


@in_page_style
def draw_maps(products: Products) -> Figure:
    """Draw Fig. 5 (A): elevation, roughness, slope and safe landing map; bottom row: truth in the same coordinates."""
    maps = _require(read_landing_maps(products), "maps")
    truth = _require(read_ground_truth(products), "truth")
    figure = Figure(figsize=(11.0, 5.6), layout="constrained")
    map_row, truth_row = figure.subplots(2, 4)
    degrees = np.degrees(maps.slope_rad)
    median = np.nanmedian(maps.elevation_m)
    max_deviation_m = float(np.nanquantile(np.abs(maps.elevation_m - median), 0.99)) or 1.0
    cells = maps.world_to_cell(truth.offset_from_nadir_m)
    coverage = np.where(truth.covered, 1.0, np.nan)
    true_degrees = np.degrees(truth.slope_rad) * coverage
    estimated_and_true = {
        "elevation (m)": (maps.elevation_m - median, truth.elevation_m - median),
        "roughness (m)": (maps.roughness_m, truth.roughness_m * coverage),
        "slope (deg)": (degrees, true_degrees),
    }
    limits = {"roughness (m)": maps.max_roughness_m, "slope (deg)": float(np.degrees(maps.max_slope_rad))}
    # the last column is the safe landing map
    for upper, lower, name in zip(map_row, truth_row, estimated_and_true, strict=False):
        map_values, true_values = estimated_and_true[name]
        colour_scale = {"vmin": -max_deviation_m, "vmax": max_deviation_m, "cmap": ELEVATION_COLOURS}
        if name in limits:
            colour_scale = {"vmin": 0.0, "vmax": 2.0 * limits[name], "cmap": HAZARD_COLOURS}
        image = upper.imshow(map_values, interpolation="nearest", **colour_scale)
        lower.pcolormesh(cells[..., 1], cells[..., 0], true_values, shading="nearest", rasterized=True, **colour_scale)
        colour_bar = figure.colorbar(
            image, ax=[upper, lower], orientation="horizontal", shrink=0.9, pad=0.02, aspect=30
        )
        colour_bar.outline.set_visible(False)
        colour_bar.ax.tick_params(labelsize=7)
        upper.set_title(name.capitalize(), fontsize=9)
        lower.set_title(f"True {name}", fontsize=9)
    _draw_safety(map_row[3], truth_row[3], maps, truth)
    rows, columns = maps.elevation_m.shape
    for axes in (*map_row, *truth_row):
        for name, (row, column) in drawn_sites(maps).items():
            _mark_site(axes, np.array([column, row]), name)
        axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), xticks=[], yticks=[], aspect="equal")
        axes.set_facecolor(UNKNOWN)
        axes.grid(visible=False)
    return figure


def _draw_safety(map_axes: Axes, truth_axes: Axes, maps: LandingMaps, truth: StoredGroundTruth) -> None:
    colour_scale: dict[str, Any] = {"vmin": 0, "vmax": 2, "cmap": SAFETY_COLOURS}
    map_axes.imshow(maps.safety, interpolation="nearest", **colour_scale)
    # hazards (2) are also hatched, since colour must not be the only distinction
    if (maps.safety > 1.5).any() and (maps.safety < 1.5).any():
        map_axes.contourf(maps.safety, levels=[1.5, 2.5], colors="none", hatches=["////"])
    cells = maps.world_to_cell(truth.offset_from_nadir_m)
    safety = np.where(truth.covered, np.where(truth.safe, 0.0, 2.0), 1.0)
    truth_axes.pcolormesh(cells[..., 1], cells[..., 0], safety, shading="nearest", rasterized=True, **colour_scale)
    if is_unknown_everywhere(maps):
        map_axes.text(0.5, 0.9, "unknown everywhere", transform=map_axes.transAxes, ha="center", va="top", fontsize=9)
    map_axes.set_title("Safe landing map", fontsize=9)
    truth_axes.set_title("True safety", fontsize=9)
    for name, colour in (("safe", GREEN), ("hazard", RED), ("unknown", UNKNOWN)):
        truth_axes.plot([], [], "s", color=colour, label=name)
    for name in drawn_sites(maps):
        truth_axes.plot([], [], **_SITE_MARKERS[name], label=SITE_NAMES[name])
    truth_axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=3, fontsize=7, columnspacing=1.0)


def is_unknown_everywhere(maps: LandingMaps) -> bool:
    """Whether the safe landing map has neither a safe cell nor a hazard."""
    return not bool(np.any((maps.safety < 0.5) | (maps.safety > 1.5)))


def drawn_sites(maps: LandingMaps) -> dict[str, Float[np.ndarray, "2"]]:
    """Return row and column of the sites inside the map, by key of `SITE_NAMES`."""
    rows, columns = maps.elevation_m.shape
    sites = {"apriori": maps.apriori, "site": maps.site}
    return {name: cell for name, cell in sites.items() if 0 <= cell[0] <= rows - 1 and 0 <= cell[1] <= columns - 1}


@in_page_style
def draw_site(products: Products) -> Figure:
    """Draw Fig. 7 and Fig. 5 (B): the first image; safe landing map and site on the image, and on the terrain."""
    images = _require(read_images(products), "images")
    maps = _require(read_landing_maps(products), "maps")
    figure = Figure(figsize=(11.0, 3.6), layout="constrained")
    image_axes, overlay_axes = figure.add_subplot(1, 3, 1), figure.add_subplot(1, 3, 2)
    for axes in (image_axes, overlay_axes):
        show_image(axes, images[0])
    limits = {"xlim": overlay_axes.get_xlim(), "ylim": overlay_axes.get_ylim()}
    if np.isfinite(maps.pixels).all():
        mapped_safety = np.where(np.isfinite(maps.elevation_m), maps.safety, np.nan)
        overlay_axes.pcolormesh(
            maps.pixels[..., 0], maps.pixels[..., 1], mapped_safety, shading="nearest", alpha=0.38,
            vmin=0, vmax=2, cmap=SAFETY_COLOURS, rasterized=True, linewidth=0.0,
        )  # fmt: skip
    overlay_axes.set(**limits)
    for axes in (image_axes, overlay_axes):
        for name, cell in (("apriori", maps.apriori), ("site", maps.site)):
            pixel = _value_at_cell(maps.pixels, cell)
            if pixel is not None:
                _mark_site(axes, pixel, name)
    image_axes.set_title("First image", fontsize=9)
    overlay_axes.set_title("Safe landing map on the image", fontsize=9)
    terrain = figure.add_subplot(1, 3, 3, projection="3d", computed_zorder=False)
    colours = SAFETY_COLOURS(np.clip(np.nan_to_num(maps.safety, nan=1.0), 0, 2).astype(np.int64))[..., :3]
    _draw_terrain(terrain, maps, colours, -115.0, "On the terrain")
    return figure


class _DrawnCamera(NamedTuple):
    """A camera of the figure of the motion: its rotation, translation and rays are those of `EstimatedMotion`.

    line: style of the outline; a camera with a dotted outline has no rays and axes in the figure
    """

    name: str
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    corner_rays: Float[np.ndarray, "4 3"]
    colour: str
    line: str = "-"


def _draw_motion_view(
    axes: Axes, motion: EstimatedMotion, upright_from_camera: Float[np.ndarray, "3 3"], axis_pair: list[int]
) -> None:
    """Draw an orthographic view onto two axes of an upright frame at the first camera."""
    depth = float(np.median(motion.points[:, 2]))

    def project(points: np.ndarray) -> np.ndarray:
        return np.asarray((points @ upright_from_camera.T)[..., axis_pair])

    axes.plot(*project(motion.points).T, "o", color=WHITE, markersize=2.2, label="features")
    first_rays, second_rays = motion.corner_rays
    for camera in (
        _DrawnCamera("first camera", np.eye(3), np.zeros(3), first_rays, "#ff4b3e"),
        _DrawnCamera("second camera", motion.rotation, motion.translation, second_rays, "#35d46b"),
        _DrawnCamera("second camera, true", motion.true_rotation, motion.true_translation, second_rays, WHITE, ":"),
    ):
        centre, colour = -camera.rotation.T @ camera.translation, camera.colour
        footprint = centre + camera.corner_rays * depth @ camera.rotation
        closed_outline = project(np.vstack([footprint, footprint[:1]]))
        axes.plot(*closed_outline.T, color=colour, linestyle=camera.line, linewidth=1.1, label=camera.name)
        if camera.line == "-":
            for corner in footprint:
                axes.plot(*project(np.array([centre, corner])).T, color=colour, linewidth=0.5, alpha=0.5)
            # axes of the camera, with 12 % of the depth as length
            for axis_vector in 0.12 * depth * camera.rotation:
                axes.plot(*project(np.array([centre, centre + axis_vector])).T, color=colour, linewidth=1.8)
    axes.set_facecolor(_BACKGROUND)
    axes.grid(visible=False)
    axes.set_aspect("equal", adjustable="datalim")
    axes.tick_params(labelsize=7)
    axes.set_xlabel(f"{'xyz'[axis_pair[0]]} (m)", fontsize=8)
    axes.set_ylabel(f"{'xyz'[axis_pair[1]]} (m)", fontsize=8)


def _draw_terrain(
    axes: Any, maps: LandingMaps, colours: Float[np.ndarray, "rows columns 3"], azimuth_deg: float, name: str
) -> None:
    """Draw the elevation map as a shaded surface in these colours, with the sites on it; the axes are 3-D.

    `name` is the title, to which the exaggeration of heights is added.
    """
    rows, columns = maps.elevation_m.shape
    step = max(1, round(max(rows, columns) / _MAX_DRAWN_CELLS))
    grid = np.moveaxis(maps.positions(np.moveaxis(np.indices((rows, columns)), 0, -1)), -1, 0)
    heights = maps.elevation_m - np.nanmedian(maps.elevation_m)
    sides = maps.cell_m * np.array([columns, rows])
    height_range_m = float(np.nanmax(heights) - np.nanmin(heights))
    # exaggerate heights so that the relief of flat ground is visible
    exaggeration = next(
        (factor for factor in (1.0, 2.0, 5.0) if factor * height_range_m >= _MIN_RELIEF * sides.max()), 10.0
    )
    style: dict[str, Any] = {"vert_exag": exaggeration, "dx": maps.cell_m, "dy": maps.cell_m, "blend_mode": "soft"}
    shaded = LightSource(315.0, 45.0).shade_rgb(np.asarray(colours), np.nan_to_num(heights), **style)
    subset = np.s_[::step, ::step]
    axes.plot_surface(
        *(coordinate[subset] for coordinate in grid), heights[subset], facecolors=shaded[subset], rcount=200,
        ccount=200, shade=False, antialiased=False, linewidth=0.0, rasterized=True, zorder=1,
    )  # fmt: skip
    offset_m = 0.02 * float(sides.max()) / exaggeration
    for site, cell in (("apriori", maps.apriori), ("site", maps.site)):
        height = _value_at_cell(heights[..., None], cell)
        if height is not None and np.isfinite(height).all():
            position = maps.positions(cell)
            axes.plot([position[0]], [position[1]], [float(height[0]) + offset_m], **_SITE_MARKERS[site], zorder=5)
    axes.set_box_aspect((sides[0], sides[1], max(exaggeration * height_range_m, 0.05 * sides.max())), zoom=1.3)
    axes.view_init(elev=38.0, azim=azimuth_deg)
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_title(name if exaggeration == 1.0 else f"{name}, heights × {exaggeration:g}", fontsize=9)
    axes.tick_params(labelsize=6, pad=-2, colors=MUTED)
    for axis_name, axis, bins in (("x", axes.xaxis, 4), ("y", axes.yaxis, 4), ("z", axes.zaxis, 3)):
        axes.locator_params(axis=axis_name, nbins=bins)
        axis.label.set_size(7)
        axis.labelpad = -6
        axis.set_pane_color((0.0, 0.0, 0.0, 0.0))


def _mark_site(axes: Axes, pixel: Float[np.ndarray, "2"], name: str) -> None:
    axes.plot([pixel[0]], [pixel[1]], **_SITE_MARKERS[name], path_effects=_WHITE_OUTLINE, zorder=6)


def _value_at_cell(values: Float[np.ndarray, "rows columns k"], cell: Float[np.ndarray, "2"]) -> np.ndarray | None:
    """Return the values at the nearest cell; None outside the map."""
    if not np.isfinite(cell).all():
        return None
    row, column = (int(coordinate) for coordinate in np.rint(cell))
    if not (0 <= row < values.shape[0] and 0 <= column < values.shape[1]):
        return None
    return values[row, column] if np.isfinite(values[row, column]).all() else None


def _require(product: Product | None, name: str) -> Product:
    if product is None:
        raise ValueError(f"the products contain no {name}")
    return product


class _PaperFigure(NamedTuple):
    """Function that draws a figure, and readers of all products that it needs; they return None for a missing one."""

    draw: Callable[[Products], Figure]
    readers: Sequence[Callable[[Products], object]]


#: Figures by file name, in the paper's order.
_FIGURES: Mapping[str, _PaperFigure] = {
    "fig1-tracks": _PaperFigure(draw_tracks, (read_images, read_tracked_features)),
    "fig2-motion": _PaperFigure(draw_motion, (read_motion,)),
    "fig3-epipolar": _PaperFigure(draw_epipolar, (read_images, read_matches)),
    "fig4-elevation": _PaperFigure(draw_elevation, (read_landing_maps,)),
    "fig5-maps": _PaperFigure(draw_maps, (read_landing_maps, read_ground_truth)),
    "fig7-site": _PaperFigure(draw_site, (read_images, read_landing_maps)),
}
#: Functions that draw the figures, by file name.
FIGURES = {name: figure.draw for name, figure in _FIGURES.items()}


def available_figures(products: Products) -> list[str]:
    """List the names of the figures whose products a case contains: these figures can be drawn."""
    return [name for name, figure in _FIGURES.items() if all(read(products) is not None for read in figure.readers)]
