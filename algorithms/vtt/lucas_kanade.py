"""Baseline target tracker: `VisualTargetTracker` with OpenCV's pyramidal Lucas-Kanade method as matcher.

Eq. 11 is that of Kim et al., "Targeted Driving Using Visual Tracking".
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from marsyard.algorithms.arrays import Vector2
from marsyard.algorithms.vtt.matching import Match, Sighting, extract_patch, search_window, window_fits
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.algorithms.vtt.prediction import ViewChange
from marsyard.algorithms.vtt.tracker import VisualTargetTracker
from marsyard.sim.measurements import MastImage

#: Pyramid levels below full resolution; with templates of 21 px the search range is about that of the correlation.
LEVELS = 3
#: Normalisation to the 8-bit images of OpenCV: standard deviation and mean, grey levels.
SIGMA_GREY, MEAN_GREY = 40.0, 128.0


def match_by_lucas_kanade(
    sighting: Sighting, image: MastImage, predicted_pixel: Vector2, change: ViewChange, options: VttOptions
) -> Match | None:
    """Match the target by its optical flow from the old image, magnified and rolled, to the new image; a `Matcher`.

    The score is the normalised correlation at the match; 0 if the flow does not converge or leaves the image.
    """
    window, corner = search_window(image, predicted_pixel, options.search_px)
    if min(window.shape) < options.template_px:
        return None
    side = options.search_px | 1  # odd
    old_patch = extract_patch(sighting.image, sighting.pixel, side, change)
    half, centre = (options.template_px - 1) // 2, (side - 1) // 2
    template = old_patch[centre - half : centre + half + 1, centre - half : centre + half + 1]
    # OpenCV requires images of equal size: pad a window that was clipped at the frame's border
    rows, columns = window.shape
    new_patch = np.pad(window.astype(np.float64), ((0, side - rows), (0, side - columns)), mode="edge")
    start_point = np.full((1, 1, 2), centre, dtype=np.float32)
    predicted_point = (predicted_pixel - corner).astype(np.float32).reshape(1, 1, 2)
    tracked_point, status, _ = cv2.calcOpticalFlowPyrLK(
        _normalize_to_8_bits(old_patch),
        _normalize_to_8_bits(new_patch),
        start_point,
        predicted_point.copy(),
        winSize=(options.template_px, options.template_px),
        maxLevel=LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    pixel = np.asarray(tracked_point, dtype=np.float64).reshape(2) + corner
    if not status[0, 0] or not window_fits(image, pixel, options.template_px):
        return Match(predicted_pixel, 0.0, template)
    return Match(pixel, correlation(template, extract_patch(image, pixel, options.template_px)), template)


def correlation(a: Float[np.ndarray, "n m"], b: Float[np.ndarray, "n m"]) -> float:
    """Normalised correlation of two patches, Eq. 11; 0 if either is flat."""
    a, b = a - a.mean(), b - b.mean()
    norms = float(np.sqrt(np.sum(a * a) * np.sum(b * b)))  # product of both norms
    return float(np.sum(a * b)) / norms if norms > 0.0 else 0.0


def _normalize_to_8_bits(image: Float[np.ndarray, "rows columns"]) -> UInt8[np.ndarray, "rows columns"]:
    """Normalise an image's mean and contrast, because exposures differ between stops."""
    contrast = max(float(image.std()), 1e-9)
    return np.asarray(np.clip(MEAN_GREY + SIGMA_GREY * (image - image.mean()) / contrast, 0, 255).astype(np.uint8))


def lucas_kanade_tracker(options: VttOptions | None = None) -> VisualTargetTracker:
    """Create a target tracker that matches by Lucas-Kanade; options of the correlation search have no effect."""
    return VisualTargetTracker(options, match_by_lucas_kanade)
