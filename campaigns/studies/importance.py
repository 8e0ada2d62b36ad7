"""Importance sampling around known violations: cases are drawn where violations occur, and weighted.

Cases are points in standard normal space, so their nominal density is the standard normal one. The sampling density is
a mixture of the nominal density and of normal densities of unit variance at the centres of clusters of violations
(Melchers 1989, Structural Safety 6, 3-10). A tenth of the cases come from the nominal density: weights are below ten.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.cluster.vq import kmeans2
from scipy.special import logsumexp

from marsyard.campaigns.studies.subset import Coordinates

#: Fraction of the cases that are drawn from the nominal density.
NOMINAL_FRACTION = 0.1
#: Maximum cosine of the angle between the directions of two clusters.
_MAX_COSINE = 0.5
#: Maximum number of clusters, and minimum number of violations of a cluster.
_MAX_CLUSTERS, _MIN_VIOLATIONS = 4, 10


@dataclass(frozen=True)
class ImportanceDensity:
    """Sampling density in standard normal space: fractions and centres of the shifted densities."""

    fractions: Float64[np.ndarray, " clusters"]
    centres: Float64[np.ndarray, "clusters dimensions"]

    def draw(self, n: int, rng: np.random.Generator) -> tuple[Coordinates, Float64[np.ndarray, " n"]]:
        """Draw n cases; return their coordinates and weights (nominal density divided by sampling density)."""
        coordinates = rng.standard_normal((n, self.centres.shape[1]))
        shifted_cases = np.flatnonzero(rng.random(n) >= NOMINAL_FRACTION)
        clusters = rng.choice(len(self.fractions), shifted_cases.size, p=self.fractions)
        coordinates[shifted_cases] += self.centres[clusters]
        # phi(z - c) / phi(z) = exp(z c - c^2 / 2) for the standard normal density phi and the centre c
        log_ratios = coordinates @ self.centres.T - 0.5 * np.sum(self.centres**2, axis=1)
        log_mixture_ratio = logsumexp(log_ratios, axis=1, b=self.fractions)
        return coordinates, 1.0 / (NOMINAL_FRACTION + (1.0 - NOMINAL_FRACTION) * np.exp(log_mixture_ratio))


def fit_density(violations: Coordinates) -> ImportanceDensity | None:
    """Fit the sampling density to violations; None if they are too few, or do not differ from the nominal density.

    The violations come from Markov chains, so points of one chain are close to each other. Clusters must therefore
    differ in direction.
    """
    distinct = np.unique(violations, axis=0)
    density = None
    for clusters in range(1, min(_MAX_CLUSTERS, len(distinct) // _MIN_VIOLATIONS) + 1):
        _, labels = kmeans2(distinct, clusters, minit="++", rng=np.random.default_rng(0))
        sizes = np.bincount(labels, minlength=clusters)
        if np.any(sizes == 0):
            break
        means = np.array([distinct[labels == cluster].mean(axis=0) for cluster in range(clusters)])
        norms = np.linalg.norm(means, axis=1)
        if np.any(norms == 0.0):
            break
        cosines = (means @ means.T / np.outer(norms, norms))[~np.eye(clusters, dtype=bool)]
        if np.any(cosines > _MAX_COSINE):
            break
        density = ImportanceDensity(sizes / len(distinct), means)
    return density
