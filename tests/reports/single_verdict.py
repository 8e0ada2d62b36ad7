"""Rows and evaluation of one requirement, for the tests of verdicts."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.verdicts import Verdict


def make_cases(n: int, failures: int, *, error: float = 6.0) -> pd.DataFrame:
    """Return cases with one terrain per case; the errors of the first `failures` cases exceed the bound of 5 m/s."""
    errors = np.where(np.arange(n) < failures, error, 1.0)
    return pd.DataFrame(
        {
            "case": np.arange(n),
            "outcome": "VALID",
            "answered": True,
            "velocity_error_m_s": errors,
            "terrain": np.arange(n),
        }
    )


def evaluate(frame: pd.DataFrame, requirement: Mapping[str, Any], **changes: Any) -> Verdict:
    (verdict,) = evaluate_requirements(frame, [{**requirement, **changes}])
    return verdict
