"""Triple of each case of the field test."""

from marsyard.scenarios.fieldtest.parameters import FieldTestParameters


def find_triple(p: FieldTestParameters, case: int) -> tuple[int, int]:
    """Return the indices of a case's run and triple. Raises ValueError if the case does not exist."""
    total = sum(run.triples for run in p.runs)
    if case >= total:
        raise ValueError(f"case {case} does not exist: the runs define {total} triples; allowed: 0 to {total - 1}")
    return case_order(p)[case]


def case_order(p: FieldTestParameters) -> list[tuple[int, int]]:
    """Return the run and triple of each case.

    Triple k of the n triples of a category has the rank (k + 0.5) / n. Sorting by rank mixes all runs and categories in
    proportion, so that any number of first cases is representative.
    """
    ranks = []
    for number, run in enumerate(p.runs):
        start = 0
        for count in (run.short_time, run.same_direction, run.opposite_direction):
            ranks += [((index + 0.5) / count, number, start + index) for index in range(count)]
            start += count
    return [(number, index) for _, number, index in sorted(ranks)]
