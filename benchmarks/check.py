"""Detect hot paths that became slower since an earlier version: ``python -m benchmarks.check [--keep]``.

A hot path is code that takes a large part of the processor time (docs/performance.md). Its runs alternate with runs of
a reference workload (matrix products, filters, sorting, copies), so that a slow or busy machine affects both. A ratio
is the processor time of a run divided by that of the reference workload. Welch's test compares the logarithms of the
ratios with those that an earlier version stored (``--keep``). A hot path is slower if its mean ratio has grown by more
than the factor `ALLOWED_GROWTH`. The false alarm rate is `FALSE_ALARM_RATE` for all hot paths together. Ratios are
valid for one type of processor; the file contains those of each type on which an earlier version was measured.
"""

import argparse
import datetime as dt
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy import stats

from benchmarks import hda
from benchmarks.engine import measure_table_s
from benchmarks.estimators import simulate_descents
from benchmarks.images import prepare_descent_exposure
from benchmarks.timing import elapsed_seconds
from benchmarks.vtt import prepare_update
from marsyard.algorithms.dimes import DimesEstimator
from marsyard.algorithms.hda import ElevationMap, HdaEstimator, HdaOptions, hazard_maps
from marsyard.sim.kernel_cache import processor_features

#: File of the stored ratios, by processor.
RATIOS = Path(__file__).parent / "results" / "ratios.json"
#: Number of runs of each hot path; each run is paired with runs of the reference workload.
PAIRS = 15
#: Accepted growth of a ratio, as a factor: memory and caches are shared with other programs.
ALLOWED_GROWTH = 1.15
#: Probability that at least one hot path of an unchanged program is reported as slower.
FALSE_ALARM_RATE = 0.01


def _prepare_dimes() -> Callable[[], object]:
    """Return a function that runs DIMES on a rendered descent."""
    measurements, estimator = simulate_descents("dimes-smoke", 1)[0].measurements, DimesEstimator()
    return lambda: estimator.estimate(measurements)


def _prepare_dense_map() -> Callable[[], object]:
    """Return a function that runs hazard detection with a grid of 160 x 120 points."""
    measurements, estimator = hda.make_measurements(), HdaEstimator(hda.DENSE)
    return lambda: estimator.estimate(measurements)


def _prepare_hazard_maps() -> Callable[[], object]:
    """Return a function that computes the hazard maps of rough random ground with cells of 0.1 m."""
    elevation_m = 0.02 * np.random.default_rng(1).standard_normal((256, 256))
    ground = ElevationMap(elevation_m, np.zeros(2), 0.1)
    return lambda: hazard_maps(ground, HdaOptions())


#: Hot paths by name: each function prepares the inputs and returns a function that runs the hot path once.
HOT_PATHS: Mapping[str, Callable[[], Callable[[], object]]] = {
    "descent image with detector": prepare_descent_exposure,
    "DIMES, three images": _prepare_dimes,
    "target tracking, an update": prepare_update,
    "HDA, 160 x 120 points": _prepare_dense_map,
    "hazard maps of 256 x 256": _prepare_hazard_maps,
    "table of 20,000 rows": lambda: lambda: measure_table_s(20_000),
}


def reference_workload() -> Callable[[], object]:
    """Return the reference workload, which takes some milliseconds."""
    rng = np.random.default_rng(0)
    matrix = rng.standard_normal((300, 300))
    image = rng.standard_normal((1024, 1024)).astype(np.float32)
    values = rng.standard_normal(200_000)

    def run() -> None:
        matrix @ matrix
        cv2.GaussianBlur(image, (0, 0), 2.0)
        np.sort(values)
        image.copy()

    return run


def log_ratios(hot_path: Callable[[], object], reference: Callable[[], object], runs: int) -> list[float]:
    """Return, for each run, the log of its time divided by the mean time of the reference before and after it."""
    hot_path()
    ratios, before = [], elapsed_seconds(reference)
    for _ in range(runs):
        elapsed, after = elapsed_seconds(hot_path), elapsed_seconds(reference)
        ratios.append(float(np.log(elapsed / (0.5 * (before + after)))))
        before = after
    return ratios


@dataclass(frozen=True)
class Comparison:
    """Growth of a hot path's mean ratio, as a factor, and p-value of the hypothesis of at most the accepted growth."""

    name: str
    growth: float
    p_value: float


def compare(current: Mapping[str, Sequence[float]], stored: Mapping[str, Sequence[float]]) -> list[Comparison]:
    """Compare the log ratios of every hot path that both records contain."""
    comparisons = []
    for name in current.keys() & stored.keys():
        ratios, stored_ratios = np.asarray(current[name]), np.asarray(stored[name])
        test = stats.ttest_ind(ratios - np.log(ALLOWED_GROWTH), stored_ratios, equal_var=False, alternative="greater")
        comparisons.append(Comparison(name, float(np.exp(ratios.mean() - stored_ratios.mean())), float(test.pvalue)))
    return sorted(comparisons, key=lambda comparison: comparison.name)


def select_slower(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """Select the hot paths that exceed the accepted growth, with Bonferroni's correction."""
    return [comparison for comparison in comparisons if comparison.p_value < FALSE_ALARM_RATE / len(comparisons)]


def main() -> int:
    """Measure, then store or compare. Returns 1 if a hot path is slower, 2 without stored ratios of this processor."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.check", description=__doc__)
    parser.add_argument("--keep", action="store_true", help="store these ratios for later comparisons")
    keep = parser.parse_args().keep
    records = json.loads(RATIOS.read_text()) if RATIOS.exists() else {}
    processor = processor_features()
    if not keep and processor not in records:
        print(
            f"no ratios are stored of this processor, {processor} (stored: {', '.join(records) or 'none'}): "
            "run 'python -m benchmarks.check --keep' on the version to compare with",
            file=sys.stderr,
        )
        return 2
    cv2.setNumThreads(1)
    reference = reference_workload()
    ratios = {name: log_ratios(prepare(), reference, PAIRS) for name, prepare in HOT_PATHS.items()}
    if keep:
        measured = dt.datetime.now(dt.UTC).isoformat(timespec="seconds")
        records[processor] = {"measured": measured, "log_ratios": ratios}
        RATIOS.write_text(json.dumps(records, indent=2) + "\n")
        print(f"stored in {RATIOS}")
        return 0
    stored = records[processor]
    return _print_comparison(compare(ratios, stored["log_ratios"]), stored["measured"])


def _print_comparison(comparisons: Sequence[Comparison], date: str) -> int:
    """Print the comparison. Returns 1 if a hot path is slower."""
    slower = select_slower(comparisons)
    print(f"{'ratio divided by that of ' + date[:10]:<40}{'factor':>8}{'p':>10}")
    for comparison in comparisons:
        mark = "  SLOWER" if comparison in slower else ""
        print(f"{comparison.name:<40}{comparison.growth:8.2f}{comparison.p_value:10.2g}{mark}")
    return 1 if slower else 0


if __name__ == "__main__":
    raise SystemExit(main())
