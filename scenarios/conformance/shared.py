"""Checks that estimators, trackers and parts share."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np

from marsyard.scenarios.conformance.findings import BreachError, Check
from marsyard.scenarios.conformance.process import OPEN, WATCHER, closed_imports, surroundings
from marsyard.scenarios.estimators import sources_of

_ADVICE_PROCESS = "put back what you change, or do not change it: later cases run in the same process"
COPIES = "work on copies: counts.astype(...), array.copy()"
_ADVICE_TRUTH = f"use what you are handed; of sim import {', '.join(OPEN)} only"


#: Makes what is watched: an algorithm with what it is handed; called, it answers.
Prepared = Callable[[], Callable[[], object]]


def process_checks(spec: str, prepared: Prepared) -> Iterator[Check]:
    """What an algorithm that runs in our process must leave alone there: its surroundings, and the truth."""
    yield process_check(prepared)
    yield Check("truth", "reaches for no truth", _ADVICE_TRUTH, partial(_reaches_for_no_truth, spec, prepared))


def process_check(prepared: Prepared) -> Check:
    """That what runs in our process leaves it as it is."""
    return Check("process", "leaves its process as it is", _ADVICE_PROCESS, partial(_leaves_its_process, prepared))


def _leaves_its_process(prepared: Prepared) -> str:
    answer = prepared()
    before = surroundings()
    answer()
    return _changed(before, surroundings())


def _changed(before: Mapping[str, object], after: Mapping[str, object]) -> str:
    """Raises BreachError where surroundings are not what they were."""
    different = [name for name in before if before[name] != after[name]]
    if different:
        raise BreachError(f"it has changed {', '.join(different)}")
    return ""


def _reaches_for_no_truth(spec: str, prepared: Prepared) -> str:
    found = closed_imports(spec)
    if found:
        raise BreachError(f"it imports what knows the truth: {'; '.join(found[:5])}")
    answer = prepared()
    with WATCHER.looking(frozenset(str(path) for _, path in sources_of(spec))) as seen:
        answer()
    if seen:
        raise BreachError("; ".join(seen))
    return ""


def seed_global_generators(seed: int) -> None:
    """Sets the generators that everyone in the process shares, for what draws from them by mistake."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
