"""Sampling designs and correlated groups: they define the uniform random numbers of the cases.

``random`` draws every number independently. Only this design allows probability statements. ``latin-hypercube`` and
``sobol`` are stratified: means and sensitivities have smaller errors with the same number of cases, but the cases are
not independent, so there is no verdict at a confidence. Dispersions of kind ``grid`` form a full factorial with any
design, which is not random either. ``adaptive`` marks the folder of a study (`marsyard.campaigns.studies`), which
chooses its cases.

Each case can be drawn alone. The number of the case determines its block (the first, or an appended block), its point
of the grid (its number within the block, modulo the size of the grid), and its index in the design of this block and
grid point. A stratified design is computed for all its cases, from one random stream per dispersion.

Correlated groups are defined by a covariance, a correlation or a rank correlation. In all three cases the members are
coupled by a Gaussian copula (Nelsen, An Introduction to Copulas, 2006, section 2.3). Independent uniform numbers u are
converted to normal numbers z = Phi^-1(u). The product z' = L z with a Cholesky factor L has the correlation R = L L^T.
Phi(z') then replaces u. The distribution of each member does not depend on R. Since L is lower triangular, a
member that is added at the end of a group does not change the numbers of the other members.

- ``covariance`` and ``correlation`` (Pearson's) are for normal dispersions without truncation, whose draws are exactly
  multivariate normal: R is the correlation itself. A covariance also defines the standard deviations.
- ``rank`` (Spearman's) is for any continuous dispersions: R = 2 sin(pi/6 rank), exactly (Kruskal 1958, J. Am. Stat.
  Assoc. 53, 814-861; ranks do not depend on the marginals).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Annotated, Final, Literal, Self

import numpy as np
from jaxtyping import Float64
from pydantic import Field, model_validator
from scipy.special import ndtr, ndtri

from marsyard.sim.parameters import Parameters
from marsyard.sim.streams import Streams

#: Minimum draw, half the step 2**-53 of `Generator.random`, since unbounded distributions have no value at 0.
MIN_DRAW = 2.0**-54
#: Maximum draw, the largest float below 1.
MAX_DRAW = 1.0 - 2.0**-53
#: Maximum number of cases of one stratified design, which needs eight bytes for each case and dispersion.
MAX_STRATIFIED = 2**20
#: Bits of a Sobol point: the number of bits of a float's fraction.
_SOBOL_BITS = 52
#: Number of designs that a process caches, since successive cases use the same design.
_CACHED_DESIGNS = 4
#: Kinds of sampling designs, see above.
Kind = Literal["random", "latin-hypercube", "sobol", "adaptive"]
#: Kind of a study: it chooses its cases, whose points are stored with their rows.
ADAPTIVE: Final = "adaptive"
#: Indices of a correlated group's members among the dispersions, and the rows of its factor L.
CorrelatedGroup = tuple[tuple[int, ...], tuple[tuple[float, ...], ...]]


class Design(Parameters):
    """Sampling design of a campaign.

    With `nominal`, the first case has the campaign's parameters without sampling.
    """

    kind: Kind = "random"
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
                after_nominal = " after the nominal case" * nominal_cases
                return index, f"{cases} cases{after_nominal} do not fit the sampling design: {problem}"
        return None


def locate_case(design: Design, blocks: Sequence[int], grid_size: int, case: int) -> tuple[int, int, int, int] | None:
    """Return the position of a case in blocks of the sizes `blocks`; None for the nominal case.

    The position is: index of the case's grid point; in its block, first case and number of cases at this grid point;
    index of the case among these cases.
    """
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
    return point, start + point, size // grid_size, index


@lru_cache(maxsize=_CACHED_DESIGNS)
def build_stratified_design(
    kind: Kind,
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


def correlate_uniform(
    uniform: Float64[np.ndarray, "*cases members"], factor: Float64[np.ndarray, "members members"]
) -> Float64[np.ndarray, "*cases members"]:
    """Correlate independent uniform numbers u of a group: Phi(L Phi^-1(u)) with the factor L."""
    return np.asarray(np.clip(ndtr(ndtri(uniform) @ factor.T), MIN_DRAW, MAX_DRAW))


def compute_grid_quantiles(sizes: Mapping[str, int], point: int) -> dict[str, float]:
    """Compute the probability (bin centre) of each grid's level at a point of the full factorial, last grid fastest."""
    levels = np.unravel_index(point, tuple(sizes.values())) if sizes else ()
    return {path: (int(level) + 0.5) / size for (path, size), level in zip(sizes.items(), levels, strict=True)}


def describe_design(kind: str, grids: Sequence[str], *, nominal: bool) -> str:
    """Describe a sampling design in words."""
    names = {
        "random": "random draws",
        "latin-hypercube": "Latin hypercube",
        "sobol": "scrambled Sobol",
        "adaptive": "points chosen by a study",
    }
    text = names.get(kind, kind)
    if kind == "random" and not grids:
        text = f"independent {text}"
    if grids:
        text += f" at each point of a grid over {', '.join(grids)}"
    return f"{text}; case 0 is the nominal case" if nominal else text


_Matrix = tuple[tuple[Annotated[float, Field(strict=True, allow_inf_nan=False)], ...], ...]
#: Relative tolerance of the check for symmetry, since files contain rounded numbers.
_ROUNDING = 1e-9
#: Minimum eigenvalue of a correlation matrix; below it, members are numerically functions of each other.
_MIN_EIGENVALUE = 1e-10
#: Kinds of matrix that define a group.
MATRICES = ("covariance", "correlation", "rank")


class Correlation(Parameters):
    """Correlated group of dispersed parameters, with one matrix in the order of the parameters."""

    parameters: Annotated[tuple[str, ...], Field(min_length=1, max_length=200)]
    covariance: _Matrix | None = None
    correlation: _Matrix | None = None
    rank: _Matrix | None = None
    source: str = ""

    @model_validator(mode="after")
    def _check_matrix(self) -> Self:
        kinds = [name for name in MATRICES if getattr(self, name) is not None]
        if len(kinds) != 1:
            raise ValueError(f"one of {', '.join(MATRICES)} is needed, got {', '.join(kinds) or 'none'}")
        repeated = sorted({name for name in self.parameters if self.parameters.count(name) > 1})
        if repeated:
            raise ValueError(f"repeated parameters: {', '.join(repeated)}")
        rows, size = getattr(self, self.kind), len(self.parameters)
        if len(rows) != size or any(len(row) != size for row in rows):
            raise ValueError(f"{self.kind} must have {size} rows of {size} numbers, one for each parameter")
        matrix = np.array(rows, dtype=np.float64)
        if np.any(np.abs(matrix - matrix.T) > _ROUNDING * np.abs(matrix).max()):
            raise ValueError(f"{self.kind} is not symmetric")
        diagonal = np.diag(matrix)
        if self.kind == "covariance" and not np.all(diagonal > 0.0):
            raise ValueError("covariance has a variance that is not above 0")
        if self.kind != "covariance" and not np.allclose(diagonal, 1.0, rtol=0.0, atol=_ROUNDING):
            raise ValueError(f"{self.kind} must be 1 along its diagonal")
        if self.kind != "covariance" and np.any(np.abs(matrix) > 1.0 + _ROUNDING):
            raise ValueError(f"{self.kind} has an entry that is not between -1 and 1")
        normals = self.normal_correlation
        min_eigenvalue = float(np.linalg.eigvalsh(normals)[0]) if np.isfinite(normals).all() else float("nan")
        if not min_eigenvalue > _MIN_EIGENVALUE:
            reason = "the correlation of the normal numbers is not positive definite: its minimum eigenvalue is"
            raise ValueError(f"{self.kind} is not valid for a group: {reason} {min_eigenvalue:.3g}")
        return self

    @property
    def kind(self) -> str:
        """Kind of the matrix: `covariance`, `correlation` or `rank`."""
        return next(name for name in MATRICES if getattr(self, name) is not None)

    @property
    def normal_correlation(self) -> Float64[np.ndarray, "n n"]:
        """Correlation R of the normal numbers before their transformation to the marginals."""
        matrix = np.array(getattr(self, self.kind), dtype=np.float64)
        symmetric: Float64[np.ndarray, "n n"] = 0.5 * (matrix + matrix.T)
        if self.kind == "rank":
            symmetric = 2.0 * np.sin(np.pi / 6.0 * symmetric)
        elif self.kind == "covariance":
            standard_deviations = np.sqrt(np.diag(symmetric))
            symmetric = symmetric / standard_deviations[:, None] / standard_deviations
        np.fill_diagonal(symmetric, 1.0)
        return symmetric

    @cached_property
    def factor(self) -> Float64[np.ndarray, "n n"]:
        """Lower triangular L with L L^T = R."""
        return np.asarray(np.linalg.cholesky(self.normal_correlation))
