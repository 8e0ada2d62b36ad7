"""Groups of correlated dispersions: by a covariance, a correlation or a rank correlation.

All three are one Gaussian copula (Nelsen, An Introduction to Copulas, 2006, section 2.3). The independent uniform
numbers u of the members become normal, z = Phi^-1(u). The normals are mixed, z' = L z with the Cholesky factor
L L^T = R of their correlation. Phi(z') replaces u. Every member keeps its distribution for any R. As L is lower
triangular, the first member draws as it would alone, and a member added at the end changes no earlier one.

- ``covariance`` and ``correlation`` (Pearson's) are for normal dispersions without truncation, whose draws are exactly
  multivariate normal: R is the correlation itself. A covariance also states the standard deviations.
- ``rank`` (Spearman's) is for any continuous dispersions: R = 2 sin(pi/6 rank), exactly (Kruskal 1958, J. Am. Stat.
  Assoc. 53, 814-861; ranks do not depend on the marginals).
"""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Self

import numpy as np
from jaxtyping import Float64
from pydantic import Field, model_validator

from marsyard.sim.parameters import Parameters

_Matrix = tuple[tuple[Annotated[float, Field(strict=True, allow_inf_nan=False)], ...], ...]
#: Relative tolerance of symmetry: files state rounded numbers.
_ROUNDING = 1e-9
#: Minimum eigenvalue of a correlation; below it, members are numerically functions of one another.
_MIN_EIGENVALUE = 1e-10

KINDS = ("covariance", "correlation", "rank")


class Correlation(Parameters):
    """Dispersed parameters that are drawn together, with one matrix in their order."""

    parameters: Annotated[tuple[str, ...], Field(min_length=1, max_length=200)]
    covariance: _Matrix | None = None
    correlation: _Matrix | None = None
    rank: _Matrix | None = None
    source: str = ""

    @model_validator(mode="after")
    def _check_statement(self) -> Self:
        given = [name for name in KINDS if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"one of {', '.join(KINDS)} is needed, got {', '.join(given) or 'none'}")
        repeated = sorted({name for name in self.parameters if self.parameters.count(name) > 1})
        if repeated:
            raise ValueError(f"named twice: {', '.join(repeated)}")
        rows, size = getattr(self, self.kind), len(self.parameters)
        if len(rows) != size or any(len(row) != size for row in rows):
            raise ValueError(f"{self.kind} must have {size} rows of {size} numbers, one for each parameter")
        self._check(self._matrix)
        return self

    def _check(self, matrix: Float64[np.ndarray, "n n"]) -> None:
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
        smallest = float(np.linalg.eigvalsh(normals)[0]) if np.isfinite(normals).all() else float("nan")
        if not smallest > _MIN_EIGENVALUE:
            raise ValueError(
                f"{self.kind} is not valid for a group: the normals' correlation, of least eigenvalue {smallest:.3g}, "
                "is not positive definite"
            )

    @property
    def kind(self) -> str:
        """Name of the matrix that is stated."""
        return next(name for name in KINDS if getattr(self, name) is not None)

    @property
    def _matrix(self) -> Float64[np.ndarray, "n n"]:
        return np.array(getattr(self, self.kind), dtype=np.float64)

    @property
    def normal_correlation(self) -> Float64[np.ndarray, "n n"]:
        """Correlation R of the normal numbers behind the draws."""
        matrix = self._matrix
        symmetric: Float64[np.ndarray, "n n"] = 0.5 * (matrix + matrix.T)
        if self.kind == "rank":
            symmetric = 2.0 * np.sin(np.pi / 6.0 * symmetric)
        elif self.kind == "covariance":
            sd = np.sqrt(np.diag(symmetric))
            symmetric = symmetric / sd[:, None] / sd
        np.fill_diagonal(symmetric, 1.0)
        return symmetric

    @cached_property
    def factor(self) -> Float64[np.ndarray, "n n"]:
        """Lower triangular L with L L^T = R."""
        lower: Float64[np.ndarray, "n n"] = np.linalg.cholesky(self.normal_correlation)
        return lower

    def standard_deviation(self, parameter: str) -> float | None:
        """Standard deviation of a member where the group states a covariance; None otherwise."""
        if self.covariance is None or parameter not in self.parameters:
            return None
        index = self.parameters.index(parameter)
        return float(np.sqrt(self.covariance[index][index]))
