"""Baseline matcher from OpenCV: pyramidal Lucas-Kanade in the loop of the paper's tracker."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from marsyard.algorithms.vtt.matching import Change, Match, Sighting, cut_patch, has_room, search_window
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.algorithms.vtt.tracker import VisualTargetTracker
from marsyard.sim.measurements import MastImage

#: Pyramid levels above the full resolution: with windows of 21 px the range is about that of the search window.
LEVELS = 3
#: OpenCV's pictures have 8 bits: this many counts for one standard deviation, about a middle grey.
COUNTS_PER_SIGMA, MIDDLE = 40.0, 128.0


def match_by_lucas_kanade(
    sighting: Sighting, image: MastImage, predicted: Float[np.ndarray, "2"], change: Change, options: VttOptions
) -> Match | None:
    """A `Matcher`: optical flow of the target from the old image, magnified and rolled, to the new one.

    The score is the normalised correlation at the match, 0 if the flow does not converge in the window.
    """
    window, corner = search_window(image, predicted, options.search_px)
    if min(window.shape) < options.template_px:
        return None
    side = options.search_px | 1
    before = cut_patch(sighting.image, sighting.pixel, side, change)
    half, reach = (options.template_px - 1) // 2, (side - 1) // 2
    template = before[reach - half : reach + half + 1, reach - half : reach + half + 1]
    # both pictures of one size, as OpenCV asks: the window is cut where the frame ends
    rows, columns = window.shape
    after = np.pad(window.astype(np.float64), ((0, side - rows), (0, side - columns)), mode="edge")
    start = np.full((1, 1, 2), reach, dtype=np.float32)
    guess = (predicted - corner).astype(np.float32).reshape(1, 1, 2)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        _normalize_to_8_bits(before),
        _normalize_to_8_bits(after),
        start,
        guess.copy(),
        winSize=(options.template_px, options.template_px),
        maxLevel=LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    place = np.asarray(moved, dtype=np.float64).reshape(2) + corner
    if not status[0, 0] or not has_room(image, place, options.template_px):
        return Match(predicted, 0.0, template)
    return Match(place, correlation(template, cut_patch(image, place, options.template_px)), template)


def correlation(a: Float[np.ndarray, "n m"], b: Float[np.ndarray, "n m"]) -> float:
    """Normalised correlation of two patches, Eq. 11; 0 where either is flat."""
    x, y = a - a.mean(), b - b.mean()
    energy = float(np.sqrt(np.sum(x * x) * np.sum(y * y)))
    return float(np.sum(x * y)) / energy if energy > 0.0 else 0.0


def _normalize_to_8_bits(image: Float[np.ndarray, "rows columns"]) -> UInt8[np.ndarray, "rows columns"]:
    """The image with normalised mean and contrast: exposures differ from stop to stop."""
    spread = max(float(image.std()), 1e-9)
    return np.asarray(np.clip(MIDDLE + COUNTS_PER_SIGMA * (image - image.mean()) / spread, 0, 255).astype(np.uint8))


def lucas_kanade_tracker(options: VttOptions | None = None) -> VisualTargetTracker:
    """The target tracker with this matcher; options of the correlation search have no effect."""
    return VisualTargetTracker(options, match_by_lucas_kanade)
