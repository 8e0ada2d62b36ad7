"""The velocity estimators that campaign files can name: those that ship with Marsyard, and a user's own."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Mapping
from typing import cast

from algorithms.dimes import DimesEstimator, DimesOptions
from algorithms.interface import VelocityEstimator

#: Where each estimator's class is found; it is made without arguments, but for DIMES, which takes its options.
ESTIMATORS: Mapping[str, str] = {
    "dimes": "algorithms.dimes:DimesEstimator",
    "phase-correlation": "algorithms.baselines:PhaseCorrelationEstimator",
    "homography": "algorithms.baselines:HomographyEstimator",
}


def velocity_estimator(name: str, dimes: DimesOptions) -> VelocityEstimator:
    """The estimator of a name, or of a path ``module:Class`` to a class that implements `VelocityEstimator`.

    Raises ValueError where there is none.
    """
    kind = _found(name)
    return DimesEstimator(dimes) if kind is DimesEstimator else kind()


def check_estimator(name: str) -> None:
    """Raises ValueError where there is no estimator of this name; the message says what is allowed."""
    _found(name)


def _found(name: str) -> type[VelocityEstimator]:
    path = name if ":" in name else ESTIMATORS.get(name)
    if path is None:
        near = difflib.get_close_matches(name, ESTIMATORS, n=1)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        allowed = ", ".join(ESTIMATORS)
        raise ValueError(f"unknown algorithm '{name}'{hint}; allowed: {allowed}, or your own as 'module:Class'")
    module, _, kind = path.partition(":")
    try:
        found = getattr(importlib.import_module(module), kind)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"no algorithm at '{path}': {error}") from error
    if not hasattr(found, "estimate"):
        raise ValueError(f"'{path}' is no velocity estimator: it has no method 'estimate'")
    return cast("type[VelocityEstimator]", found)
