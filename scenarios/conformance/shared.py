"""Checks that estimators and trackers share."""

from __future__ import annotations

import random
from collections.abc import Mapping

import numpy as np

from scenarios.conformance.findings import BreachError
from scenarios.conformance.process import OPEN, closed_imports

ADVICE_PROCESS = "put back what you change, or do not change it: later cases run in the same process"
COPIES = "work on copies: counts.astype(...), array.copy()"
ADVICE_TRUTH = f"use what you are handed; of sim import {', '.join(OPEN)} only"


def changed(before: Mapping[str, object], after: Mapping[str, object]) -> str:
    """Raises BreachError where surroundings are not what they were."""
    different = [name for name in before if before[name] != after[name]]
    if different:
        raise BreachError(f"it has changed {', '.join(different)}")
    return ""


def seed_global_generators(seed: int) -> None:
    """Sets the generators that everyone in the process shares, for what draws from them by mistake."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002


def imports_nothing_closed(spec: str) -> None:
    """Raises BreachError where sources import what knows the truth."""
    found = closed_imports(spec)
    if found:
        raise BreachError(f"it imports what knows the truth: {'; '.join(found[:5])}")
