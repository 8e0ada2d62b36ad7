"""The mesh of the ground that pyrender draws: lines that are dense below the camera, and the cells that it sees."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int, UInt32
from scipy.optimize import brentq
from scipy.spatial import ConvexHull

from marsyard.sim.render.kernels.mesh import build_mesh, spans_in_hull
from marsyard.sim.render.scene import Scene
from marsyard.sim.terrain import Surface

#: Number of terrain levels in a kernel call: kernels are compiled for a fixed number of arrays. A terrain with 2**15
#: samples along a side has 12 levels.
LEVELS = 12
#: Coordinates of grid lines, increasing, and first and end cell of each strip between two lines of y.
Lines = Float64[np.ndarray, "lines"]
Spans = Int[np.ndarray, "strips 2"]
Vertices = Float64[np.ndarray, "vertices 3"]
Faces = UInt32[np.ndarray, "faces 3"]


def graded_offsets(half_width_m: float, finest_m: float, count: int) -> Lines:
    """Compute increasing offsets ``a sinh(b i)`` from -half_width_m to half_width_m, with spacing `finest_m` at 0.

    The spacing grows in proportion to the distance, as the footprint of a pixel does. Raises ValueError if `count` is
    even, or if `count` offsets with a constant spacing of `finest_m` exceed `half_width_m`.
    """
    if count % 2 == 0:
        raise ValueError(f"{count} offsets have no middle; an odd number is needed")
    steps = np.arange(count) - (count - 1) / 2.0
    last = steps[-1]
    if finest_m * last >= half_width_m:
        raise ValueError(f"{count} offsets with a spacing of {finest_m:g} m exceed {half_width_m:g} m")
    log_ratio = np.log(half_width_m / finest_m)
    # from almost constant spacing to the largest hyperbolic sine that does not overflow
    b = brentq(lambda x: np.log(np.sinh(x * last) / np.sinh(x)) - log_ratio, 1e-6 / last, 500.0 / last, xtol=1e-15)
    return np.asarray(finest_m / np.sinh(b) * np.sinh(b * steps))


def lines_between(lines: Lines, low: float, high: float) -> Lines:
    """Select the grid lines between two bounds, with a margin of two lines on each side; at least three lines."""
    first = max(int(np.searchsorted(lines, low)) - 2, 0)
    last = min(int(np.searchsorted(lines, high)) + 2, lines.size)
    if last - first < 3:
        first, last = max(min(first, lines.size - 3), 0), min(max(last, 3), lines.size)
    return lines[first:last]


def cell_spans_in_hull(x: Lines, y: Lines, points: Float64[np.ndarray, "points 2"]) -> Spans:
    """Find the spans of cells that overlap the convex hull of points (not all on a line)."""
    return np.asarray(spans_in_hull(x, y, points[ConvexHull(points).vertices]))


def ground_mesh(surface: Surface, x: Lines, y: Lines, spans: Spans | None = None) -> tuple[Vertices, Faces]:
    """Triangulate spans of cells (by default all) between grid lines at `x` and `y`, world coordinates in metres.

    Returns vertices, and the vertex numbers of the faces, counter-clockwise seen from above. To avoid aliasing, each
    vertex takes its height from the terrain level with about the same spacing as the grid.
    """
    if spans is None:
        spans = np.tile([0, x.size - 1], (y.size - 1, 1))
    level_of_x, level_of_y = (
        np.clip(np.floor(np.log2(np.gradient(lines) / surface.spacing_m)), 0, len(surface.levels) - 1).astype(int)
        for lines in (x, y)
    )
    levels = surface.levels + surface.levels[-1:] * (LEVELS - len(surface.levels))
    vertices, faces = build_mesh(levels, surface.spacing_m, x, y, level_of_x, level_of_y, spans)
    return vertices, faces


def visible_mesh(
    scene: Scene, position: Float64[np.ndarray, "3"], directions: Float64[np.ndarray, "rays 3"]
) -> tuple[Vertices, Faces]:
    """Triangulate the ground that a camera at a position sees between rays in these directions, unit vectors."""
    # the visible ground lies between two horizontal planes: a ray ends at the lower one, or at the mesh's border
    low, high = scene.height_range_m
    descent_rates = np.minimum(directions[:, 2], -1e-9)
    plane_z = (low, max(high, position[2]))
    end_distances = [np.clip((z - position[2]) / descent_rates, 0.0, 2.0 * scene.mesh_half_width_m) for z in plane_z]
    points = np.concatenate([position[:2] + distance[:, None] * directions[:, :2] for distance in end_distances])
    # between the rays the border of the visible ground deviates little from a straight line
    margin = 0.02 * (points.max(axis=0) - points.min(axis=0)) + 2.0 * scene.mesh_finest_m
    corners = margin * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    points = (points[:, None] + corners).reshape(-1, 2)
    offsets = graded_offsets(scene.mesh_half_width_m, scene.mesh_finest_m, scene.mesh_lines)
    x, y = (
        lines_between(centre + offsets, first, last)
        for centre, first, last in zip(scene.centre_m, points.min(axis=0), points.max(axis=0), strict=True)
    )
    return ground_mesh(scene.surface, x, y, cell_spans_in_hull(x, y, points))
