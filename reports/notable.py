"""Which cases a reader wants pictures of: the worst, some without an answer, and some at random."""

from __future__ import annotations

import numpy as np

from marsyard.reports.columns import numbers, primary_metric
from marsyard.reports.populations import members
from marsyard.reports.stored import StoredRun

#: Cases of each kind.
OF_A_KIND = 2
#: The others are drawn from a fixed seed: the same rows give the same cases.
_SEED = 20260302


def notable_cases(run: StoredRun) -> list[int]:
    """Cases that came to their end: those of the largest errors, the first without one, and others at random."""
    rows = run.whole[members(run.whole, "completed")]
    metric = primary_metric(run.frame, run.requirements)
    if "case" not in rows or metric is None:
        return []
    cases, sizes = rows["case"].to_numpy(dtype=np.int64), np.abs(numbers(rows, metric))
    known = np.isfinite(sizes)
    kinds = (
        cases[known][np.argsort(-sizes[known], kind="stable")][:OF_A_KIND],
        cases[~known][:OF_A_KIND],
        cases[np.random.default_rng(_SEED).permutation(cases.size)],
    )
    chosen: dict[int, None] = {}
    for kind in kinds:
        chosen.update(dict.fromkeys([case for case in kind.tolist() if case not in chosen][:OF_A_KIND]))
    return list(chosen)
