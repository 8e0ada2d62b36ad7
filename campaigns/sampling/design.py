"""Sampling designs: how the uniform numbers behind the draws are distributed over the cases.

``random`` draws every number independently: the only design from which a probability follows. ``latin-hypercube`` and
``sobol`` are stratified, which gives sharper means and sensitivities with fewer cases; their cases are not independent,
so they give statistics and no verdict. Dispersions of kind ``grid`` form a full factorial under any design, which is
no random draw either.

Any case can be drawn alone. Its position follows from its number: the block of cases that contains it (the first, or an
appended one), its point of the grid (its number within the block, modulo the grid's size), and its index in the design
of this block and grid point. A stratified design is built as a whole, from one stream per dispersion; its size is part
of its definition.
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

from marsyard.sim.parameters import Parameters
from marsyard.sim.streams import Streams

#: Minimum draw, half the step of `Generator.random`: unbounded distributions have no value at 0.
MIN_DRAW = 2.0**-54
#: Maximum draw, the largest float below 1.
MAX_DRAW = 1.0 - 2.0**-53
#: Maximum number of cases of one stratified design, which takes eight bytes for each case and dispersion.
MAX_STRATIFIED = 2**20
#: Bits of a Sobol point, as many as in a float's fraction.
_SOBOL_BITS = 52
#: Designs that a process keeps: neighbouring cases share one.
_CACHED_DESIGNS = 4

Kind = Literal["random", "latin-hypercube", "sobol"]


class Design(Parameters):
    """Sampling design of a campaign.

    With `nominal` the first case has the campaign's parameters without any draw.
    """

    kind: Kind = "random"
    nominal: Annotated[bool, Field(strict=True)] = False

    def problem(self, blocks: Sequence[int], grid_size: int) -> tuple[int, str] | None:
        """First block of cases that has no such design, and the reason; None where all have one."""
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
        """Reason why a block of so many cases has no such design; empty where it has one."""
        if cases == 0 and self.kind == "random" and grid_size == 1:
            return ""
        if cases == 0 or cases % grid_size:
            return f"the grid has {grid_size} points; allowed: a multiple of them" if grid_size > 1 else "none is left"
        size = cases // grid_size
        if self.kind != "random" and size > MAX_STRATIFIED:
            return f"a {self.kind} design has at most {MAX_STRATIFIED} cases a point of the grid"
        if self.kind == "sobol" and size & (size - 1):
            below = 1 << (size.bit_length() - 1)
            each = " at each point of the grid" if grid_size > 1 else ""
            return f"a Sobol design takes a power of 2{each}, such as {below} or {2 * below}"
        return ""


@dataclass(frozen=True)
class CasePosition:
    """Position of a case in the design.

    grid_point: index of its point of the grid.
    first: first case at this point in its block.
    size: number of cases at this point in its block.
    index: index of the case among these.
    """

    grid_point: int
    first: int
    size: int
    index: int


def locate_case(design: Design, blocks: Sequence[int], grid_size: int, case: int) -> CasePosition | None:
    """Position of a case in blocks of given sizes; None for the nominal case."""
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
    return CasePosition(point, start + point, size // grid_size, index)


@dataclass(frozen=True)
class Layout:
    """Everything that determines the numbers of one stratified design.

    kind: `latin-hypercube` or `sobol`.
    seed, campaign: of the random streams.
    first, size: see `CasePosition`.
    paths: dispersions, in the order of their dimensions.
    groups: indices of each correlated group's members in `paths`, and the rows of its factor L.
    """

    kind: Kind
    seed: int
    campaign: str
    first: int
    size: int
    paths: tuple[str, ...]
    groups: tuple[tuple[tuple[int, ...], tuple[tuple[float, ...], ...]], ...]


@lru_cache(maxsize=_CACHED_DESIGNS)
def build_stratified_design(layout: Layout) -> Float64[np.ndarray, "cases dispersions"]:
    """Uniform numbers of a stratified design, each above 0 and below 1.

    Every dispersion has its own stream. A Latin hypercube is a random permutation of the strata for each dispersion; no
    dispersion depends on another. The dimensions of a Sobol sequence follow the order of the file; each is scrambled
    (Matousek 1998, in SciPy) from its own stream, and changes with its position only.

    Members of a correlated group keep their strata in a Latin hypercube: their numbers are sorted into the rank order
    of the mixed ones (Stein 1987, Technometrics 29, 143-151). For a Sobol sequence the numbers themselves are mixed.
    """
    streams = Streams(layout.seed, layout.campaign, layout.first)
    generate = _generate_latin if layout.kind == "latin-hypercube" else _generate_sobol
    columns = [generate(streams.generator(f"design:{path}"), layout.size, k) for k, path in enumerate(layout.paths)]
    points = np.clip(np.column_stack(columns), MIN_DRAW, MAX_DRAW) if columns else np.zeros((layout.size, 0))
    for members, factor in layout.groups:
        chosen = list(members)
        mixed = correlate_uniform(points[:, chosen], np.array(factor))
        points[:, chosen] = _reorder_by_rank(points[:, chosen], mixed) if layout.kind == "latin-hypercube" else mixed
    points.flags.writeable = False
    return points


def correlate_uniform(
    uniform: Float64[np.ndarray, "*cases members"], factor: Float64[np.ndarray, "members members"]
) -> Float64[np.ndarray, "*cases members"]:
    """Correlated uniform numbers of a group from independent ones: Phi(L Phi^-1(u)), see
    `marsyard.campaigns.sampling.correlation`.
    """
    mixed: Float64[np.ndarray, "*cases members"] = np.clip(ndtr(ndtri(uniform) @ factor.T), MIN_DRAW, MAX_DRAW)
    return mixed


def _generate_latin(rng: np.random.Generator, size: int, _dimension: int) -> Float64[np.ndarray, " cases"]:
    from scipy.stats import qmc

    return np.asarray(qmc.LatinHypercube(d=1, rng=rng).random(size)[:, 0], dtype=np.float64)


def _generate_sobol(rng: np.random.Generator, size: int, dimension: int) -> Float64[np.ndarray, " cases"]:
    from scipy.stats import qmc

    points = qmc.Sobol(d=dimension + 1, scramble=True, bits=_SOBOL_BITS, rng=rng).random(size)
    # centre of the step, never 0
    return np.asarray(points[:, dimension], dtype=np.float64) + 2.0 ** -(_SOBOL_BITS + 1)


def _reorder_by_rank(
    values: Float64[np.ndarray, "cases members"], other: Float64[np.ndarray, "cases members"]
) -> Float64[np.ndarray, "cases members"]:
    ranks = np.argsort(np.argsort(other, axis=0, kind="stable"), axis=0, kind="stable")
    return np.take_along_axis(np.sort(values, axis=0), ranks, axis=0)


def grid_probabilities(sizes: Mapping[str, int], point: int) -> dict[str, float]:
    """Probabilities of the grids' levels at one point of the full factorial; the last grid varies fastest."""
    levels = np.unravel_index(point, tuple(sizes.values())) if sizes else ()
    return {path: (int(level) + 0.5) / size for (path, size), level in zip(sizes.items(), levels, strict=True)}


def describe_design(kind: str, grids: Sequence[str], *, nominal: bool) -> str:
    """Sampling design in words."""
    names = {"random": "random draws", "latin-hypercube": "Latin hypercube", "sobol": "scrambled Sobol"}
    text = names.get(kind, kind)
    if kind == "random" and not grids:
        text = f"independent {text}"
    if grids:
        text += f" at each point of a grid over {', '.join(grids)}"
    return f"{text}; case 0 is the nominal one" if nominal else text
