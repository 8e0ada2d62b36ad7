"""Sampling designs: they define the uniform random numbers of the cases.

``random`` draws every number independently. Only this design allows probability statements. ``latin-hypercube`` and
``sobol`` are stratified: means and sensitivities have smaller errors with the same number of cases, but the cases are
not independent, so there is no verdict at a confidence. Dispersions of kind ``grid`` form a full factorial with any
design, which is not random either. ``adaptive`` marks the folder of a study (`marsyard.campaigns.studies`), which
chooses its cases.

Each case can be drawn alone. The number of the case determines its block (the first, or an appended block), its point
of the grid (its number within the block, modulo the size of the grid), and its index in the design of this block and
grid point. A stratified design is computed for all its cases, from one random stream per dispersion.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Annotated, Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from marsyard.campaigns.sampling.correlation import MAX_DRAW, MIN_DRAW, CorrelatedGroup, correlate_uniform
from marsyard.sim.parameters import Parameters
from marsyard.sim.streams import Streams

#: Maximum number of cases of one stratified design, which needs eight bytes for each case and dispersion.
MAX_STRATIFIED = 2**20
#: Bits of a Sobol point: the number of bits of a float's fraction.
_SOBOL_BITS = 52
#: Number of designs that a process caches, since successive cases use the same design.
_CACHED_DESIGNS = 4
#: Kinds of sampling designs, see above.
DesignKind = Literal["random", "latin-hypercube", "sobol", "adaptive"]
#: Kind of a study: it chooses its cases, whose points are stored with their rows.
ADAPTIVE: Final = "adaptive"


class Design(Parameters):
    """Sampling design of a campaign.

    With `nominal`, the first case has the campaign's parameters without sampling.
    """

    kind: DesignKind = "random"
    nominal: Annotated[bool, Field(strict=True)] = False

    def find_invalid_block(self, blocks: Sequence[int], grid_size: int) -> tuple[int, str] | None:
        """Find the first block whose size does not fit the design; return its index and the reason, or None."""
        for index, block in enumerate(blocks):
            nominal_cases = int(self.nominal and index == 0)
            cases = block - nominal_cases
            size, remainder = divmod(cases, grid_size)
            problem = ""
            if remainder or (cases == 0 and (self.kind != "random" or grid_size > 1)):
                problem = "no case remains"
                if grid_size > 1:
                    problem = f"the grid has {grid_size} points; allowed: a multiple of this number"
            elif self.kind != "random" and size > MAX_STRATIFIED:
                problem = f"a {self.kind} design has at most {MAX_STRATIFIED} cases per point of the grid"
            elif self.kind == "sobol" and size & (size - 1):  # not a power of 2
                lower_power = 1 << (size.bit_length() - 1)
                condition = " at each point of the grid" if grid_size > 1 else ""
                problem = f"a Sobol design needs a power of 2{condition}, such as {lower_power} or {2 * lower_power}"
            if problem:
                after_nominal = " after the nominal case" if nominal_cases else ""
                return index, f"{cases} cases{after_nominal} do not fit the sampling design: {problem}"
        return None


class CasePosition(NamedTuple):
    """Grid point of a case, first case and number of cases of its block at this point, and index among these cases."""

    grid_point: int
    first_case: int
    case_count: int
    design_index: int


def locate_case(design: Design, blocks: Sequence[int], grid_size: int, case: int) -> CasePosition | None:
    """Return the position of a case in blocks of the sizes `blocks`; None for the nominal case."""
    if design.nominal and case == 0:
        return None
    start, block = 0, 0
    while block < len(blocks) - 1 and case >= start + blocks[block]:
        start += blocks[block]
        block += 1
    size = blocks[block]
    if design.nominal and block == 0:
        start, size = 1, size - 1
    index, point = divmod(case - start, grid_size)
    return CasePosition(point, start + point, size // grid_size, index)


@lru_cache(maxsize=_CACHED_DESIGNS)
def build_stratified_design(
    kind: DesignKind,
    seed: int,
    campaign: str,
    first_case: int,
    case_count: int,
    paths: tuple[str, ...],
    groups: tuple[CorrelatedGroup, ...],
) -> Float64[np.ndarray, "cases dispersions"]:
    """Create the uniform numbers of a stratified design, each above 0 and below 1.

    - kind: `latin-hypercube` or `sobol`
    - seed, campaign, first_case: identify the random streams; `first_case` is the first case of the design
    - case_count: number of cases; paths: dispersions, in the order of their dimensions; groups: see `CorrelatedGroup`

    Each dispersion has its own stream. A Latin hypercube is an independent random permutation of the strata for each
    dispersion. The dimensions of a Sobol sequence follow the order of the file; each dimension is scrambled (Matousek
    1998, in SciPy) with its own stream, and depends only on its position.

    In a Latin hypercube, the numbers of a correlated group are sorted into the rank order of the correlated numbers, so
    that each stratum still contains one number (Stein 1987, Technometrics 29, 143-151). In a Sobol sequence, the
    correlated numbers replace the original numbers.
    """
    from scipy.stats import qmc

    streams = Streams(seed, campaign, first_case)
    points = np.zeros((case_count, len(paths)))
    for dimension, path in enumerate(paths):
        rng = streams.generator(f"design:{path}")
        if kind == "latin-hypercube":
            points[:, dimension] = qmc.LatinHypercube(d=1, rng=rng).random(case_count)[:, 0]
        else:
            sobol_points = qmc.Sobol(d=dimension + 1, scramble=True, bits=_SOBOL_BITS, rng=rng).random(case_count)
            # use the centre of the step, which is never 0
            points[:, dimension] = sobol_points[:, dimension] + 2.0 ** -(_SOBOL_BITS + 1)
    points = np.clip(points, MIN_DRAW, MAX_DRAW)
    for members, factor in groups:
        values = points[:, list(members)]
        correlated = correlate_uniform(values, np.array(factor))
        if kind == "latin-hypercube":
            ranks = np.argsort(np.argsort(correlated, axis=0, kind="stable"), axis=0, kind="stable")
            correlated = np.take_along_axis(np.sort(values, axis=0), ranks, axis=0)
        points[:, list(members)] = correlated
    points.flags.writeable = False
    return points


def compute_grid_quantiles(sizes: Mapping[str, int], point: int) -> dict[str, float]:
    """Compute the probability (bin centre) of each grid's level at a point of the full factorial, last grid fastest."""
    levels = np.unravel_index(point, tuple(sizes.values())) if sizes else ()
    return {path: (int(level) + 0.5) / size for (path, size), level in zip(sizes.items(), levels, strict=True)}


def describe_design(kind: str, grids: Sequence[str], sequences: Sequence[str] = (), *, nominal: bool) -> str:
    """Describe a sampling design in words; for `sequences` see `marsyard.campaigns.sampling.dispersions`."""
    names = {
        "random": "random draws",
        "latin-hypercube": "Latin hypercube",
        "sobol": "scrambled Sobol",
        "adaptive": "points chosen by a study",
    }
    text = names.get(kind, kind)
    if kind == "random" and not grids and not sequences:
        text = f"independent {text}"
    if grids:
        text += f" at each point of a grid over {', '.join(grids)}"
    if sequences:
        text += f" with values in turn of {', '.join(sequences)}"
    return f"{text}; case 0 is the nominal case" if nominal else text
