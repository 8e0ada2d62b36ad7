"""How well pictures and measured poses agree: features matched between pictures, held against where poses put them.

Features are SIFT's (Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", IJCV 60, 2004), matched by the
ratio of the nearest to the second nearest and by asking back. Those that no rigid motion between the two cameras
explains (essential matrix by RANSAC over the rays, which knows nothing of the poses) are wrong matches and left out.
What is left is held against the poses: by them a feature of the earlier picture lies on a curve of the later one, from
the direction of the earlier camera to the feature's own direction at infinity; the offset is what parts the match from
the nearest place of that curve. Of two pictures taken from one place the curve is a point.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8
from scipy.spatial.transform import RigidTransform

from marsyard.scenarios.interface import Scalar
from marsyard.sim.camera import CameraModel
from marsyard.sim.measurements import DetectorImage

#: Features of a picture, the strongest; the ratio of Lowe's Fig. 11.
_MOST_FEATURES, _RATIO = 4000, 0.8
#: Matches off an essential matrix by more than this are wrong, pixels; its probability of a clean sample.
_MOST_OFF_PX, _CLEAN = 2.0, 0.9999
#: Fewer matches than this say nothing of poses: an essential matrix passes through five.
LEAST_MATCHES = 15
#: Distance that stands for infinity, m.
_FAR_M = 1e7
#: Quantiles of the counts that are drawn as black and white.
_STRETCH = (0.005, 0.995)


@dataclass(frozen=True, eq=False)
class PairMatches:
    """Features matched between two pictures.

    Attributes
    ----------
    pixels
        In the earlier and in the later picture, (u, v) as delivered, shape (2, n, 2).
    right
        Which of them some rigid motion explains, shape (n,).
    """

    pixels: Float64[np.ndarray, "2 n 2"]
    right: Bool[np.ndarray, "n"]


@dataclass(frozen=True, eq=False)
class PairAgreement:
    """How the matches of two pictures agree with poses.

    Attributes
    ----------
    matches
        The matches.
    offsets
        From where the poses put a match to where it is in the later picture, pixels, shape (n, 2); NaN where the later
        camera cannot see that place.
    """

    matches: PairMatches
    offsets: Float64[np.ndarray, "n 2"]

    @cached_property
    def residuals_px(self) -> Float64[np.ndarray, "k"]:
        """Lengths of the offsets of the right matches; none where they are too few to tell."""
        if np.count_nonzero(self.matches.right) < LEAST_MATCHES:
            return np.empty(0)
        lengths = np.hypot(*self.offsets[self.matches.right].T)
        return np.asarray(np.where(np.isfinite(lengths), lengths, np.inf))

    @property
    def median_px(self) -> float:
        """Median of the residuals; NaN where there are none."""
        return float(np.median(self.residuals_px)) if self.residuals_px.size else float("nan")


def matched(images: Sequence[DetectorImage]) -> list[PairMatches]:
    """Features of each picture, found again in the next."""
    features = [_features(image) for image in images]
    return [
        _pair(images[place], images[place + 1], *_nearest(features[place], features[place + 1]))
        for place in range(len(images) - 1)
    ]


def agreements(
    images: Sequence[DetectorImage], pairs: Sequence[PairMatches], poses: Sequence[RigidTransform]
) -> list[PairAgreement]:
    """The matches of a case's pictures, held against the body's pose at each."""
    cameras = [image.camera.moved(pose) for image, pose in zip(images, poses, strict=True)]
    return [
        PairAgreement(one, offsets_px(before, after, one.pixels[0], one.pixels[1]))
        for one, (before, after) in zip(pairs, itertools.pairwise(cameras), strict=True)
    ]


def agreement_row(pairs: Sequence[PairAgreement]) -> dict[str, Scalar]:
    """What is stored of a case's pairs: matches, residuals of all, and the worst pair's median."""
    residuals = np.concatenate([pair.residuals_px for pair in pairs])
    told = residuals.size > 0
    return {
        "matches": sum(int(pair.matches.right.sum()) for pair in pairs),
        "matches_wrong_share": 1.0 - float(np.concatenate([pair.matches.right for pair in pairs]).mean())
        if any(pair.matches.right.size for pair in pairs)
        else float("nan"),
        "pairs_matched": sum(pair.residuals_px.size > 0 for pair in pairs),
        "residual_median_px": float(np.median(residuals)) if told else float("nan"),
        "residual_90_percent_px": float(np.quantile(residuals, 0.9, method="higher")) if told else float("nan"),
        "residual_worst_pair_px": max(
            (pair.median_px for pair in pairs if pair.residuals_px.size), default=float("nan")
        ),
    }


def agreement_products(images: Sequence[DetectorImage], pairs: Sequence[PairAgreement]) -> dict[str, object]:
    """Arrays for figures: `image_<k>`, and of each pair of pictures k and k + 1 `matches_<k>` (u, v of the earlier,
    u, v of the later picture, offset in u and v, 1 where right).
    """
    products: dict[str, object] = {f"image_{number}": image.counts for number, image in enumerate(images, start=1)}
    for number, pair in enumerate(pairs, start=1):
        columns = [*pair.matches.pixels, pair.offsets, pair.matches.right[:, None].astype(np.float64)]
        products[f"matches_{number}"] = np.concatenate(columns, axis=1)
    return products


@dataclass(frozen=True, eq=False)
class _Features:
    """Features of a picture: (u, v) as delivered, shape (n, 2), and descriptors."""

    pixels: Float64[np.ndarray, "n 2"]
    descriptors: np.ndarray


def _features(image: DetectorImage) -> _Features:
    """SIFT on the picture with its flat field divided out, and pixels binned to be about square."""
    fu, fv = image.camera.focal_lengths
    rows, columns = image.counts.shape
    across, down = _binning(fu / fv, columns), _binning(fv / fu, rows)
    known = image.calibration
    signal = (image.counts - known.offset_dn) / known.flat_field
    square = signal.reshape(rows // down, down, columns // across, across).mean(axis=(1, 3))
    points, descriptors = cv2.SIFT.create(nfeatures=_MOST_FEATURES).detectAndCompute(_eight_bits(square), None)
    if descriptors is None:
        return _Features(np.empty((0, 2)), np.empty((0, 128), dtype=np.float32))
    binned = np.array([point.pt for point in points], dtype=np.float64)
    return _Features((binned + 0.5) * np.array([across, down]) - 0.5, descriptors)


def _binning(ratio: float, extent: int) -> int:
    """Pixels to average along a side that is sampled so many times as finely as the other."""
    factor = max(round(ratio), 1)
    return factor if extent % factor == 0 else 1


def _eight_bits(signal: Float64[np.ndarray, "rows columns"]) -> UInt8[np.ndarray, "rows columns"]:
    low, high = np.quantile(signal, _STRETCH)
    return np.asarray(np.clip((signal - low) / max(high - low, 1e-9) * 255.0, 0.0, 255.0).astype(np.uint8))


def _nearest(first: _Features, second: _Features) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2"]]:
    """Pixels of features that are each other's nearest, and nearer than the second nearest by the ratio."""
    none = np.empty((0, 2))
    if len(first.pixels) < 2 or len(second.pixels) < 2:
        return none, none
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {one.queryIdx: one.trainIdx for (one,) in matcher.knnMatch(second.descriptors, first.descriptors, k=1)}
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, next_best in matcher.knnMatch(first.descriptors, second.descriptors, k=2)
        if best.distance < _RATIO * next_best.distance and back.get(best.trainIdx) == best.queryIdx
    ]
    # one feature of several orientations is one match
    kept = list({tuple(first.pixels[a].tolist()): (a, b) for a, b in pairs}.values())
    if not kept:
        return none, none
    ours, theirs = (list(places) for places in zip(*kept, strict=True))
    return np.asarray(first.pixels[ours]), np.asarray(second.pixels[theirs])


def _pair(
    first: DetectorImage, second: DetectorImage, ours: Float64[np.ndarray, "n 2"], theirs: Float64[np.ndarray, "n 2"]
) -> PairMatches:
    return PairMatches(np.stack([ours, theirs]), _explained(first.camera, second.camera, ours, theirs))


def _explained(
    first: CameraModel, second: CameraModel, ours: Float64[np.ndarray, "n 2"], theirs: Float64[np.ndarray, "n 2"]
) -> Bool[np.ndarray, "n"]:
    """Which matches one rigid motion between the two cameras explains; knows the lenses, and nothing of poses."""
    none = np.zeros(len(ours), dtype=np.bool_)
    if len(ours) < LEAST_MATCHES:
        return none
    planes = [_on_plane(first, ours), _on_plane(second, theirs)]
    focal = 0.5 * sum(float(np.sqrt(np.prod(camera.focal_lengths))) for camera in (first, second))
    _, mask = cv2.findEssentialMat(
        planes[0], planes[1], np.eye(3), method=cv2.RANSAC, prob=_CLEAN, threshold=_MOST_OFF_PX / focal
    )
    return none if mask is None else np.asarray(mask).ravel() > 0


def _on_plane(camera: CameraModel, pixels: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
    """Where the rays of pixels meet the plane at unit distance before the camera."""
    directions = camera.rays(pixels)[1]
    axes = np.stack([camera.right, camera.down, camera.a])
    x, y, z = (directions @ axes.T).T
    return np.asarray(np.stack([x, y], axis=1) / np.maximum(z, 1e-3)[:, None])


def offsets_px(
    first: CameraModel, second: CameraModel, ours: Float64[np.ndarray, "n 2"], theirs: Float64[np.ndarray, "n 2"]
) -> Float64[np.ndarray, "n 2"]:
    """From the nearest place where a feature of the first picture can lie in the second, to where it was found.

    Parameters
    ----------
    first, second
        Cameras in one frame.
    ours, theirs
        Pixels of the matches in the two pictures.

    Returns
    -------
    Offsets in the second picture, pixels; NaN where the second camera cannot see the place.
    """
    origins, directions = first.rays(ours)
    eyes, sights = second.rays(theirs)
    distances = _nearest_m(origins - eyes, directions, sights)
    pixels, _ = second.project(origins + distances[:, None] * directions)
    return np.asarray(theirs - pixels)


def _nearest_m(
    between: Float64[np.ndarray, "n 3"], directions: Float64[np.ndarray, "n 3"], sights: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n"]:
    """How far along the first camera's rays they come nearest, in angle, to the second camera's sights.

    Seen from the second camera a ray sweeps the arc from the first camera, `between`, to its own direction. The place
    sought is where the sight, brought into the arc's plane, meets it: p with ``p x (between + s direction) = 0``.
    """
    normals = np.cross(between, directions)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0)
    inside = sights - np.sum(sights * normals, axis=1, keepdims=True) * normals
    from_first, along = np.cross(inside, between), np.cross(inside, directions)
    scale = np.sum(along * along, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = -np.sum(from_first * along, axis=1) / scale
    ahead = np.sum((between + distances[:, None] * directions) * inside, axis=1) > 0.0
    reached = np.isfinite(distances) & (distances > 0.0) & ahead & (lengths[:, 0] > 0.0)
    # beyond the arc's ends the end at infinity is the nearer one: nobody stands before the first camera's lens
    return np.asarray(np.where(reached, np.minimum(distances, _FAR_M), _FAR_M))
