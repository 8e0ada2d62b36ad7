"""Perspective view of a case: ground, true and estimated path, cameras and points."""

import math

import cv2
import numpy as np
from jaxtyping import Bool
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from marsyard.reports.figure_style import MARKERS, MUTED, in_page_style
from marsyard.reports.timeline.mesh import camera_outlines, colour
from marsyard.scenarios.timeline import SurfacePatch, Timeline

#: Maximum number of cells of the drawn ground per side, and maximum number of drawn cameras.
_MAX_CELLS, _MAX_CAMERAS = 96, 12
#: Viewing direction, deg.
_AZIMUTH_DEG, _ELEVATION_DEG = -60.0, 28.0
#: Margin around the drawn part of the ground, divided by the extent of the case; minimum extent, m.
_MARGIN, _MIN_EXTENT_M = 0.25, 1.0
#: Tint of the ground, RGB.
_TINT = np.array([1.0, 0.82, 0.66])


@in_page_style
def draw_timeline(timeline: Timeline) -> Figure:
    """Draw ground, paths, cameras and points; axes in metres from the centre of the drawn ground."""
    low, high = _extent(timeline)
    origin = np.array([*np.round(0.5 * (low + high)[:2]), np.round(low[2])])
    figure = Figure(figsize=(6.4, 5.4))
    axes: Axes3D = figure.add_axes((0.0, 0.03, 0.95, 0.97), projection="3d", computed_zorder=False)
    axes.view_init(elev=_ELEVATION_DEG, azim=_AZIMUTH_DEG)
    _draw_ground(axes, timeline.surfaces["ground"], low, high, origin)
    for name, path in timeline.paths.items():
        line = "-" if name == "true" else "--"
        axes.plot(*(path.positions_m - origin).T, line, color=_rgb(name), lw=1.4, label=f"{name} path", zorder=3)
    stride = max(1, math.ceil(len(timeline.images) / _MAX_CAMERAS))
    edges = [camera_outlines(image, float((high - low)[:2].max())) - origin for image in timeline.images[::stride]]
    if edges:
        outlines = Line3DCollection(np.concatenate(edges), colors=[MUTED], linewidths=0.6, zorder=4, label="cameras")
        axes.add_collection3d(outlines)
    for number, (name, points) in enumerate(timeline.points.items()):
        if len(points.positions_m):
            style = {"color": _rgb(name), "marker": MARKERS[number % len(MARKERS)], "s": 22, "depthshade": False}
            axes.scatter(*(points.positions_m - origin).T, label=name, zorder=5, **style)
    axes.set(xlabel="East (m)", ylabel="North (m)", zlabel="Up (m)")
    axes.set_box_aspect((high - low) / (high - low).max())
    for axis, limits in zip(
        (axes.xaxis, axes.yaxis, axes.zaxis), np.stack([low, high], axis=1) - origin[:, None], strict=True
    ):
        axis.set_pane_color((0.0, 0.0, 0.0, 0.0))
        getattr(axes, f"set_{axis.axis_name}lim")(*limits)
    axes.legend(loc="upper left", fontsize=8)
    return figure


def _rgb(name: str) -> tuple[float, float, float]:
    """Return the colour of a path or of points for Matplotlib, 0 to 1."""
    red, green, blue = (value / 255.0 for value in colour(name))
    return red, green, blue


def _extent(timeline: Timeline) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper corner of the drawn box: paths, points and cameras, down to the ground."""
    groups = [path.positions_m for path in timeline.paths.values()]
    groups += [points.positions_m for points in timeline.points.values()]
    groups += [np.array([image.pose.position_m]) for image in timeline.images]
    positions = np.concatenate([group for group in groups if len(group)])
    ground = timeline.surfaces["ground"].points_m.reshape(-1, 3)
    low, high = positions.min(axis=0), positions.max(axis=0)
    # at least as wide as high, so that the ground below a descent is visible
    extent = max(float((high - low).max()), _MIN_EXTENT_M)
    centre, half = 0.5 * (low + high)[:2], (0.5 + _MARGIN) * extent
    low[:2], high[:2] = centre - half, centre + half
    is_inside = ((ground[:, :2] >= low[:2]) & (ground[:, :2] <= high[:2])).all(axis=1)
    if is_inside.any():
        heights = ground[is_inside, 2]
        low[2], high[2] = min(low[2], float(heights.min())), max(high[2], float(heights.max()))
    return low, high


def _draw_ground(axes: Axes3D, patch: SurfacePatch, low: np.ndarray, high: np.ndarray, origin: np.ndarray) -> None:
    """Draw the part of the ground in the box, with its brightness."""
    horizontal = patch.points_m[..., :2]
    inside: Bool[np.ndarray, "rows columns"] = np.all((horizontal >= low[:2]) & (horizontal <= high[:2]), axis=2)
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if not rows.size:
        return
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    size = tuple(int(min(length, _MAX_CELLS)) for length in inside[part].shape[::-1])
    points = cv2.resize(patch.points_m[part], size, interpolation=cv2.INTER_AREA) - origin
    grey = cv2.resize(patch.colours[part], size, interpolation=cv2.INTER_AREA) / 255.0
    axes.plot_surface(
        *np.moveaxis(points, 2, 0), facecolors=grey[..., None] * _TINT, rstride=1, cstride=1, shade=False, linewidth=0,
        rasterized=True, antialiased=False, zorder=1,
    )  # fmt: skip
