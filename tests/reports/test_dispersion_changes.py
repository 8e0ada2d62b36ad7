"""Tests of changes of dispersions: sizes of a change in mean and standard deviation, for each kind of distribution."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm, truncnorm

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.reports.dispersion_changes import Change, ChangeKind, DispersedQuantity

DISPERSION = """
name = "changes"
scenario = "tests.campaigns.studies.limit_state:LimitStateScenario"
cases = 10
seed = 3

[dispersions]
"loads.0" = {distribution}
{others}
"""


def quantity_of(folder: Path, distribution: str, others: str = "") -> DispersedQuantity:
    """Return the quantity of a dispersion."""
    path = folder / "campaign.toml"
    path.write_text(DISPERSION.format(distribution=distribution, others=others))
    return DispersedQuantity.of(load_campaign(str(path)), "loads.0", 0)


def sizes_of(quantity: DispersedQuantity, kind: ChangeKind, change: float) -> float:
    """Return the size of a shift of z, or of a change of its standard deviation."""
    sizes = quantity.sizes(Change(kind, np.array([0.0, change]), np.ones((2, 1)), np.ones(2)))
    assert sizes is not None
    return float(sizes[1])


def test_sizes_of_a_bounded_dispersion_are_those_of_its_mean_and_spread(tmp_path: Path) -> None:
    """Phi(z) has the mean Phi(d / sqrt(2)) for N(d, 1), and the variance asin(s^2 / (1 + s^2)) / 2 pi for N(0, s^2).

    A shift of 2 is one of 1.46 standard deviations, and a factor of 1.3 one of 1.14: PASS must not be claimed for more.
    """
    uniform = quantity_of(tmp_path, '{ distribution = "uniform", low = -3.0, high = 7.0 }')
    assert uniform.declared == pytest.approx((2.0, 10.0 / math.sqrt(12.0)), rel=1e-5)
    mean = (norm.cdf(2.0 / math.sqrt(2.0)) - 0.5) * math.sqrt(12.0)
    assert sizes_of(uniform, ChangeKind.MEAN_UP, 2.0) == pytest.approx(mean, rel=1e-4)
    assert sizes_of(uniform, ChangeKind.MEAN_DOWN, 2.0) == pytest.approx(mean, rel=1e-4)
    for kind, scale in ((ChangeKind.WIDER, 1.3), (ChangeKind.NARROWER, 0.6)):
        deviation = math.sqrt(12.0 * math.asin(scale**2 / (1.0 + scale**2)) / (2.0 * math.pi))
        assert sizes_of(uniform, kind, abs(scale - 1.0)) == pytest.approx(abs(deviation - 1.0), rel=1e-4)


def test_sizes_of_a_normal_dispersion_are_those_of_z(tmp_path: Path) -> None:
    normal = quantity_of(tmp_path, '{ distribution = "normal", mean = 4.0, sd = 0.1 }')
    assert normal.declared == pytest.approx((4.0, 0.1), rel=1e-6)
    for kind, size in (
        (ChangeKind.MEAN_UP, 1.3),
        (ChangeKind.MEAN_DOWN, 0.2),
        (ChangeKind.WIDER, 0.4),
        (ChangeKind.NARROWER, 0.9),
    ):
        assert sizes_of(normal, kind, size) == pytest.approx(size, rel=1e-5)


def test_sizes_of_truncated_discrete_and_heavy_tailed_dispersions(tmp_path: Path) -> None:
    """Moments of SciPy's distributions; the sizes are those of integrals over the shifted density."""
    truncated = quantity_of(tmp_path, '{ distribution = "normal", mean = 1.0, sd = 2.0, truncate = [0.0, 2.0] }')
    exact = truncnorm(-0.5, 0.5, loc=1.0, scale=2.0)
    assert truncated.declared == pytest.approx((exact.mean(), exact.std()), rel=1e-4)
    counts = quantity_of(tmp_path, '{ distribution = "poisson", mu = 2.0 }')
    # jumps between two nodes, 0.01 apart, have an error of 0.2 % of the density
    assert counts.declared == pytest.approx((2.0, math.sqrt(2.0)), rel=3e-3)
    lognormal = quantity_of(tmp_path, '{ distribution = "lognorm", s = 1.0 }')
    assert lognormal.declared == pytest.approx((math.exp(0.5), math.exp(0.5) * math.sqrt(math.e - 1.0)), rel=1e-4)
    # exp(z + d) has the mean exp(d + 1 / 2)
    assert sizes_of(lognormal, ChangeKind.MEAN_UP, 0.5) == pytest.approx(
        math.expm1(0.5) / math.sqrt(math.e - 1.0), rel=1e-4
    )
    cauchy = quantity_of(tmp_path, '{ distribution = "cauchy" }')
    assert np.isnan(cauchy.declared).all()
    assert sizes_of(cauchy, ChangeKind.MEAN_UP, 0.7) == 0.7
    # scaling z does not change two values with equal probabilities
    coin = quantity_of(tmp_path, '{ distribution = "bernoulli", p = 0.5 }')
    assert coin.sizes(Change(ChangeKind.WIDER, np.array([0.0, 0.2]), np.ones((2, 1)), np.ones(2))) is None


def test_sizes_of_a_formula_are_those_of_one_case(tmp_path: Path) -> None:
    """A uniform range around another load: relative sizes are those of any uniform range, absolute ones are unknown."""
    formula = '{ distribution = "uniform", low = "loads[1] - 2.0", high = "loads[1] + 2.0" }'
    other = '"loads.1" = { distribution = "normal", mean = 50.0, sd = 3.0 }'
    quantity = quantity_of(tmp_path, formula, other)
    assert not quantity.is_absolute
    mean = (norm.cdf(2.0 / math.sqrt(2.0)) - 0.5) * math.sqrt(12.0)
    assert sizes_of(quantity, ChangeKind.MEAN_UP, 2.0) == pytest.approx(mean, rel=1e-4)
