"""Triples of the field test: three images of a run that DIMES receives like those of a landing."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float64, Int64

from marsyard.scenarios.fieldtest.parameters import FieldTestParameters, RunParameters, TripleParameters


class Category(StrEnum):
    """The paper's categories of triples."""

    SHORT_TIME = "short time"
    SAME_DIRECTION = "same direction"
    OPPOSITE_DIRECTION = "opposite direction"


@dataclass(frozen=True)
class ImageMeasurements:
    """Measurements at a run's images, one row per image in the order taken.

    - pass_number: number of the pass
    - direction: direction of flight along the line, +1 or -1
    - position_m: GPS position, world axes
    - altitude_m: measured altitude above the ground
    - centre_m: intersection (east, north) of the optical axis with level ground, from the measured attitude
    """

    pass_number: Int64[np.ndarray, "n"]
    direction: Int64[np.ndarray, "n"]
    position_m: Float64[np.ndarray, "n 3"]
    altitude_m: Float64[np.ndarray, "n"]
    centre_m: Float64[np.ndarray, "n 2"]


@dataclass(frozen=True)
class Triple:
    """Category of three images, and their indices among the run's images in the input order of DIMES."""

    category: Category
    image_indices: tuple[int, int, int]


def find_triples(images: ImageMeasurements, parameters: TripleParameters) -> dict[Category, Int64[np.ndarray, "n 3"]]:
    """Find all triples of a run's images: for each category the indices of the images, one row per triple.

    A short-time triple consists of consecutive images of one pass. Triples of the other categories have decreasing
    altitudes, as in a landing.
    """
    # pairs that overlap and whose distance DIMES can measure over the virtual interval
    min_altitude = np.minimum(images.altitude_m[:, None], images.altitude_m)
    is_pair = _pairwise_distances(images.centre_m) <= parameters.overlap_fraction * min_altitude
    is_pair &= _pairwise_distances(images.position_m[:, :2]) <= parameters.max_speed_m_s * parameters.virtual_interval_s
    start = np.arange(len(images.pass_number) - 2)
    in_one_pass = images.pass_number[start] == images.pass_number[start + 2]
    consecutive = start[in_one_pass & is_pair[start, start + 1] & is_pair[start + 1, start + 2]]
    # all triples whose GPS height decreases by a permitted step from image to image
    step = images.position_m[:, 2][:, None] - images.position_m[:, 2]
    is_step = is_pair & (step >= parameters.min_step_m) & (step <= parameters.max_step_m)
    descending = np.array(
        [
            (upper, centre, lower)
            for centre in range(len(step))
            for upper in np.flatnonzero(is_step[:, centre])
            for lower in np.flatnonzero(is_step[centre])
        ],
        dtype=np.int64,
    ).reshape(-1, 3)
    same_direction = (np.diff(images.direction[descending], axis=1) == 0).all(axis=1)
    return {
        Category.SHORT_TIME: consecutive[:, None] + np.arange(3),
        Category.SAME_DIRECTION: descending[same_direction],
        Category.OPPOSITE_DIRECTION: descending[~same_direction],
    }


def draw_triples(
    run: RunParameters, images: ImageMeasurements, parameters: TripleParameters, rng: np.random.Generator
) -> tuple[Triple, ...]:
    """Draw the triples of a run: for each category the specified number out of all of its triples.

    Raises ValueError if there are too few.
    """
    counts = (run.short_time, run.same_direction, run.opposite_direction)
    triples = []
    for (category, indices), count in zip(find_triples(images, parameters).items(), counts, strict=True):
        if len(indices) < count:
            raise ValueError(f"{run.name}: {count} triples '{category}' are requested, but only {len(indices)} exist")
        for first, second, third in indices[rng.choice(len(indices), count, replace=False)].tolist():
            triples.append(Triple(category, (first, second, third)))
    return tuple(triples)


def _pairwise_distances(points: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n n"]:
    return np.asarray(np.linalg.norm(points[:, None] - points, axis=-1))


def find_triple(p: FieldTestParameters, case: int) -> tuple[int, int]:
    """Return the indices of a case's run and triple. Raises ValueError if the case does not exist."""
    total = sum(run.triples for run in p.runs)
    if case >= total:
        raise ValueError(f"case {case} does not exist: the runs define {total} triples; allowed: 0 to {total - 1}")
    return case_order(p)[case]


def case_order(p: FieldTestParameters) -> list[tuple[int, int]]:
    """Return the run and triple of each case.

    Triple k of the n triples of a category has the rank (k + 0.5) / n. Sorting by rank mixes all runs and categories in
    proportion, so that any number of first cases is representative.
    """
    ranks = []
    for number, run in enumerate(p.runs):
        start = 0
        for count in (run.short_time, run.same_direction, run.opposite_direction):
            ranks += [((index + 0.5) / count, number, start + index) for index in range(count)]
            start += count
    return [(number, index) for _, number, index in sorted(ranks)]
