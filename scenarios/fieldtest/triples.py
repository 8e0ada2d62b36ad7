"""Triples of a run's pictures, as the paper makes them (III.D and IV)."""

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
    """What is known of a run's pictures when triples are made; one row a picture, in the order taken.

    Attributes
    ----------
    flown
        Number of the pass.
    direction
        Direction of flight along the line, +1 or -1.
    position_m
        By GPS, world axes.
    altitude_m
        Above the ground, as measured.
    centre_m
        Where the camera's axis meets level ground at that altitude, by the measured attitude: east, north.
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
    """The triples of a run: for each category as many as the run states, drawn from all there are.

    Pictures of a short-time triple follow each other on one pass. Those of the others come in the order of falling
    altitude, as in a landing.

    Raises
    ------
    ValueError
        If the pictures make fewer triples than are asked for.
    """
    paired = _paired(pictures, parameters)
    apart = _apart(pictures, paired, parameters)
    flown_one_way = (np.diff(pictures.direction[apart], axis=1) == 0).all(axis=1)
    candidates = {
        Category.SHORT_TIME: (_consecutive(pictures, paired), run.short_time),
        Category.SAME_DIRECTION: (apart[flown_one_way], run.same_direction),
        Category.OPPOSITE_DIRECTION: (apart[~flown_one_way], run.opposite_direction),
    }
    made = []
    for category, (found, wanted) in candidates.items():
        if len(found) < wanted:
            raise ValueError(
                f"{run.name}: {wanted} triples '{category}' are asked for, but its pictures make {len(found)}"
            )
        for first, second, third in found[rng.choice(len(found), wanted, replace=False)].tolist():
            made.append(Triple(category, (first, second, third)))
    return tuple(made)


def _paired(pictures: Pictures, p: TripleParameters) -> Bool[np.ndarray, "n n"]:
    """Which two pictures overlap, and lie no further apart than DIMES can follow in the virtual interval."""
    moved = _distances(pictures.position_m[:, :2])
    lower = np.minimum(pictures.altitude_m[:, None], pictures.altitude_m)
    overlapping = _distances(pictures.centre_m) <= p.overlap_share * lower
    return np.asarray(overlapping & (moved <= p.most_speed_m_s * p.virtual_interval_s))


def _distances(points: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n n"]:
    distances: Float64[np.ndarray, "n n"] = np.linalg.norm(points[:, None] - points, axis=-1)
    return distances


def _consecutive(pictures: Pictures, paired: Bool[np.ndarray, "n n"]) -> Int64[np.ndarray, "m 3"]:
    """Every three pictures in a row of one pass."""
    first = np.arange(len(pictures.flown) - 2)
    fits = (
        (pictures.flown[first] == pictures.flown[first + 2]) & paired[first, first + 1] & paired[first + 1, first + 2]
    )
    return np.asarray(first[fits][:, None] + np.arange(3))


def _apart(pictures: Pictures, paired: Bool[np.ndarray, "n n"], p: TripleParameters) -> Int64[np.ndarray, "m 3"]:
    """Every three pictures with a step down from each to the next, by GPS."""
    height = pictures.position_m[:, 2]
    step = height[:, None] - height
    follows = paired & (step >= p.least_step_m) & (step <= p.most_step_m)
    # the middle picture with each that may come before and after it
    found = [
        np.array([(before, middle, after) for before in np.flatnonzero(follows[:, middle]) for after in nexts])
        for middle in range(len(step))
        if (nexts := np.flatnonzero(follows[middle])).size and follows[:, middle].any()
    ]
    return np.concatenate(found) if found else np.zeros((0, 3), dtype=np.int64)
