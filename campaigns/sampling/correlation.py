"""Correlated groups of dispersions, coupled by a Gaussian copula.

A group is defined by a covariance, a correlation or a rank correlation. In all three cases the copula couples its
members (Nelsen, An Introduction to Copulas, 2006, section 2.3). Independent uniform numbers u are converted to normal
numbers z = Phi^-1(u). The product z' = L z with a Cholesky factor L has the correlation R = L L^T. Phi(z') then
replaces u. The distribution of each member does not depend on R. Since L is lower triangular, a member that is added at
the end of a group does not change the numbers of the other members.

- ``covariance`` and ``correlation`` (Pearson's) are for normal dispersions without truncation, whose draws are exactly
  multivariate normal: R is the correlation itself. A covariance also defines the standard deviations.
- ``rank`` (Spearman's) is for any continuous dispersions: R = 2 sin(pi/6 rank), exactly (Kruskal 1958, J. Am. Stat.
  Assoc. 53, 814-861; ranks do not depend on the marginals).
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Annotated, NamedTuple, Self

import numpy as np
from jaxtyping import Float64
from pydantic import Field, model_validator
from scipy.special import ndtr, ndtri

from marsyard.sim.parameters import Parameters

#: Minimum draw, half the step 2**-53 of `Generator.random`, since unbounded distributions have no value at 0.
MIN_DRAW = 2.0**-54
#: Maximum draw, the largest float below 1.
MAX_DRAW = 1.0 - 2.0**-53
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


class CorrelatedGroup(NamedTuple):
    """Indices of a correlated group's members among the dispersions, and the rows of its factor L (hashable)."""

    members: tuple[int, ...]
    factor: tuple[tuple[float, ...], ...]


def correlate_uniform(
    uniform: Float64[np.ndarray, "*cases members"], factor: Float64[np.ndarray, "members members"]
) -> Float64[np.ndarray, "*cases members"]:
    """Correlate independent uniform numbers u of a group: Phi(L Phi^-1(u)) with the factor L."""
    return np.asarray(np.clip(ndtr(ndtri(uniform) @ factor.T), MIN_DRAW, MAX_DRAW))


def correlate_groups(uniform: Mapping[str, float], groups: Sequence[Correlation]) -> dict[str, float]:
    """Replace the independent uniform numbers of the members of groups, by parameter path, by correlated numbers."""
    numbers = dict(uniform)
    for group in groups:
        correlated = correlate_uniform(np.array([uniform[path] for path in group.parameters]), group.factor)
        numbers.update(zip(group.parameters, correlated.tolist(), strict=True))
    return numbers
