"""Run all benchmarks, print and store the figures: ``python -m benchmarks``."""

from __future__ import annotations

import argparse
import datetime as dt
import json
import os
import platform
from importlib.metadata import version
from pathlib import Path

import cv2

from benchmarks import descent, engine, estimators, hda, pictures, renderers, reporting, starting, vtt
from benchmarks.page import PAGE, write_page
from benchmarks.timing import Figure
from marsyard.sim.kernel_cache import processor_features
from marsyard.sim.render import process_renderer
from marsyard.sim.render.backend import default_backend

RESULTS = Path(__file__).parent / "results" / "benchmarks.json"
PACKAGES = ("marsyard", "numpy", "numba", "pyrender2", "opencv-python-headless")


def main() -> None:
    """Run all benchmarks, print and store the figures."""
    argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__).parse_args()
    cv2.setNumThreads(1)
    figures = [
        # first, because other benchmarks increase the memory of the process
        *pictures.memory(500),
        *descent.frame(15),
        *descent.case(7),
        *estimators.compare_estimators(8),
        *renderers.figures(5),
        *pictures.rover_pictures(3),
        *descent.new_terrains(2),
        *vtt.figures(9),
        *hda.figures(9),
        *engine.figures(),
        *starting.figures(5),
        *reporting.figures(),
    ]
    print(f"{'core-seconds, unless said otherwise':<52}{'median':>8}{'least':>8}{'most':>8}  {'limit':<8}")
    for figure in figures:
        mark = "" if figure.met else "  MISSED"
        low, high = min(figure.values), max(figure.values)
        print(f"{figure.name:<52}{figure.median:8.3f}{low:8.3f}{high:8.3f}  {figure.asked:<8}{mark}")
    keep(figures)


def keep(figures: list[Figure]) -> None:
    """Store the figures with machine and versions."""
    record = {
        "measured": dt.datetime.now(dt.UTC).isoformat(timespec="seconds"),
        "machine": {"platform": platform.platform(), "processor": processor_features(), "cores": os.cpu_count()},
        "versions": {name: version(name) for name in PACKAGES},
        "gl": process_renderer(default_backend()).description(),
        "figures": {figure.name: {"median": figure.median, "asked": figure.asked} for figure in figures},
    }
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps(record, indent=2) + "\n")
    write_page(record)
    print(f"kept in {RESULTS}, shown in {PAGE}")


if __name__ == "__main__":
    main()
