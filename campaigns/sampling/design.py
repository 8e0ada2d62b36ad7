"""Designs: how the uniform numbers behind the draws are laid out over the cases.

``random`` draws every number independently: the only design that a probability follows from. ``latin-hypercube`` and
``sobol`` lay the numbers out evenly, which makes means and sensitivities sharper with fewer cases; their cases are not
independent, so that they give statistics and no verdict. Dispersions of the kind ``grid`` are swept in full factorial
under any design, which is no random draw either.

Any case can be drawn alone. Its place follows from its number: in which block of cases it lies (the first, or one that
was appended), at which point of the grid (its number within the block, modulo the grid's size), and as which point of
the design that is laid out anew for each block and each point of the grid. A stratified design is made as a whole, from
one stream for each dispersion; its size is part of what it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.special import ndtr, ndtri

from marsyard.campaigns.sampling.stated import StatedTable
from marsyard.sim.streams import Streams

#: Half the step of `Generator.random`: keeps a draw off 0, where distributions with endless tails have no value.
SMALLEST = 2.0**-54
#: The greatest number below 1.
GREATEST = 1.0 - 2.0**-53
#: The most cases of one stratified design, which is held in memory: eight bytes for each case and dispersion.
MOST_STRATIFIED = 2**20
#: Bits of a Sobol point: those of a float's fraction, so that a step is as fine as that of `Generator.random`.
_SOBOL_BITS = 52
#: Designs that a process keeps; a case is drawn alone, but its neighbours are likely to be asked for next.
_KEPT = 4

Kind = Literal["random", "latin-hypercube", "sobol"]


class Design(StatedTable):
    """How cases are laid out.

    With `nominal` the first case is the campaign's parameters as they stand, without any draw.
    """

    kind: Kind = "random"
    nominal: Annotated[bool, Field(strict=True)] = False

    def problem(self, blocks: Sequence[int], grid_size: int) -> tuple[int, str] | None:
        """The first block of cases that cannot be laid out, and why; None where all can."""
        for number, block in enumerate(blocks):
            nominal = int(self.nominal and number == 0)
            problem = self._block_problem(block - nominal, grid_size)
            if problem:
                return (
                    number,
                    f"{block - nominal} cases{' behind the nominal one' * nominal} cannot be laid out: {problem}",
                )
        return None

    def _block_problem(self, cases: int, grid_size: int) -> str:
        if cases == 0 and self.kind == "random" and grid_size == 1:
            return ""
        if cases == 0 or cases % grid_size:
            return f"the grid has {grid_size} points; allowed: a multiple of them" if grid_size > 1 else "none is left"
        size = cases // grid_size
        if self.kind != "random" and size > MOST_STRATIFIED:
            return f"a {self.kind} design has at most {MOST_STRATIFIED} cases a point of the grid"
        if self.kind == "sobol" and size & (size - 1):
            below = 1 << (size.bit_length() - 1)
            each = " at each point of the grid" if grid_size > 1 else ""
            return f"a Sobol design takes a power of 2{each}, such as {below} or {2 * below}"
        return ""


@dataclass(frozen=True)
class Place:
    """Where a case lies.

    Attributes
    ----------
    grid_point
        Number of its point of the grid, from 0.
    first
        The first case at that point in its block.
    size
        How many cases there are at that point in its block.
    index
        Which of them it is, from 0.
    """

    grid_point: int
    first: int
    size: int
    index: int


def place_of(design: Design, blocks: Sequence[int], grid_size: int, case: int) -> Place | None:
    """Where a case lies, in blocks of so many cases; None for the nominal case, which lies nowhere."""
    if design.nominal and case == 0:
        return None
    start, number = 0, 0
    while number < len(blocks) - 1 and case >= start + blocks[number]:
        start += blocks[number]
        number += 1
    size = blocks[number]
    if design.nominal and number == 0:
        start, size = 1, size - 1
    index, point = divmod(case - start, grid_size)
    return Place(point, start + point, size // grid_size, index)


@dataclass(frozen=True)
class Layout:
    """One stratified design, as a key: everything that its numbers follow from.

    Attributes
    ----------
    kind
        `latin-hypercube` or `sobol`.
    seed, campaign
        Of the streams.
    first, size
        Its first case and how many there are; see `Place`.
    paths
        The dispersions, in the order of their dimensions.
    groups
        Members of each correlated group, as places in `paths`, and the group's factor L, row by row.
    """

    kind: Kind
    seed: int
    campaign: str
    first: int
    size: int
    paths: tuple[str, ...]
    groups: tuple[tuple[tuple[int, ...], tuple[tuple[float, ...], ...]], ...]


@lru_cache(maxsize=_KEPT)
def stratified(layout: Layout) -> Float64[np.ndarray, "cases dispersions"]:
    """All uniform numbers of a stratified design, each above 0 and below 1.

    Every dispersion has its own stream. A Latin hypercube is then a random order of the strata for each, and no
    dispersion's numbers depend on another's. A Sobol sequence's dimensions go by the order of the file; each is
    scrambled (Matousek 1998, in SciPy) from its own stream, and changes with its place alone.

    Members of a correlated group keep their strata in a Latin hypercube: their numbers are put into the order that the
    mixed ones have (Stein 1987, Technometrics 29, 143-151). Of a Sobol sequence the numbers themselves are mixed.
    """
    streams = Streams(layout.seed, layout.campaign, layout.first)
    make = _latin if layout.kind == "latin-hypercube" else _sobol
    columns = [make(streams.generator(f"design:{path}"), layout.size, k) for k, path in enumerate(layout.paths)]
    points = np.clip(np.column_stack(columns), SMALLEST, GREATEST) if columns else np.zeros((layout.size, 0))
    for members, factor in layout.groups:
        chosen = list(members)
        mixed = correlated(points[:, chosen], np.array(factor))
        points[:, chosen] = _in_order_of(points[:, chosen], mixed) if layout.kind == "latin-hypercube" else mixed
    points.flags.writeable = False
    return points


def correlated(
    uniform: Float64[np.ndarray, "*cases members"], factor: Float64[np.ndarray, "members members"]
) -> Float64[np.ndarray, "*cases members"]:
    """Uniform numbers of a group, from independent ones: Phi(L Phi^-1(u)); see
    `marsyard.campaigns.sampling.correlation`.
    """
    mixed: Float64[np.ndarray, "*cases members"] = np.clip(ndtr(ndtri(uniform) @ factor.T), SMALLEST, GREATEST)
    return mixed


def _latin(rng: np.random.Generator, size: int, _dimension: int) -> Float64[np.ndarray, " cases"]:
    from scipy.stats import qmc

    return np.asarray(qmc.LatinHypercube(d=1, rng=rng).random(size)[:, 0], dtype=np.float64)


def _sobol(rng: np.random.Generator, size: int, dimension: int) -> Float64[np.ndarray, " cases"]:
    from scipy.stats import qmc

    points = qmc.Sobol(d=dimension + 1, scramble=True, bits=_SOBOL_BITS, rng=rng).random(size)
    # in the middle of the step, so that none is 0
    return np.asarray(points[:, dimension], dtype=np.float64) + 2.0 ** -(_SOBOL_BITS + 1)


def _in_order_of(
    values: Float64[np.ndarray, "cases members"], other: Float64[np.ndarray, "cases members"]
) -> Float64[np.ndarray, "cases members"]:
    """Each column's values, rearranged so that they rank as the other's do."""
    ranks = np.argsort(np.argsort(other, axis=0, kind="stable"), axis=0, kind="stable")
    return np.take_along_axis(np.sort(values, axis=0), ranks, axis=0)


def grid_probabilities(sizes: Mapping[str, int], point: int) -> dict[str, float]:
    """Probabilities at which the grids' levels of one point of the full factorial lie; the last varies fastest."""
    levels = np.unravel_index(point, tuple(sizes.values())) if sizes else ()
    return {path: (int(level) + 0.5) / size for (path, size), level in zip(sizes.items(), levels, strict=True)}


def said_of(kind: str, grids: Sequence[str], *, nominal: bool) -> str:
    """How the cases are laid out, in words."""
    named = {"random": "random draws", "latin-hypercube": "Latin hypercube", "sobol": "scrambled Sobol"}
    text = named.get(kind, kind)
    if kind == "random" and not grids:
        text = f"independent {text}"
    if grids:
        text += f" at each point of a grid over {', '.join(grids)}"
    return f"{text}; case 0 is the nominal one" if nominal else text
