"""Overlap of a descent's image pairs: the ground that both images show, outside of the bright spot opposite the sun.

The overlap follows from true heights, attitudes and camera alone, so that it is the same for every algorithm. As in the
DIMES paper (section II.A), the lander has no horizontal motion between the images; the minimum width leaves room for
it. Polygons are outlines (east, north) on level ground, relative to the nadir point.
"""

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float64

from marsyard.scenarios.descent.images import camera_optics
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.descent.world import DescentWorld
from marsyard.scenarios.interface import Scalar
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import State

#: Minimum width of the overlap, m: diameter of the largest circle in it. Johnson et al., "Field Testing of the MER
#: DIMES", require an area "at least 110 m across": a displacement of 30 m/s in 3.75 s.
MIN_WIDTH_M = 110.0
#: Radius of the bright spot around the anti-solar point, which is excluded: beyond it the opposition surge is smooth
#: over a hundred metres. The paper excludes the spot and gives no radius; this one is assumed.
ZERO_PHASE_RADIUS_RAD = np.deg2rad(4.0)
#: Ground at larger off-nadir angles is excluded: a pixel covers 15 times as much of it as at the nadir (assumed).
MAX_OFF_NADIR_RAD = np.deg2rad(75.0)
#: Width of the ground patch whose mean height is the level of the ground, m.
GROUND_PATCH_M = 200.0
#: Spacing of the grid on which the overlap is measured, m, and binary digits of a polygon's vertices in a cell.
_CELL_M, _VERTEX_BITS = 5.0, 4
#: Number of points of each side of an image, and of the outline of the bright spot.
_PER_SIDE, _SPOT_POINTS = 8, 48
Polygon = Float64[np.ndarray, "n 2"]


def overlap_row(p: DescentScenarioParameters, world: DescentWorld, states: Sequence[State]) -> dict[str, Scalar]:
    """Compute the widths of the overlap of the triple's image pairs; empty with fewer than three images.

    `feasible_overlap`: both pairs have an area of the width `MIN_WIDTH_M`.
    """
    if p.triple_indices is None:
        return {}
    states = [states[index] for index in p.triple_indices]
    camera = camera_optics(p.camera).camera
    patch_samples = GROUND_PATCH_M / world.surface.spacing_m
    level = int(np.clip(np.rint(np.log2(max(patch_samples, 1.0))), 0, len(world.surface.levels) - 1))
    heights = [world.surface.height(state.position_m[0], state.position_m[1], level) for state in states]
    ground_m = float(np.mean(heights))
    first, second = (
        overlap_width_m(pair, camera, ground_m, np.asarray(world.sun.direction, dtype=np.float64))
        for pair in pairwise(states)
    )
    return {
        "feasible_overlap": min(first, second) >= MIN_WIDTH_M,
        "overlap_width_first_pair_m": first,
        "overlap_width_second_pair_m": second,
    }


def overlap_width_m(
    states: Sequence[State], camera: CameraModel, ground_m: float, sun_direction: Float64[np.ndarray, "3"]
) -> float:
    """Compute the diameter of the largest circle of level ground that all images show outside of the bright spot.

    The horizontal positions of the states are ignored: all images are taken above one point (section II.A).

    The result is 0 without common ground; its resolution is the spacing of the grid, 5 m.
    """
    footprints = [footprint(state, camera, ground_m) for state in states]
    low = np.max([polygon.min(axis=0) for polygon in footprints], axis=0)
    high = np.min([polygon.max(axis=0) for polygon in footprints], axis=0)
    if np.any(high <= low):
        return 0.0
    columns, rows = np.ceil((high - low) / _CELL_M).astype(int) + 1
    overlap = np.ones((rows, columns), dtype=np.uint8)
    for state, polygon in zip(states, footprints, strict=True):
        overlap &= _fill(polygon, low, overlap.shape)
        overlap &= 1 - _fill(zero_phase_spot(state, ground_m, sun_direction), low, overlap.shape)
    # the cells of the border belong to the ground outside
    distances = cv2.distanceTransform(np.pad(overlap, 1), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return 2.0 * _CELL_M * float(distances.max())


def footprint(state: State, camera: CameraModel, ground_m: float) -> Polygon:
    """Compute the outline (east, north) of the level ground that an image shows, from its nadir point, world axes."""
    steps, zeros, ones = np.arange(_PER_SIDE) / _PER_SIDE, np.zeros(_PER_SIDE), np.ones(_PER_SIDE)
    fractions = np.column_stack(
        [np.concatenate([steps, ones, 1.0 - steps, zeros]), np.concatenate([zeros, steps, ones, 1.0 - steps])]
    )
    pixels = fractions * (np.array(camera.size) - 1.0)
    _, directions = camera.transform(state.world_from_body).rays(pixels)
    return _intersect_ground(state, directions, ground_m)


def zero_phase_spot(state: State, ground_m: float, sun_direction: Float64[np.ndarray, "3"]) -> Polygon:
    """Compute the outline (east, north) of the bright spot on level ground: a cone around the anti-solar direction."""
    axis = -sun_direction / np.linalg.norm(sun_direction)
    # two unit vectors that are perpendicular to the axis and to each other, from a direction that is not parallel to it
    side = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angles = np.linspace(0.0, 2.0 * np.pi, _SPOT_POINTS, endpoint=False)[:, None]
    circle = np.cos(angles) * side + np.sin(angles) * np.cross(axis, side)
    directions = np.cos(ZERO_PHASE_RADIUS_RAD) * axis + np.sin(ZERO_PHASE_RADIUS_RAD) * circle
    return _intersect_ground(state, directions, ground_m)


def _intersect_ground(state: State, directions: Float64[np.ndarray, "n 3"], ground_m: float) -> Polygon:
    """Intersect unit directions with level ground; those beyond `MAX_OFF_NADIR_RAD` are lowered to this angle."""
    horizontal = np.hypot(directions[:, 0], directions[:, 1])
    off_nadir = np.minimum(np.arctan2(horizontal, -directions[:, 2]), MAX_OFF_NADIR_RAD)
    distances = (state.position_m[2] - ground_m) * np.tan(off_nadir)
    azimuths = directions[:, :2] / np.maximum(horizontal, 1e-12)[:, None]
    return np.asarray(distances[:, None] * azimuths)


def _fill(polygon: Polygon, low: Float64[np.ndarray, "2"], shape: tuple[int, ...]) -> np.ndarray:
    """Return a grid that is 1 inside a polygon and 0 outside."""
    vertices = np.rint(2**_VERTEX_BITS * (polygon - low) / _CELL_M).astype(np.int32)
    return np.asarray(cv2.fillPoly(np.zeros(shape, dtype=np.uint8), [vertices], (1,), shift=_VERTEX_BITS))
