"""Statistics of terrain images, of pairs, and of images on maps, to compare rendered with real ones; uncalibrated."""

from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8
from scipy.ndimage import gaussian_filter, median_filter

from marsyard.scenarios.condition_columns import BLOCK_PX, SIDE_PX, local_contrast

#: Side of the resized images for features and pairs, pixels; side of the templates in images of `SIDE_PX`, pixels.
FEATURE_SIDE, TEMPLATE = 512, 31
#: Minimum numbers of matches, and of matches that agree with the homography of a pair.
_MIN_MATCHES, _MIN_INLIERS = 8, 12
#: Maximum distance of a match from its expected position on a map, and half width of the search for a template, pixels.
_MAP_TOLERANCE_PX, _MAP_SEARCH_PX = 3.0, 6
#: Number of features of ORB: about that of SIFT with its default contrast.
_ORB_FEATURES = 1000
#: Fraction of the templates that are the strongest ones, and minimum number of templates.
_STRONGEST, _MIN_TEMPLATES = 0.1, 20
#: Grey level of the mean, and distance of the overlap's border from the image's, pixels.
_GREY, _MARGIN_PX = 110.0, 8
#: Minimum distance between corners, pixels, and their minimum quality relative to the best corner, in crops of ground.
_CORNER_DISTANCE_PX, _CORNER_QUALITY = 5.0, 0.01
#: Frequency range of the fit to the power spectrum, cycles per image.
MIN_FREQUENCY, MAX_FREQUENCY = 4, 63


class ImageStatistics(NamedTuple):
    """Statistics of an image's central square, area-averaged to `SIDE_PX` x `SIDE_PX` pixels.

    - rms: standard deviation divided by the mean
    - slope: exponent of the radially averaged power spectrum from `MIN_FREQUENCY` to `MAX_FREQUENCY`, Hann window
    - local_p10, local_p50, local_p90: percentiles over all blocks of (standard deviation / mean of a block)
    - patchiness: local_p90 / local_p10
    - corner: mean at distances above 0.9 half diagonals from the centre, divided by the mean below 0.25
    - kurtosis_4, kurtosis_8, skewness_8: excess kurtosis and skewness of the difference of Gaussians at 2 to 4, and at
      4 to 8 pixels: large where few strong features stand out of quiet ground
    - best_template: largest Harris value on a grid of 8 pixels: root mean square of the smaller gradient over a
      template, divided by the mean
    - sift: SIFT features in `FEATURE_SIDE` x `FEATURE_SIDE` pixels
    """

    rms: float
    slope: float
    local_p10: float
    local_p50: float
    local_p90: float
    patchiness: float
    corner: float
    kurtosis_4: float
    kurtosis_8: float
    skewness_8: float
    best_template: float
    sift: float


class PairStatistics(NamedTuple):
    """Statistics of two overlapping images that a homography relates, in `FEATURE_SIDE` x `FEATURE_SIDE` pixels.

    - inlier_ratio, matched: SIFT matches that agree with the homography, divided by all matches, and by all features of
      the first image in the overlap
    - repeatability: fraction of the 500 best Harris corners of the first image in the overlap that are within 2 pixels
      of one of the 700 best of the second
    - tracking_error_px: median displacement of corners that the Lucas-Kanade method tracks in the second image, warped
      to the first
    - decorrelation: 1 minus the median correlation of the templates after warping, in `SIDE_PX` x `SIDE_PX` pixels
    """

    inlier_ratio: float
    matched: float
    repeatability: float
    tracking_error_px: float
    decorrelation: float


class MapStatistics(NamedTuple):
    """Statistics of an image against a map with pixels of about the same size; a homography relates them.

    - sift, orb: features of the image in the overlap whose best match on the map is at the expected position, divided
      by all features of the image in the overlap
    - correlation: median over all templates of the largest correlation with the map near the expected position
    - strongest: the same over the tenth of the templates with the largest Harris values on the map
    - valid: fraction of the templates whose largest correlation is at the expected position
    """

    sift: float
    orb: float
    correlation: float
    strongest: float
    valid: float


class GroundStatistics(NamedTuple):
    """Statistics of a crop of ground in an image from a mast or a low-flying helicopter, at full resolution.

    - local_p10, local_p50, local_p90: percentiles over blocks of `BLOCK_PX` pixels of (standard deviation / mean)
    - kurtosis: excess kurtosis of the finest band, the image minus its blur by 1 pixel, divided by the image's blur by
      32 pixels: large where a few strong features stand out of quiet ground
    - corners: thousands of corners (Shi and Tomasi) per megapixel
    - darkest: first percentile of the image divided by its median over 64 pixels
    """

    local_p10: float
    local_p50: float
    local_p90: float
    kurtosis: float
    corners: float
    darkest: float


def compute_ground_statistics(crop: Float[np.ndarray, "rows columns"]) -> GroundStatistics:
    """Compute the statistics of a crop of ground; its sides are multiples of `BLOCK_PX`."""
    rows, columns = crop.shape
    blocks = np.asarray(crop, dtype=np.float64).reshape(rows // BLOCK_PX, BLOCK_PX, columns // BLOCK_PX, BLOCK_PX)
    contrast = np.percentile(blocks.std(axis=(1, 3)) / blocks.mean(axis=(1, 3)), [10.0, 50.0, 90.0])
    flat = _flatten(np.asarray(crop, dtype=np.float64), 32.0)
    finest = _standardise((flat - gaussian_filter(flat, 1.0, mode="reflect"))[16:-16, 16:-16])
    corners = cv2.goodFeaturesToTrack(_to_bytes(flat), 0, _CORNER_QUALITY, _CORNER_DISTANCE_PX)
    small = cv2.resize(np.asarray(crop, dtype=np.float32), (columns // 4, rows // 4), interpolation=cv2.INTER_AREA)
    median = cv2.resize(median_filter(small, 17, mode="reflect"), (columns, rows), interpolation=cv2.INTER_LINEAR)
    p10, p50, p90 = (float(value) for value in contrast)
    return GroundStatistics(
        p10,
        p50,
        p90,
        float((finest**4).mean()) - 3.0,
        1e3 * len(corners) / crop.size,
        float(np.percentile(crop / median, 1.0)),
    )


def compute_image_statistics(image: Float[np.ndarray, "rows columns"]) -> ImageStatistics:
    """Compute the statistics of an image in any unit proportional to radiance."""
    small = _reduce(image, SIDE_PX)
    p10, p50, p90 = local_contrast(small)
    offset = np.arange(SIDE_PX) - 0.5 * (SIDE_PX - 1)
    radius = np.hypot(offset[:, None], offset) / np.hypot(offset[0], offset[0])
    corner = float(small[radius > 0.9].mean() / small[radius < 0.25].mean())
    rms = float(small.std() / small.mean())
    flat = _flatten(small, 32.0)
    smooth = [gaussian_filter(flat, sigma, mode="reflect") for sigma in (2.0, 4.0, 8.0)]
    # a margin of twice the widest filter
    band_4, band_8 = (_standardise((fine - coarse)[16:-16, 16:-16]) for fine, coarse in pairwise(smooth))
    tails = (float((band_4**4).mean()) - 3.0, float((band_8**4).mean()) - 3.0, float((band_8**3).mean()))
    features = cv2.SIFT.create().detect(_to_bytes(_flatten(_reduce(image, FEATURE_SIDE), 64.0)))
    template = float(_template_strength(small)[40:-40:8, 40:-40:8].max())
    return ImageStatistics(
        rms, spectral_slope(small), p10, p50, p90, p90 / p10, corner, *tails, template, float(len(features))
    )


def compute_pair_statistics(
    first: Float[np.ndarray, "rows columns"], second: Float[np.ndarray, "rows columns"]
) -> PairStatistics | None:
    """Compute the statistics of two overlapping images; None where no homography is found.

    The contrast between 1 and 8 pixels is scaled to 8 grey levels in both images.
    """
    image, other = images = tuple(_equalise(_reduce(item, FEATURE_SIDE)) for item in (first, second))
    matched = _match(cv2.SIFT.create(6000, contrastThreshold=0.008), cv2.NORM_L2, *images)
    fit = _fit_homography(matched, 2.5)
    if fit is None:
        return None
    homography, inliers = fit
    in_overlap = _is_inside(_warp(matched.features, homography), other).sum()
    corners, other_corners = (
        cv2.goodFeaturesToTrack(item, count, 0.01, 7)[:, 0] for item, count in zip(images, (500, 700), strict=True)
    )
    expected = _warp(corners, homography)
    visible = _is_inside(expected, other)
    corners, expected = corners[visible], expected[visible]
    nearest = np.linalg.norm(expected[:, None] - other_corners[None], axis=2).min(axis=1)
    warped = cv2.warpPerspective(other, np.linalg.inv(homography), (FEATURE_SIDE, FEATURE_SIDE))
    tracked, found, _ = cv2.calcOpticalFlowPyrLK(image, warped, corners[:, None], None)
    errors = np.linalg.norm(tracked[:, 0] - corners, axis=1)[found[:, 0] == 1]
    return PairStatistics(
        float(inliers.mean()),
        float(inliers.sum() / max(in_overlap, 1)),
        float((nearest < 2.0).mean()),
        float(np.median(errors)) if errors.size else float("nan"),
        _decorrelation(image, other, homography),
    )


def compute_map_statistics(
    image: Float[np.ndarray, "rows columns"], mapped: Float[np.ndarray, "map_rows map_columns"]
) -> MapStatistics | None:
    """Compute the statistics of an image on a map with pixels of about the same size.

    The contrast of both is equalised as for pairs. None where no homography or too few templates are found.
    """
    picture, chart = (_equalise(np.asarray(item, dtype=np.float64)) for item in (image, mapped))
    many = _match(cv2.SIFT.create(contrastThreshold=0.008), cv2.NORM_L2, picture, chart)
    fit = _fit_homography(many, _MAP_TOLERANCE_PX)
    if fit is None:
        return None
    homography = fit[0]
    yields = []
    for detector, norm in ((cv2.SIFT.create(), cv2.NORM_L2), (cv2.ORB.create(_ORB_FEATURES), cv2.NORM_HAMMING)):
        matched = _match(detector, norm, picture, chart)
        errors = np.linalg.norm(_warp(matched.points, homography) - matched.other_points, axis=1)
        in_overlap = _is_inside(_warp(matched.features, homography), chart).sum()
        yields.append(float((errors < _MAP_TOLERANCE_PX).sum() / max(in_overlap, 1)))
    largest, distance, strength = _search_templates(picture, chart, homography)
    if largest.size < _MIN_TEMPLATES:
        return None
    strongest = strength >= np.quantile(strength, 1.0 - _STRONGEST)
    valid = float((distance < _MAP_TOLERANCE_PX).mean())
    correlations = float(np.median(largest)), float(np.median(largest[strongest]))
    return MapStatistics(yields[0], yields[1], *correlations, valid)


def _search_templates(
    picture: UInt8[np.ndarray, "side side"],
    chart: UInt8[np.ndarray, "rows columns"],
    homography: Float[np.ndarray, "3 3"],
) -> tuple[Float64[np.ndarray, "n"], Float64[np.ndarray, "n"], Float64[np.ndarray, "n"]]:
    """Correlate templates of an image, warped to the map, with the map near their expected positions.

    Returns the largest correlation of each template, its distance from the expected position, pixels of the map, and
    the template's Harris value on the map.
    """
    # twice the map's resolution, then averaged
    double = np.array([[2.0, 0.0, 0.5], [0.0, 2.0, 0.5], [0.0, 0.0, 1.0]]) @ homography
    rows, columns = chart.shape
    size = (2 * columns, 2 * rows)
    warped, covered = (
        cv2.resize(cv2.warpPerspective(item, double, size), (columns, rows), interpolation=cv2.INTER_AREA)
        for item in (picture, np.full_like(picture, 255))
    )
    strength, half, search = _template_strength(chart.astype(np.float64)), TEMPLATE // 2, _MAP_SEARCH_PX
    found = []
    for row in range(half + search, rows - half - search, 8):
        for column in range(half + search, columns - half - search, 8):
            window = np.s_[row - half : row + half + 1, column - half : column + half + 1]
            if covered[window].min() < 255:
                continue
            first, last = -half - search, half + search + 1
            area = chart[row + first : row + last, column + first : column + last]
            correlation = cv2.matchTemplate(area, warped[window], cv2.TM_CCOEFF_NORMED)
            peak = np.unravel_index(np.argmax(correlation), correlation.shape)
            distance = np.hypot(*(np.array(peak) - search))
            found.append((correlation[peak], distance, strength[row, column]))
    columns_of = np.array(found, dtype=np.float64).reshape(-1, 3).T
    return columns_of[0], columns_of[1], columns_of[2]


def spectral_slope(image: Float[np.ndarray, "side side"]) -> float:
    """Fit the exponent of the radially averaged power spectrum of a square image."""
    side = len(image)
    window = np.hanning(side)
    relative = image / image.mean() - 1.0
    power = np.abs(np.fft.fft2(relative * window[:, None] * window)) ** 2
    frequency = np.fft.fftfreq(side, 1.0 / side)
    ring_number = np.hypot(frequency[:, None], frequency).astype(int).ravel()
    radial_mean = np.bincount(ring_number, power.ravel()) / np.bincount(ring_number)
    fit_range = np.arange(MIN_FREQUENCY, MAX_FREQUENCY + 1)
    return float(np.polyfit(np.log(fit_range), np.log(radial_mean[fit_range]), 1)[0])


def _reduce(image: Float[np.ndarray, "rows columns"], side: int) -> Float[np.ndarray, "side side"]:
    """Area-average the central square to `side` pixels."""
    rows, columns = image.shape
    size = min(rows, columns)
    top, left = (rows - size) // 2, (columns - size) // 2
    square = np.asarray(image[top : top + size, left : left + size], dtype=np.float64)
    return np.asarray(cv2.resize(square, (side, side), interpolation=cv2.INTER_AREA))


def _flatten(image: Float[np.ndarray, "rows columns"], sigma_px: float) -> Float[np.ndarray, "rows columns"]:
    """Compute the relative deviation from the blurred image."""
    return np.asarray(image / cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT) - 1.0)


def _standardise(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    return np.asarray((values - values.mean()) / values.std())


def _to_bytes(relative: Float[np.ndarray, "rows columns"]) -> UInt8[np.ndarray, "rows columns"]:
    return np.clip(_GREY * (1.0 + relative), 0.0, 255.0).astype(np.uint8)


def _equalise(image: Float[np.ndarray, "side side"]) -> UInt8[np.ndarray, "side side"]:
    """Scale the contrast between 1 and 8 pixels to 8 grey levels."""
    flat = _flatten(image, 40.0)
    contrast = np.std(gaussian_filter(flat, 1.0) - gaussian_filter(flat, 8.0))
    return _to_bytes(8.0 / _GREY / contrast * flat)


def _template_strength(image: Float[np.ndarray, "side side"]) -> Float[np.ndarray, "rows columns"]:
    """Compute the Harris value of the template around each pixel: the smaller RMS gradient divided by the mean."""
    along_x, along_y = np.gradient(image, axis=1), np.gradient(image, axis=0)
    size = (TEMPLATE, TEMPLATE)
    xx, yy, xy = (cv2.blur(product, size) for product in (along_x**2, along_y**2, along_x * along_y))
    smaller = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy)
    return np.asarray(np.sqrt(np.maximum(smaller, 0.0)) / cv2.blur(image, size))


def _warp(points: Float[np.ndarray, "n 2"], homography: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n 2"]:
    return np.asarray(cv2.perspectiveTransform(points[None], homography)[0])


def _is_inside(points: Float[np.ndarray, "n 2"], image: UInt8[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "n"]:
    limits = np.array(image.shape[::-1]) - _MARGIN_PX
    return np.asarray(np.all((points > _MARGIN_PX) & (points < limits), axis=1))


class _Matches(NamedTuple):
    """All features of an image, and its matches in another one: pixels (column, row)."""

    features: Float32[np.ndarray, "features 2"]
    points: Float32[np.ndarray, "matches 2"]
    other_points: Float32[np.ndarray, "matches 2"]


def _match(
    detector: cv2.Feature2D, norm: int, image: UInt8[np.ndarray, "_ _"], other: UInt8[np.ndarray, "_ _"]
) -> _Matches:
    """Match the features of two images, with a ratio test of 0.8."""
    (keys, descriptors), (other_keys, other_descriptors) = (
        detector.detectAndCompute(item, None) for item in (image, other)
    )
    matches = []
    if descriptors is not None and other_descriptors is not None:
        neighbours = cv2.BFMatcher(norm).knnMatch(descriptors, other_descriptors, k=2)
        matches = [best[0] for best in neighbours if len(best) == 2 and best[0].distance < 0.8 * best[1].distance]
    points = (
        [key.pt for key in keys],
        [keys[match.queryIdx].pt for match in matches],
        [other_keys[match.trainIdx].pt for match in matches],
    )
    return _Matches(*(np.array(items, dtype=np.float32).reshape(-1, 2) for items in points))


def _fit_homography(
    matched: _Matches, tolerance_px: float
) -> tuple[Float64[np.ndarray, "3 3"], UInt8[np.ndarray, "matches 1"]] | None:
    """Fit the homography from an image to the other by RANSAC, and mark the matches that agree; None if too few do."""
    if len(matched.points) < _MIN_MATCHES:
        return None
    homography, inliers = cv2.findHomography(
        matched.points, matched.other_points, cv2.RANSAC, tolerance_px, maxIters=20000, confidence=0.9999
    )
    return None if homography is None or inliers.sum() < _MIN_INLIERS else (homography, inliers)


def _decorrelation(
    first: UInt8[np.ndarray, "side side"], second: UInt8[np.ndarray, "side side"], homography: Float[np.ndarray, "3 3"]
) -> float:
    """Compute 1 minus the median correlation of templates of the first image and of the second, warped to the first."""
    inverse, full = np.linalg.inv(homography), np.full_like(second, 255)
    warped = [cv2.warpPerspective(image, inverse, (FEATURE_SIDE, FEATURE_SIDE)) for image in (second, full)]
    a, b, valid = (
        cv2.resize(image, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA).astype(np.float64)
        for image in (first, *warped)
    )
    half = TEMPLATE // 2
    correlations = []
    for row in range(half + 1, SIDE_PX - half - 1, 8):
        for column in range(half + 1, SIDE_PX - half - 1, 8):
            window = np.s_[row - half : row + half + 1, column - half : column + half + 1]
            if valid[window].min() > 254.0:
                correlations.append(np.corrcoef(a[window].ravel(), b[window].ravel())[0, 1])
    return 1.0 - float(np.median(correlations)) if correlations else float("nan")
