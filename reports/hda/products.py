"""Products of a landing case, read from files and checked: images, tracks, motion, matches, maps and ground truth."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from marsyard.algorithms.hda.elevation import ElevationMap
from marsyard.reports.products import array_of_shape, numeric_product, read_arrays, to_matrix

MapArray = Float[np.ndarray, "rows columns"]
Pixels = Float[np.ndarray, "n 2"]


@dataclass(frozen=True)
class TrackedFeatures:
    """Features and their tracks, pixels (u, v)."""

    first: Pixels
    second: Pixels
    accepted: Bool[np.ndarray, " n"]


@dataclass(frozen=True)
class EstimatedMotion:
    """Motion `second_from_first` of the camera, and structure in the first camera's frame, metres.

    - rotation, translation: the estimate; a point has the coordinates x_second = rotation @ x_first + translation
    - true_rotation, true_translation: the true motion, in the same form
    - corner_rays: rays of each image's corners in its camera's frame, with depth 1
    - points: positions of the accepted tracks
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    corner_rays: tuple[Float[np.ndarray, "4 3"], Float[np.ndarray, "4 3"]]
    true_rotation: Float[np.ndarray, "3 3"]
    true_translation: Float[np.ndarray, "3"]
    points: Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class EpipolarMatches:
    """Structure pixels of the first image, their epipolar segments and matches in the second, pixels (u, v)."""

    grid: Pixels
    starts: Pixels
    ends: Pixels
    matched: Pixels
    accepted: Bool[np.ndarray, " n"]


@dataclass(frozen=True)
class LandingMaps(ElevationMap):
    """Elevation map, hazards and selected site of the algorithm, in the surface frame.

    The surface frame is level, with its origin at the first camera (`marsyard.algorithms.hda.estimator`).

    - safety: 0 safe, 1 unknown, 2 hazard
    - pixels: pixel (u, v) of each cell's centre in the first image; extrapolated if the elevation is unknown
    - site, apriori: row and column of the safe and of the a-priori site; NaN for no site
    - max_slope_rad, max_roughness_m: limits of the algorithm
    - lander_diameter_m: diameter of the lander's footprint
    """

    roughness_m: MapArray
    slope_rad: MapArray
    safety: MapArray
    pixels: Float[np.ndarray, "rows columns 2"]
    apriori: Float[np.ndarray, "2"]
    surface_from_camera: Float[np.ndarray, "3 3"]
    world_from_surface: Float[np.ndarray, "3 3"]
    max_slope_rad: float
    max_roughness_m: float
    lander_diameter_m: float
    site: Float[np.ndarray, "2"]

    def world_to_cell(self, offset_from_nadir_m: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Convert offsets (x, y) from the camera's nadir point along the world's axes to fractional (row, column)."""
        # row vectors times the rotation: offset in the surface frame
        return self.cells(offset_from_nadir_m @ self.world_from_surface[:2, :2])


@dataclass(frozen=True)
class StoredGroundTruth:
    """Ground truth on its sampling grid.

    - offset_from_nadir_m: world (x, y) relative to the camera's true nadir point
    - elevation_m: exact height relative to the camera
    - slope_rad, roughness_m, safe: values of a lander's footprint centred at the position
    - covered: whether both images contain the complete footprint
    """

    offset_from_nadir_m: Float[np.ndarray, "rows columns 2"]
    elevation_m: MapArray
    slope_rad: MapArray
    roughness_m: MapArray
    safe: Bool[np.ndarray, "rows columns"]
    covered: Bool[np.ndarray, "rows columns"]


def is_hda_case(products: Mapping[str, Any]) -> bool:
    """Whether products contain two images and the ground truth of a landing."""
    return read_images(products) is not None and read_ground_truth(products) is not None


def read_images(products: Mapping[str, Any]) -> tuple[Float[np.ndarray, "_ _"], Float[np.ndarray, "_ _"]] | None:
    """Read the two images; None if one is missing."""
    first, second = (to_matrix(products.get(f"image_{number}")) for number in (1, 2))
    return None if first is None or second is None else (first, second)


def read_tracked_features(products: Mapping[str, Any]) -> TrackedFeatures | None:
    """Read features and tracks; None if missing."""
    arrays = read_arrays(products, {"features": ("n", 2), "tracked": ("n", 2), "tracks_accepted": ("n",)})
    if arrays is None:
        return None
    features, tracked, accepted = arrays
    return TrackedFeatures(features, tracked, accepted > 0.5)


def read_motion(products: Mapping[str, Any]) -> EstimatedMotion | None:
    """Read motion and structure; None if the motion was not estimated."""
    names = ("rotation", "translation", "true_rotation", "true_translation", "frustum_0", "frustum_1")
    shapes = ((3, 3), (3,), (3, 3), (3,), (4, 3), (4, 3))
    arrays = read_arrays(products, dict(zip(names, shapes, strict=True)), finite=True)
    points = array_of_shape(products.get("sparse_points"), None, 3)
    if arrays is None or points is None or not len(points):
        return None
    rotation, translation, true_rotation, true_translation, first_rays, second_rays = arrays
    return EstimatedMotion(
        rotation=rotation,
        translation=translation,
        corner_rays=(first_rays, second_rays),
        true_rotation=true_rotation,
        true_translation=true_translation,
        points=points,
    )


def read_matches(products: Mapping[str, Any]) -> EpipolarMatches | None:
    """Read structure pixels and matches; None if missing."""
    shapes = dict.fromkeys(("grid", "segment_starts", "segment_ends", "matched"), ("n", 2))
    arrays = read_arrays(products, {**shapes, "matches_accepted": ("n",)})
    if arrays is None:
        return None
    grid, starts, ends, matched, accepted = arrays
    return EpipolarMatches(grid, starts, ends, matched, accepted > 0.5)


class _Limits(NamedTuple):
    """Values of the product `limits`: limits of the algorithm, and diameter of the lander's footprint."""

    max_slope_rad: float
    max_roughness_m: float
    lander_diameter_m: float


def read_landing_maps(products: Mapping[str, Any]) -> LandingMaps | None:
    """Read the maps; None if the case has no elevation map."""
    maps = read_arrays(products, dict.fromkeys(("elevation", "roughness", "slope", "safety"), ("v", "u")))
    if maps is None:
        return None
    elevation_m, roughness_m, slope_rad, safety = maps
    if min(elevation_m.shape) < 2:
        return None
    shapes = {"corner": (2,), "apriori": (2,), "surface_from_camera": (3, 3), "world_from_surface": (3, 3)}
    frames = read_arrays(products, shapes | {"limits": (len(_Limits._fields),)}, finite=True)
    pixels, cell_m = array_of_shape(products.get("map_pixels"), *elevation_m.shape, 2), _read_positive(products, "cell")
    if frames is None or pixels is None or cell_m is None:
        return None
    corner_m, apriori, surface_from_camera, world_from_surface, stored_limits = frames
    limits = _Limits(*stored_limits.tolist())
    if min(limits) <= 0.0:
        return None
    (site,) = read_arrays(products, {"site": (2,)}, finite=True) or [np.full(2, np.nan)]
    return LandingMaps(
        elevation_m=elevation_m,
        corner_m=corner_m,
        cell_m=cell_m,
        roughness_m=roughness_m,
        slope_rad=slope_rad,
        safety=safety,
        pixels=_extrapolate_pixels(pixels),
        apriori=apriori,
        surface_from_camera=surface_from_camera,
        world_from_surface=world_from_surface,
        max_slope_rad=limits.max_slope_rad,
        max_roughness_m=limits.max_roughness_m,
        lander_diameter_m=limits.lander_diameter_m,
        site=site,
    )


def _extrapolate_pixels(pixels: Float[np.ndarray, "rows columns 2"]) -> Float[np.ndarray, "rows columns 2"]:
    """Replace pixels that are not finite by an affine map of row and column, which is exact for level ground.

    The map is fitted to the finite pixels. Returns the pixels unchanged if fewer than three are finite.
    """
    is_finite = np.isfinite(pixels).all(axis=-1)
    if is_finite.all() or is_finite.sum() < 3:
        return pixels
    rows_columns = np.moveaxis(np.indices(is_finite.shape), 0, -1)
    cells = np.concatenate([rows_columns, np.ones((*is_finite.shape, 1))], axis=-1)
    affine = np.linalg.lstsq(cells[is_finite], pixels[is_finite], rcond=None)[0]
    return np.where(is_finite[..., None], pixels, cells @ affine)


def read_ground_truth(products: Mapping[str, Any]) -> StoredGroundTruth | None:
    """Read the ground truth; None if missing."""
    positions = array_of_shape(products.get("true_positions"), None, None, 2)
    heights = to_matrix(products.get("true_heights"))
    frames = read_arrays(products, {"camera_true": (4, 4), "true_corner": (2,)}, finite=True)
    spacing_m = _read_positive(products, "true_spacing")
    if positions is None or min(positions.shape[:2]) < 2 or heights is None or frames is None or spacing_m is None:
        return None
    names = ("true_slope", "true_roughness", "true_safe", "true_covered")
    maps = read_arrays(products, dict.fromkeys(names, positions.shape[:2]), finite=True)
    if maps is None:
        return None
    world_from_body, corner = frames
    camera_position = world_from_body[:3, 3]
    elevation_m = _nearest_heights(positions, heights, corner, spacing_m) - camera_position[2]
    slope_rad, roughness_m, safe, covered = maps
    offset_from_nadir_m = positions - camera_position[:2]
    return StoredGroundTruth(offset_from_nadir_m, elevation_m, slope_rad, roughness_m, safe > 0.5, covered > 0.5)


def _nearest_heights(
    positions: Float[np.ndarray, "rows columns 2"],
    heights: Float[np.ndarray, "height_rows height_columns"],
    corner: Float[np.ndarray, "2"],
    spacing_m: float,
) -> MapArray:
    """Return the stored height nearest to each position (x, y); beyond the border, that of the nearest border cell.

    The height of row i and column j is at x = corner[0] + j spacing_m and y = corner[1] + i spacing_m. An
    unknown position (NaN) has the height of the corner.
    """
    # (x, y) counts columns and rows, an index is (row, column): reverse the order
    indices = np.nan_to_num((positions - corner)[..., ::-1] / spacing_m)
    last_index = np.array(heights.shape) - 1
    rows, columns = np.moveaxis(np.clip(np.rint(indices), 0, last_index).astype(np.int64), -1, 0)
    return np.asarray(heights[rows, columns])


def _read_positive(products: Mapping[str, Any], name: str) -> float | None:
    value = numeric_product(products.get(name))
    return float(value.item()) if value is not None and value.size == 1 and value.item() > 0.0 else None
