"""Tests of failure boundaries (fitted probability of a violation): true probabilities, and fits without skill."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.special import expit

from marsyard.reports.failure_boundary import boundary_section, fit_probability, validate_fit
from tests.reports.synthetic_run import make_subject

CONDITIONS = ("sun_elevation_deg", "off_nadir_max_deg")
REQUIREMENT = {"id": "VEL", "metric": "velocity_error_m_s", "bound": 5.0, "population": "all"}


def true_probability(sun_deg: np.ndarray, off_nadir_deg: np.ndarray) -> np.ndarray:
    """Return the probability of a violation: large for a low sun and a large off-nadir angle only."""
    return np.asarray(expit(0.5 * (30.0 - sun_deg)) * expit(0.5 * (off_nadir_deg - 15.0)))


def make_rows(n: int, seed: int, probability: Callable[..., np.ndarray] = true_probability) -> pd.DataFrame:
    rng = np.random.default_rng(seed)
    sun, off_nadir, rate = rng.uniform(20.0, 60.0, n), rng.uniform(0.0, 30.0, n), rng.uniform(0.0, 60.0, n)
    is_violation = rng.random(n) < probability(sun, off_nadir)
    return pd.DataFrame(
        {
            "case": np.arange(n), "outcome": "VALID", "answered": True, "terrain": rng.integers(0, 40, n),
            "velocity_error_m_s": np.where(is_violation, 9.0, 1.0), "sun_elevation_deg": sun,
            "off_nadir_max_deg": off_nadir, "attitude_rate_max_deg_s": rate,
        }
    )  # fmt: skip


def make_section(frame: pd.DataFrame) -> Any:
    return boundary_section(make_subject(frame, "velocity_error_m_s", 5.0, requirements=[REQUIREMENT]))


def test_boundary_of_two_true_conditions_is_drawn() -> None:
    section = make_section(make_rows(800, seed=1))
    (fit,) = section.data["VEL"]
    assert set(fit["conditions"]) == set(CONDITIONS)
    assert fit["drawn"]
    assert fit["skill_lower"] > 0.3
    assert len(section.blocks[0].figures) == 1
    assert section.blocks[0].grid.rows[0][-1] == "yes"  # column: boundary drawn


def test_fitted_probability_is_close_to_the_true_one() -> None:
    rows = make_rows(2000, seed=2)
    points = rows[list(CONDITIONS)].to_numpy()
    probability = fit_probability(points, rows["velocity_error_m_s"].to_numpy() > 5.0)
    rng = np.random.default_rng(3)
    sun, off_nadir = rng.uniform(22.0, 58.0, 1000), rng.uniform(2.0, 28.0, 1000)
    errors = probability(np.stack([sun, off_nadir], axis=1)) - true_probability(sun, off_nadir)
    assert np.sqrt(np.mean(errors**2)) < 0.05


def test_condition_that_few_terrains_have_is_validated_over_cases() -> None:
    frame = make_rows(800, seed=1)
    frame.loc[frame["terrain"] >= 4, "sun_elevation_deg"] = np.nan
    sun = frame["sun_elevation_deg"].fillna(40.0)
    frame["velocity_error_m_s"] = np.where(sun + frame["off_nadir_max_deg"] < 55.0, 9.0, 1.0)
    # four terrains are fewer than the folds of the cross-validation
    (fit,) = make_section(frame).data["VEL"]
    assert fit["cases"] == (frame["terrain"] < 4).sum()


def test_violations_without_a_cause_have_no_boundary() -> None:
    section = make_section(make_rows(800, seed=4, probability=lambda sun, _: np.full(sun.size, 0.2)))
    assert section is None


def test_fit_that_only_recognizes_terrains_has_no_skill() -> None:
    """Each terrain has its own sun and violates always or never: the fit does not apply to other terrains."""
    rng = np.random.default_rng(5)
    terrain = rng.integers(0, 30, 900)
    sun_of_terrain, violates = rng.uniform(20.0, 60.0, 30), rng.random(30) < 0.5
    values = np.stack([sun_of_terrain[terrain], rng.uniform(0.0, 30.0, 900)], axis=1)
    fit = validate_fit(values, violates[terrain], terrain, CONDITIONS)
    assert not fit.is_good
    independent_cases = validate_fit(values, violates[terrain], np.arange(900), CONDITIONS)
    assert independent_cases.skill > fit.skill + 0.1


@pytest.mark.parametrize("frame", [make_rows(60, seed=6), make_rows(800, seed=1).drop(columns="velocity_error_m_s")])
def test_few_violations_or_missing_columns_have_no_boundary(frame: pd.DataFrame) -> None:
    frame.loc[:, "off_nadir_max_deg"] = 1.0
    assert make_section(frame) is None
