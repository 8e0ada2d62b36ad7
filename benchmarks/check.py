"""Detect hot paths that are slower than their stored ratios: ``python -m benchmarks.check [--keep]``.

Each path alternates with a reference workload of the same kinds of operations (matrix products, filters, sorting,
copies), so that a slow or busy machine affects both. Welch's test compares the logarithms of their ratios with the
stored ones. A path is slower if its mean ratio has grown by more than `ALLOWED`, with a false alarm rate of
`FALSE_ALARMS` for all paths together. Ratios are valid for one type of processor.
"""

from __future__ import annotations

import argparse
import datetime as dt
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy import stats

from benchmarks import hda
from benchmarks.engine import table_seconds
from benchmarks.estimators import record_descents
from benchmarks.pictures import descent_exposure
from benchmarks.vtt import seeded_update
from marsyard.algorithms.dimes import DimesEstimator
from marsyard.algorithms.hda import ElevationMap, HdaEstimator, HdaOptions, hazard_maps
from marsyard.sim.kernel_cache import processor_features

RATIOS = Path(__file__).parent / "results" / "ratios.json"
#: Pairs of runs of a path and the reference workload.
PAIRS = 15
#: Growth of a ratio that is accepted, because memory and caches are shared with other programs.
ALLOWED = 1.15
#: Probability that any path of an unchanged program is reported.
FALSE_ALARMS = 0.01


def _dimes() -> Callable[[], object]:
    measurements, estimator = record_descents("dimes-smoke", 1)[0].measurements, DimesEstimator()
    return lambda: estimator.estimate(measurements)


def _dense_map() -> Callable[[], object]:
    given, estimator = hda.measurements(), HdaEstimator(hda.DENSE)
    return lambda: estimator.estimate(given)


def _hazards() -> Callable[[], object]:
    rough = 0.02 * np.random.default_rng(1).standard_normal((256, 256))
    ground = ElevationMap(rough, np.zeros(2), 0.1)
    return lambda: hazard_maps(ground, HdaOptions())


#: Functions that prepare each path for repeated runs, by name.
PATHS: Mapping[str, Callable[[], Callable[[], object]]] = {
    "descent picture with detector": descent_exposure,
    "DIMES, a triple": _dimes,
    "target tracking, an update": seeded_update,
    "HDA, 160 x 120 points": _dense_map,
    "hazard maps of 256 x 256": _hazards,
    "table of 20,000 rows": lambda: lambda: table_seconds(20_000),
}


def reference_workload() -> Callable[[], object]:
    """Return a workload of about 30 ms."""
    rng = np.random.default_rng(0)
    matrix = rng.standard_normal((300, 300))
    picture = rng.standard_normal((1024, 1024)).astype(np.float32)
    values = rng.standard_normal(200_000)

    def work() -> None:
        matrix @ matrix
        cv2.GaussianBlur(picture, (0, 0), 2.0)
        np.sort(values)
        picture.copy()

    return work


def log_ratios(path: Callable[[], object], reference: Callable[[], object], pairs: int) -> list[float]:
    """Logarithm of the path's processor time over the mean reference time before and after it, for each pair."""
    path()
    found, before = [], _seconds(reference)
    for _ in range(pairs):
        taken, after = _seconds(path), _seconds(reference)
        found.append(float(np.log(taken / (0.5 * (before + after)))))
        before = after
    return found


def _seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


@dataclass(frozen=True)
class Comparison:
    """A path compared with its stored ratio: the factor of its growth, and the p-value without growth."""

    name: str
    times: float
    p_value: float


def compare(now: Mapping[str, Sequence[float]], kept: Mapping[str, Sequence[float]]) -> list[Comparison]:
    """Compare every path that both records contain."""
    regressions = []
    for name in now.keys() & kept.keys():
        ours, before = np.asarray(now[name]), np.asarray(kept[name])
        test = stats.ttest_ind(ours - np.log(ALLOWED), before, equal_var=False, alternative="greater")
        regressions.append(Comparison(name, float(np.exp(ours.mean() - before.mean())), float(test.pvalue)))
    return sorted(regressions, key=lambda one: one.name)


def select_slower(found: Sequence[Comparison]) -> list[Comparison]:
    """Select paths that exceed the accepted growth, with Bonferroni's correction."""
    return [one for one in found if one.p_value < FALSE_ALARMS / len(found)]


def main() -> int:
    """Measure, then store or compare. Returns 1 if a path is slower, 2 without stored ratios."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.check", description=__doc__)
    parser.add_argument("--keep", action="store_true", help="store these ratios for later comparisons")
    keep = parser.parse_args().keep
    kept = json.loads(RATIOS.read_text()) if RATIOS.exists() else None
    if not keep and (kept is None or kept["processor"] != processor_features()):
        reason = (
            "no ratios are stored"
            if kept is None
            else f"the stored ratios are of another processor, {kept['processor']}"
        )
        print(f"{reason}: run 'python -m benchmarks.check --keep' on the version to compare with", file=sys.stderr)
        return 2
    cv2.setNumThreads(1)
    reference = reference_workload()
    now = {name: log_ratios(make(), reference, PAIRS) for name, make in PATHS.items()}
    if keep:
        record = {
            "measured": dt.datetime.now(dt.UTC).isoformat(timespec="seconds"),
            "processor": processor_features(),
            "log_ratios": now,
        }
        RATIOS.write_text(json.dumps(record, indent=2) + "\n")
        print(f"kept in {RATIOS}")
        return 0
    assert kept is not None, "without kept ratios nothing is compared"
    return _print_comparison(compare(now, kept["log_ratios"]), kept["measured"])


def _print_comparison(found: Sequence[Comparison], measured: str) -> int:
    """Print the comparison. Returns 1 if a path is slower."""
    bad = select_slower(found)
    print(f"{'factor to the ratio of ' + measured[:10]:<40}{'times':>8}{'p':>10}")
    for one in found:
        print(f"{one.name:<40}{one.times:8.2f}{one.p_value:10.2g}{'  SLOWER' if one in bad else ''}")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
