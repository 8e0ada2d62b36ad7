"""Run all benchmarks, print and store the measurements: ``python -m benchmarks``."""

import argparse
import datetime as dt
import json
import os
import platform
from importlib.metadata import version

import cv2

from benchmarks import (
    descent,
    engine,
    estimators,
    hda,
    images,
    localisation,
    project,
    renderers,
    reporting,
    starting,
    vtt,
)
from benchmarks.check import reference_workload
from benchmarks.page import PAGE, REFERENCE, RESULTS, is_within_limit, scale_value, write_page
from benchmarks.timing import Measurement, core_seconds
from marsyard.sim.kernel_cache import processor_features
from marsyard.sim.render import process_renderer
from marsyard.sim.render.backend import default_backend

#: Packages whose versions are stored with the results.
PACKAGES = ("marsyard", "numpy", "numba", "pyrender2", "opencv-python-headless")


def main() -> None:
    """Run all benchmarks, print and store the measurements."""
    argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__).parse_args()
    cv2.setNumThreads(1)
    # the arguments are numbers of repetitions or of cases
    measurements = [
        # first, because other benchmarks increase the memory of the process
        *images.measure_memory(500),
        Measurement(REFERENCE, [1e3 * time_s for time_s in core_seconds(reference_workload(), 50)]),
        *descent.measure_frame(15),
        *descent.measure_case(7),
        *estimators.compare_estimators(8),
        *renderers.measure(5),
        *images.measure_rover_images(3),
        *descent.measure_new_terrains(2),
        *vtt.measure(9),
        *hda.measure(9),
        *localisation.measure(3),
        *engine.measure(),
        *starting.measure(5),
        *reporting.measure(),
        *project.measure(),
    ]
    reference_ms = next(row.median for row in measurements if row.name == REFERENCE)
    heads = f"{'median':>8}{'min':>8}{'max':>8}{'scaled':>8}"
    print(f"{'core-seconds, unless stated otherwise':<52}{heads}  {'limit':<8}")
    for row in measurements:
        scaled = scale_value(row.name, row.median, reference_ms)
        value = row.median if scaled is None else scaled
        mark = "  MISSED" if is_within_limit(row.limit_text, value) is False else ""
        low, high = min(row.values), max(row.values)
        print(f"{row.name:<52}{row.median:8.3f}{low:8.3f}{high:8.3f}{value:8.3f}  {row.limit_text:<8}{mark}")
    store(measurements)


def store(measurements: list[Measurement]) -> None:
    """Store the measurements with the machine and the versions, and write the page."""
    record = {
        "measured": dt.datetime.now(dt.UTC).isoformat(timespec="seconds"),
        "machine": {"platform": platform.platform(), "processor": processor_features(), "cores": os.cpu_count()},
        "versions": {name: version(name) for name in PACKAGES},
        "gl": process_renderer(default_backend()).description(),
        "figures": {row.name: {"median": row.median, "limit": row.limit_text} for row in measurements},
    }
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps(record, indent=2) + "\n")
    write_page(record)
    print(f"stored in {RESULTS}, page written to {PAGE}")


if __name__ == "__main__":
    main()
