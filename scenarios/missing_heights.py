"""Find heights of a DTM that stand for missing data, although the file does not declare them.

Such a value is repeated exactly and has cliffs at its border, as natural ground does not: flat ground (a plain, a lake,
terraces of quantised heights) continues at its border in small steps.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

Grid = Float64[np.ndarray, "rows columns"]
Mask = Bool[np.ndarray, "rows columns"]
Values = Float64[np.ndarray, "n"]

#: Usual values for missing data; a single post with one of these is sufficient.
CONVENTIONAL = (0.0, -1.0, -999.0, 999.0, -9999.0, 9999.0, -10000.0, 10000.0)
#: Minimum step at the border of a missing value, m, and relative to the 95th percentile of the other steps.
_MIN_CLIFF_M, _CLIFF_FACTOR = 100.0, 10.0
#: Fraction of the steps at the border that must be cliffs: holes touch each other and noise.
_CLIFF_FRACTION = 0.95
#: Low cliffs: minimum number of posts, and maximum fraction of equal neighbours in the other ground.
_MIN_POSTS, _MAX_EQUAL_FRACTION = 10, 0.01
#: Low cliffs on one side of the value: minimum slope (rise over run).
_CLIFF_SLOPE = 2.0
#: Low cliffs on both sides of the value: minimum slope of the median step, minimum fraction of steps up and of steps
#: down, and minimum median step divided by that of the ground.
_TWO_SIDED_SLOPE, _MIN_SIDE_FRACTION, _MEDIAN_FACTOR = 0.5, 0.1, 5.0
#: Number of values on the border of the file that are examined, the most frequent: a collar fills much of it.
_MAX_BORDER_VALUES = 3
#: Maximum number of steps for the percentiles of the ground.
_MAX_STEPS = 1 << 22


@dataclass(frozen=True)
class MissingValue:
    """A height that stands for missing data, and its number of posts."""

    height_m: float
    posts: int


def find_missing_value(heights: Grid, posting_m: float) -> MissingValue | None:
    """Return a height that stands for missing data, or None. Missing heights that are declared are not finite.

    Steps are the height differences of posts that are neighbours along x or y. Ground steps are those between posts
    without such a value. A height is missing data if it meets one of two rules:

    - cliffs: it occurs at two posts or more, or is a conventional value (`CONVENTIONAL`), and at least 95 % of the
      steps at the border of its posts exceed 100 m and 10 times the 95th percentile of the ground steps
    - low cliffs: it is 0 or frequent on the border of the file; it occurs at 10 posts or more; the ground is not
      quantised (less than 1 % of its neighbours are equal); and either at least 95 % of the steps at its border exceed
      twice the posting and 10 times that percentile, or the steps go both up and down (10 % each), and their median
      exceeds half the posting and 5 times the median of the ground steps

    A plain or a lake meets neither rule, because some of its border has small steps, and a lake is not above its shore.
    """
    candidates = [MissingValue(height, count) for height, count in _cliff_values(heights)]
    edges = np.concatenate([heights[0], heights[-1], heights[1:-1, 0], heights[1:-1, -1]])
    border_values, counts = np.unique(edges[np.isfinite(edges)], return_counts=True)
    frequent = border_values[np.argsort(-counts)][:_MAX_BORDER_VALUES]
    for height in dict.fromkeys([0.0, *frequent.tolist()]):
        is_value = heights == height
        if np.count_nonzero(is_value) >= _MIN_POSTS and _has_low_cliffs(heights, is_value, posting_m):
            candidates.append(MissingValue(float(height), int(np.count_nonzero(is_value))))
    # the rarest: level ground next to missing posts also has cliffs
    return min(candidates, key=lambda item: (item.height_m not in CONVENTIONAL, item.posts), default=None)


def _pairs(heights: Grid) -> Iterator[tuple[Grid, Grid]]:
    """Yield the heights of neighbours along x and along y."""
    yield heights[:, :-1], heights[:, 1:]
    yield heights[:-1], heights[1:]


def _cliff_values(heights: Grid) -> Iterator[tuple[float, int]]:
    """Yield heights that meet the rule of cliffs, with their number of posts."""
    with np.errstate(invalid="ignore"):  # infinite heights are missing
        ends = [pair[np.abs(b - a) > _MIN_CLIFF_M] for a, b in _pairs(heights) for pair in (a, b)]
    at_cliffs = np.unique(np.concatenate(ends))
    at_cliffs = at_cliffs[np.isfinite(at_cliffs)]
    if at_cliffs.size == 0:
        return
    posts = _count(heights.ravel(), at_cliffs)
    is_candidate = (posts >= 2) | np.isin(at_cliffs, CONVENTIONAL)
    values, posts = at_cliffs[is_candidate], posts[is_candidate]
    is_missing = _has_cliffs(heights, values, _MIN_CLIFF_M)
    values, posts = values[is_missing], posts[is_missing]
    _, ground = _steps(heights, np.isin(heights, values))
    threshold_m = max(_MIN_CLIFF_M, _CLIFF_FACTOR * _percentile(ground, 95.0))
    is_missing = _has_cliffs(heights, values, threshold_m)
    yield from zip(values[is_missing].tolist(), posts[is_missing].tolist(), strict=True)


def _count(heights: Values, values: Values) -> np.ndarray:
    """Return how often each of the sorted values occurs."""
    index = np.searchsorted(values, heights)
    index[index == len(values)] = 0
    return np.bincount(index[values[index] == heights], minlength=len(values))


def _has_cliffs(heights: Grid, values: Values, threshold_m: float) -> Bool[np.ndarray, "n"]:
    """Return for each of the sorted values whether nearly all steps at the border of its posts exceed a threshold."""
    steps, cliffs = np.zeros(len(values), dtype=np.int64), np.zeros(len(values), dtype=np.int64)
    if len(values) == 0:
        return cliffs > 0
    for a, b in _pairs(heights):
        is_step = np.isfinite(a) & np.isfinite(b) & (a != b)
        for pair, other in ((a[is_step], b[is_step]), (b[is_step], a[is_step])):
            steps += _count(pair, values)
            cliffs += _count(pair[np.abs(pair - other) > threshold_m], values)
    return (cliffs > 0) & (cliffs >= _CLIFF_FRACTION * steps)


def _has_low_cliffs(heights: Grid, is_value: Mask, posting_m: float) -> bool:
    """Return whether the posts of one height meet the rule of low cliffs, apart from their number and position."""
    border, ground = _steps(heights, is_value)
    if border.size == 0 or ground.size == 0 or np.mean(ground == 0.0) >= _MAX_EQUAL_FRACTION:
        return False
    threshold_m = max(_CLIFF_SLOPE * posting_m, _CLIFF_FACTOR * _percentile(ground, 95.0))
    if np.mean(np.abs(border) > threshold_m) >= _CLIFF_FRACTION:
        return True
    is_two_sided = min(np.mean(border > 0.0), np.mean(border < 0.0)) >= _MIN_SIDE_FRACTION
    median_m = max(_TWO_SIDED_SLOPE * posting_m, _MEDIAN_FACTOR * _percentile(ground, 50.0))
    return bool(is_two_sided and np.median(np.abs(border)) > median_m)


def _steps(heights: Grid, is_value: Mask) -> tuple[Values, Values]:
    """Return the steps from marked posts to other posts, and the absolute steps between other posts."""
    border, ground = [], []
    marks = is_value[:, :-1], is_value[:, 1:], is_value[:-1], is_value[1:]
    for (a, b), (is_a, is_b) in zip(_pairs(heights), (marks[:2], marks[2:]), strict=True):
        is_finite = np.isfinite(a) & np.isfinite(b)
        for start, end, is_border in ((a, b, is_a & ~is_b), (b, a, is_b & ~is_a)):
            selected = is_border & is_finite
            border.append(end[selected] - start[selected])
        selected = is_finite & ~is_a & ~is_b
        ground.append(np.abs(b[selected] - a[selected]))
    return np.concatenate(border), np.concatenate(ground)


def _percentile(steps: Values, percent: float) -> float:
    """Return a percentile of the steps, of a regular sample of them if there are many; 0 without steps."""
    sample = steps[:: max(steps.size // _MAX_STEPS, 1)]
    return float(np.percentile(sample, percent)) if sample.size else 0.0
