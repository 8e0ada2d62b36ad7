"""Match an image of known pose with a map by four matchers: templates, SIFT, ORB, and the landmarks of `lvs`.

The landmarks correct the pose first. For the other matchers, the image is resampled to the pixels of the map, onto the
map's elevation. A homography of the templates aligns both; it includes slopes of the ground that the map does not
contain. A match is correct if it lies within `TOLERANCE_PX` map pixels of its position by this homography; a landmark,
if it agrees with the common pose. The yield is the fraction of correct matches of all templates, features or landmarks
that were searched.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.stats import rankdata

from marsyard.algorithms.arrays import Points2
from marsyard.algorithms.dimes import baselines as orb
from marsyard.algorithms.image.correlation import normalized_correlation
from marsyard.algorithms.image.interest import harris_interest, structure_tensor
from marsyard.algorithms.image.peaks import highest_peak
from marsyard.algorithms.localisation.fine import LandmarkMatches, match_landmarks
from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.algorithms.localisation.landmarks import select_landmarks
from marsyard.algorithms.localisation.map_sampling import elevation_at, map_pixels
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.posed_image import PosedImage
from marsyard.algorithms.localisation.rectification import rectify_patches, view_ground
from marsyard.algorithms.localisation.sift_pose import extract_map_features, flatten, match_descriptors
from marsyard.scenarios.interface import Scalar

#: Matchers, in the order of their ranks if their yields are equal.
MATCHERS = ("template", "sift", "orb", "lvs")
#: Largest distance of a correct match from its position, map pixels (as in the statistics of image pairs; the relief of
#: the ground moves matches by about as much).
TOLERANCE_PX = 2.5
#: Minimum number of templates that agree with a homography (as in the statistics of image pairs).
_MIN_INLIERS = 12
#: Iterations and confidence of RANSAC: enough for 15 % of inliers.
_RANSAC_ITERATIONS, _RANSAC_CONFIDENCE = 20_000, 0.9999
#: Side of the squares in which an image is resampled, map pixels (assumed).
_TILE_PX = 16
#: Side, spacing and search range (in each direction) of the templates, map pixels (assumed).
_TEMPLATE_PX, _TEMPLATE_STEP_PX, _SEARCH_PX = 31, 16, 12
#: Area for each feature of SIFT and of ORB, map pixels (assumed): both find so many in images from Mars.
_FEATURE_AREA_PX = 300
#: Fraction of the templates with the largest Harris interest on the map that are the strong ones (assumed).
_STRONG_FRACTION = 0.25


@dataclass(frozen=True, eq=False)
class ImageFootprint:
    """An image on the pixels of a map, and the map's appearance there.

    - corner: map pixel (column, row) of the first pixel
    - valid: pixels in the image and in the map, within the off-nadir limit
    """

    corner: Int[np.ndarray, "2"]
    image: Float32[np.ndarray, "rows columns"]
    appearance: Float32[np.ndarray, "rows columns"]
    valid: Bool[np.ndarray, "rows columns"]


@dataclass(frozen=True, eq=False)
class MapComparison:
    """Comparison of an image with a map.

    - image: the image with the pose that the landmarks corrected; the given pose if they are too few or inconsistent
    - landmarks: the matched landmarks
    - landmark_pixels: their pixels (column, row) on the map
    - footprint: the image on the pixels of the map; None if they do not overlap
    - row: columns of the matchers (`marsyard.scenarios.measured.columns`)
    """

    image: PosedImage
    landmarks: LandmarkMatches
    landmark_pixels: Points2
    footprint: ImageFootprint | None
    row: dict[str, Scalar]


class _Matched(NamedTuple):
    """Numbers of templates, features or landmarks: correctly matched ones, and all that were searched on the map."""

    correct: int
    searched: int


def compare_with_map(
    image: PosedImage, map_product: MapProduct, position_sd_m: float, options: LvsOptions
) -> MapComparison:
    """Correct the pose of an image by landmarks, and match the image with the map.

    - position_sd_m: standard deviation of the position per axis; determines the search range of the landmarks
    """
    landmarks = select_landmarks(map_product, options)
    matches = match_landmarks(image, landmarks, map_product, np.full(3, position_sd_m), options)
    corrected = image.correct(matches.translation_m, matches.rotation_rad)
    nan = float("nan")
    residuals_px = np.hypot(*matches.residuals_px.T) / matches.working_pixel
    results = dict.fromkeys(MATCHERS, _Matched(correct=0, searched=0))
    results["lvs"] = _Matched(len(matches), matches.attempted)
    row: dict[str, Scalar] = {
        "lvs_found_fraction": matches.accepted / matches.attempted if matches.attempted else nan,
        "lvs_correlation": float(np.median(matches.scores)) if len(matches) else nan,
        "lvs_residual_px": float(np.median(residuals_px)) if len(matches) else nan,
    }
    footprint = _resample(corrected, map_product, options)
    correlations, strong = np.empty(0), np.empty(0)
    if footprint is not None:
        templates = _match_templates(footprint)
        alignment = _align(templates.pixels, templates.map_pixels)
        errors_px = _errors_px(templates.pixels, templates.map_pixels, alignment)
        results["template"] = _Matched(int(np.count_nonzero(errors_px <= TOLERANCE_PX)), len(errors_px))
        correlations = templates.correlations
        # from the largest contrast to the smallest
        order = np.argsort(-templates.interest, kind="stable")
        strong = correlations[order[: int(np.ceil(_STRONG_FRACTION * len(order)))]]
        for name, match in (("sift", _match_sift), ("orb", _match_orb)):
            features = match(footprint)
            errors_px = _errors_px(features.pixels, features.map_pixels, alignment)
            correct = int(np.count_nonzero(errors_px <= TOLERANCE_PX))
            results[name] = _Matched(correct, features.searched)
            row[f"{name}_inlier_fraction"] = correct / len(errors_px) if len(errors_px) else nan
    row["template_correlation"] = float(np.median(correlations)) if len(correlations) else nan
    row["template_strong_correlation"] = float(np.median(strong)) if len(strong) else nan
    yields = [result.correct / result.searched if result.searched else nan for result in results.values()]
    ranks = rankdata(-np.array(yields), method="min", nan_policy="omit")
    for (name, result), fraction, rank in zip(results.items(), yields, ranks, strict=True):
        row |= {f"{name}_searched": result.searched, f"{name}_inliers": result.correct}
        row |= {f"{name}_yield": fraction, f"{name}_rank": float(rank)}
    pixels = map_pixels(map_product, matches.points_m[:, :2])
    return MapComparison(corrected, matches, pixels, footprint, row)


def _resample(image: PosedImage, map_product: MapProduct, options: LvsOptions) -> ImageFootprint | None:
    """Resample an image to the pixels of the map, in squares; None if no square lies in both."""
    position = image.position_m
    height_m = float(position[2]) - elevation_at(map_product, position[:2])
    if height_m <= 0.0:
        return None
    radius_m = height_m * float(np.tan(options.max_off_nadir_rad))
    last = np.array(map_product.appearance.shape[::-1])
    low, high = (
        np.clip(np.rint(map_pixels(map_product, position[:2] + sign * radius_m)), 0, last).astype(np.int64)
        for sign in (-1, 1)
    )
    columns, rows = (high - low) // _TILE_PX
    if columns < 1 or rows < 1:
        return None
    tiles = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    corners = (low + _TILE_PX * tiles).astype(np.float64)
    view = view_ground(image, height_m, map_product.pixel_m)
    values, inside = rectify_patches(view, map_product, corners, _TILE_PX, np.zeros(2))
    centres = map_product.origin_m + map_product.pixel_m * (corners + 0.5 * (_TILE_PX - 1))
    inside &= np.linalg.norm(centres - position[:2], axis=1) <= radius_m
    if not inside.any():
        return None
    # squares outside of the image are filled, so that their borders have little contrast
    values[~inside] = np.median(values[inside])
    shape = (rows * _TILE_PX, columns * _TILE_PX)
    mosaic = values.reshape(rows, columns, _TILE_PX, _TILE_PX).swapaxes(1, 2).reshape(shape)
    valid = inside.reshape(rows, columns).repeat(_TILE_PX, axis=0).repeat(_TILE_PX, axis=1)
    first_column, first_row = low
    appearance = map_product.appearance[first_row:, first_column:][: shape[0], : shape[1]]
    return ImageFootprint(low, mosaic, appearance, valid)


@dataclass(frozen=True, eq=False)
class _Templates:
    """Templates of the image: centres, positions of their highest correlation on the map, correlations, and contrast.

    Pixels (column, row) are those of the footprint. The contrast is the Harris interest of the map divided by its mean.
    """

    pixels: Points2
    map_pixels: Points2
    correlations: Float[np.ndarray, "n"]
    interest: Float[np.ndarray, "n"]


def _match_templates(footprint: ImageFootprint) -> _Templates:
    """Search templates of the image on the map; without any template, the arrays are empty."""
    interest = harris_interest(*structure_tensor(footprint.appearance, _TEMPLATE_PX)) / footprint.appearance.mean()
    centres, found, correlations = [], [], []
    size = _TEMPLATE_PX + 2 * _SEARCH_PX
    for row, column in _template_corners(footprint.valid):
        template = footprint.image[row : row + _TEMPLATE_PX, column : column + _TEMPLATE_PX]
        window = footprint.appearance[row - _SEARCH_PX :, column - _SEARCH_PX :][:size, :size]
        peak = highest_peak(normalized_correlation(template, window))
        centres.append((column + _TEMPLATE_PX // 2, row + _TEMPLATE_PX // 2))
        found.append((peak.column - _SEARCH_PX, peak.row - _SEARCH_PX))
        correlations.append(peak.value)
    pixels = np.array(centres, dtype=np.int64).reshape(-1, 2)
    displacements = np.array(found, dtype=np.float64).reshape(-1, 2)
    contrast = interest[pixels[:, 1], pixels[:, 0]]
    return _Templates(pixels.astype(np.float64), pixels + displacements, np.array(correlations), contrast)


def _align(pixels: Points2, map_pixels: Points2) -> Float[np.ndarray, "3 3"]:
    """Fit a homography to the positions of templates by RANSAC; the identity if it has too few inliers."""
    if len(pixels) < _MIN_INLIERS:
        return np.eye(3)
    homography, inliers = cv2.findHomography(
        pixels, map_pixels, cv2.RANSAC, TOLERANCE_PX, maxIters=_RANSAC_ITERATIONS, confidence=_RANSAC_CONFIDENCE
    )
    return np.eye(3) if homography is None or inliers.sum() < _MIN_INLIERS else np.asarray(homography)


def _errors_px(pixels: Points2, map_pixels: Points2, alignment: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n"]:
    """Return the distances of matches from their positions by the alignment, map pixels."""
    if not len(pixels):
        return np.empty(0)
    expected = cv2.perspectiveTransform(pixels[np.newaxis], alignment)[0]
    return np.asarray(np.linalg.norm(map_pixels - expected, axis=1))


def _template_corners(valid: Bool[np.ndarray, "rows columns"]) -> Iterator[tuple[int, int]]:
    """Yield the corners (row, column) of the templates in the image whose search windows lie in the footprint."""
    rows, columns = (range(_SEARCH_PX, side - _TEMPLATE_PX - _SEARCH_PX + 1, _TEMPLATE_STEP_PX) for side in valid.shape)
    for row in rows:
        for column in columns:
            if valid[row : row + _TEMPLATE_PX, column : column + _TEMPLATE_PX].all():
                yield row, column


@dataclass(frozen=True, eq=False)
class _FeatureMatches:
    """Matched features: pixels (column, row) of the footprint in the image and on the map.

    - searched: number of the image's features
    """

    pixels: Points2
    map_pixels: Points2
    searched: int


def _match_sift(footprint: ImageFootprint) -> _FeatureMatches:
    """Match SIFT features of the image and of the map."""
    count = footprint.valid.size // _FEATURE_AREA_PX
    pixels, descriptors = extract_map_features(flatten(footprint.image), count, footprint.valid)
    map_points, map_descriptors = extract_map_features(flatten(footprint.appearance), count)
    indices, map_indices = match_descriptors(descriptors, map_descriptors)
    return _FeatureMatches(pixels[indices], map_points[map_indices], len(pixels))


def _match_orb(footprint: ImageFootprint) -> _FeatureMatches:
    """Match ORB features of the image and of the map."""
    options = orb.HomographyOptions(features=footprint.valid.size // _FEATURE_AREA_PX)
    pixels, descriptors = orb.detect_features(flatten(footprint.image), options)
    columns, rows = np.rint(pixels).astype(np.int64).T
    inside = footprint.valid[rows, columns]
    pixels, descriptors = pixels[inside], descriptors[inside]
    map_points, map_descriptors = orb.detect_features(flatten(footprint.appearance), options)
    indices, map_indices = orb.match_features(descriptors, map_descriptors, options).T
    return _FeatureMatches(pixels[indices], map_points[map_indices], len(pixels))
