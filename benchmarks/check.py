"""Whether a hot path is slower than when its ratios were last kept: ``python -m benchmarks.check [--keep]``.

Each path runs in turn with a yardstick, fixed work of the same kinds (products of matrices, filters, sorting, copies),
so that a slow or busy machine slows both. What is compared is the logarithm of their ratio, now and as kept, by
Welch's test: a path is called slower where its mean ratio has grown by more than `ALLOWED`, at a rate of false alarms
of `FALSE_ALARMS` for all paths together. Ratios belong to a kind of processor; on another they say nothing.
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
from benchmarks.estimators import recorded
from benchmarks.pictures import descent_exposure
from benchmarks.vtt import seeded_update
from marsyard.algorithms.dimes import DimesEstimator
from marsyard.algorithms.hda import ElevationMap, HdaEstimator, HdaOptions, hazard_maps
from marsyard.sim.processor import processor_features

RATIOS = Path(__file__).parent / "results" / "ratios.json"
#: Pairs of a path's run and the yardstick's.
PAIRS = 15
#: Growth of a ratio that is no regression yet: what memory and caches shared with others do to it.
ALLOWED = 1.15
#: Chance that any path of an unchanged program is called slower.
FALSE_ALARMS = 0.01


def _dimes() -> Callable[[], object]:
    measurements, estimator = recorded("dimes-smoke", 1)[0].measurements, DimesEstimator()
    return lambda: estimator.estimate(measurements)


def _dense_map() -> Callable[[], object]:
    given, estimator = hda.measurements(), HdaEstimator(hda.DENSE)
    return lambda: estimator.estimate(given)


def _hazards() -> Callable[[], object]:
    rough = 0.02 * np.random.default_rng(1).standard_normal((256, 256))
    ground = ElevationMap(rough, np.zeros(2), 0.1)
    return lambda: hazard_maps(ground, HdaOptions())


#: By name: what makes a path ready to be run, again and again.
PATHS: Mapping[str, Callable[[], Callable[[], object]]] = {
    "descent picture with detector": descent_exposure,
    "DIMES, a triple": _dimes,
    "target tracking, an update": seeded_update,
    "HDA, 160 x 120 points": _dense_map,
    "hazard maps of 256 x 256": _hazards,
    "table of 20,000 rows": lambda: lambda: table_seconds(20_000),
}


def yardstick() -> Callable[[], object]:
    """Fixed work of some 30 ms."""
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


def log_ratios(path: Callable[[], object], beside: Callable[[], object], pairs: int) -> list[float]:
    """Logarithm of the path's processor time over the mean of the yardstick's before and after it, for each pair."""
    path()
    found, before = [], _seconds(beside)
    for _ in range(pairs):
        taken, after = _seconds(path), _seconds(beside)
        found.append(float(np.log(taken / (0.5 * (before + after)))))
        before = after
    return found


def _seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


@dataclass(frozen=True)
class Comparison:
    """A path beside what was kept: how many times its ratio is the kept one, and the chance of that without growth."""

    name: str
    times: float
    p_value: float


def compared(now: Mapping[str, Sequence[float]], kept: Mapping[str, Sequence[float]]) -> list[Comparison]:
    """Every path that both have."""
    found = []
    for name in now.keys() & kept.keys():
        ours, before = np.asarray(now[name]), np.asarray(kept[name])
        test = stats.ttest_ind(ours - np.log(ALLOWED), before, equal_var=False, alternative="greater")
        found.append(Comparison(name, float(np.exp(ours.mean() - before.mean())), float(test.pvalue)))
    return sorted(found, key=lambda one: one.name)


def slower(found: Sequence[Comparison]) -> list[Comparison]:
    """Those that have grown beyond what is allowed; Bonferroni's correction for their number."""
    return [one for one in found if one.p_value < FALSE_ALARMS / len(found)]


def main() -> int:
    """Measures, then keeps or compares; 1 where a path is slower, 2 where there is nothing to compare with."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.check", description=__doc__)
    parser.add_argument("--keep", action="store_true", help="keep these ratios for later runs to be compared with")
    keep = parser.parse_args().keep
    kept = json.loads(RATIOS.read_text()) if RATIOS.exists() else None
    if not keep and (kept is None or kept["processor"] != processor_features()):
        said = (
            "no ratios are kept" if kept is None else f"the kept ratios are of another processor, {kept['processor']}"
        )
        print(f"{said}: run 'python -m benchmarks.check --keep' on the version to compare with", file=sys.stderr)
        return 2
    cv2.setNumThreads(1)
    beside = yardstick()
    now = {name: log_ratios(make(), beside, PAIRS) for name, make in PATHS.items()}
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
    return _said(compared(now, kept["log_ratios"]), kept["measured"])


def _said(found: Sequence[Comparison], measured: str) -> int:
    """Prints the comparison; 1 where a path is slower."""
    bad = slower(found)
    print(f"{'times the ratio kept ' + measured[:10]:<40}{'times':>8}{'p':>10}")
    for one in found:
        print(f"{one.name:<40}{one.times:8.2f}{one.p_value:10.2g}{'  SLOWER' if one in bad else ''}")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
