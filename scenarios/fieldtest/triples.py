"""Select triples of a run's pictures (paper, III.D and IV)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float64, Int64

from marsyard.scenarios.fieldtest.parameters import RunParameters, TripleParameters


class Category(StrEnum):
    """The paper's categories of triples."""

    SHORT_TIME = "short time"
    SAME_DIRECTION = "same direction"
    OPPOSITE_DIRECTION = "opposite direction"


@dataclass(frozen=True)
class Pictures:
    """Measurements at a run's pictures, one row per picture in the order taken.

    - flown: number of the pass
    - direction: direction of flight along the line, +1 or -1
    - position_m: by GPS, world axes
    - altitude_m: above the ground, as measured
    - centre_m: intersection of the camera's axis with level ground, by the measured attitude: east, north
    """

    flown: Int64[np.ndarray, "n"]
    direction: Int64[np.ndarray, "n"]
    position_m: Float64[np.ndarray, "n 3"]
    altitude_m: Float64[np.ndarray, "n"]
    centre_m: Float64[np.ndarray, "n 2"]


@dataclass(frozen=True)
class Triple:
    """Three pictures in the order in which DIMES is given them, by their numbers in the run."""

    category: Category
    pictures: tuple[int, int, int]


def make_triples(
    run: RunParameters, pictures: Pictures, parameters: TripleParameters, rng: np.random.Generator
) -> tuple[Triple, ...]:
    """Draw the triples of a run: for each category the stated number out of all candidates.

    Pictures of a short-time triple are consecutive ones of one pass. Those of the other categories have decreasing
    altitudes, as in a landing. Raises ValueError where there are too few candidates.
    """
    paired = _find_pairs(pictures, parameters)
    descending = _find_descending(pictures, paired, parameters)
    one_direction = (np.diff(pictures.direction[descending], axis=1) == 0).all(axis=1)
    candidates = {
        Category.SHORT_TIME: (_find_consecutive(pictures, paired), run.short_time),
        Category.SAME_DIRECTION: (descending[one_direction], run.same_direction),
        Category.OPPOSITE_DIRECTION: (descending[~one_direction], run.opposite_direction),
    }
    made = []
    for category, (possible, wanted) in candidates.items():
        if len(possible) < wanted:
            raise ValueError(
                f"{run.name}: {wanted} triples '{category}' are asked for, but its pictures make {len(possible)}"
            )
        for first, second, third in possible[rng.choice(len(possible), wanted, replace=False)].tolist():
            made.append(Triple(category, (first, second, third)))
    return tuple(made)


def _find_pairs(pictures: Pictures, p: TripleParameters) -> Bool[np.ndarray, "n n"]:
    """Find the pairs that overlap and whose distance DIMES can measure over the virtual interval."""
    distances = _distances(pictures.position_m[:, :2])
    lower = np.minimum(pictures.altitude_m[:, None], pictures.altitude_m)
    overlapping = _distances(pictures.centre_m) <= p.overlap_share * lower
    return np.asarray(overlapping & (distances <= p.most_speed_m_s * p.virtual_interval_s))


def _distances(points: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n n"]:
    return np.asarray(np.linalg.norm(points[:, None] - points, axis=-1))


def _find_consecutive(pictures: Pictures, paired: Bool[np.ndarray, "n n"]) -> Int64[np.ndarray, "m 3"]:
    """Find all three consecutive pictures of one pass."""
    first = np.arange(len(pictures.flown) - 2)
    fits = (
        (pictures.flown[first] == pictures.flown[first + 2]) & paired[first, first + 1] & paired[first + 1, first + 2]
    )
    return np.asarray(first[fits][:, None] + np.arange(3))


def _find_descending(
    pictures: Pictures, paired: Bool[np.ndarray, "n n"], p: TripleParameters
) -> Int64[np.ndarray, "m 3"]:
    """Find all three pictures with a step down from each to the next, by GPS."""
    height = pictures.position_m[:, 2]
    step = height[:, None] - height
    follows = paired & (step >= p.least_step_m) & (step <= p.most_step_m)
    # each middle picture with every picture that may come before and after it
    triples = [
        (before, middle, after)
        for middle in range(len(step))
        for before in np.flatnonzero(follows[:, middle])
        for after in np.flatnonzero(follows[middle])
    ]
    return np.array(triples, dtype=np.int64).reshape(-1, 3)
