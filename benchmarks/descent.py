"""How long a descent picture and a smoke case take. Prints a table and keeps the figures with the machine's."""

from __future__ import annotations

import datetime as dt
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np

from scenarios.descent import (
    CameraParameters,
    DescentScenario,
    DescentScenarioParameters,
    camera_optics,
    placed_descent,
)
from sim.frames import direction
from sim.processor import processor_features
from sim.render import Photometry, Scene, Sun, process_renderer
from sim.render.backend import default_backend
from sim.sensor import Detector, DetectorParameters
from sim.streams import Streams
from sim.terrain import TerrainBank, TerrainParameters, synthesise

RESULTS = Path(__file__).parent / "results"
#: Bars of the first issue, core-seconds.
BARS = {"descent frame, 1024 x 1024": 0.6, "smoke case, 3 frames and DIMES": 2.0}


def core_seconds(run: Callable[[], object], repeats: int) -> list[float]:
    """Processor time of each of some runs, after one that is not counted."""
    run()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return times


def frame_times(repeats: int) -> dict[str, list[float]]:
    """A frame of the descent scene, terrain and mesh built; and the detector behind it."""
    parameters = DescentScenarioParameters()
    surface = TerrainBank(parameters.terrain, 1).terrain(0)
    optics = camera_optics(CameraParameters())
    renderer = process_renderer(default_backend())
    scene = Scene(surface, (0.0, 0.0), Sun(direction(4.0, 0.7)), Photometry())
    pose = placed_descent(parameters, surface).state(1.0).world_from_body
    detector = Detector.drawn(optics.fall_off, DetectorParameters(), np.random.default_rng(0))
    radiance = renderer.render(scene, optics.rays, pose).radiance
    return {
        "descent frame, 1024 x 1024": core_seconds(lambda: renderer.render(scene, optics.rays, pose), repeats),
        "detector": core_seconds(lambda: detector.expose(radiance, np.random.default_rng(0)), repeats),
    }


def case_times(repeats: int) -> dict[str, list[float]]:
    """A whole case as the smoke campaign runs it, terrain built."""
    scenario, parameters = DescentScenario(), DescentScenarioParameters()
    return {
        "smoke case, 3 frames and DIMES": core_seconds(
            lambda: scenario.run(parameters, Streams(1, "bench", 0)), repeats
        ),
        "new terrain, 4096 x 4096": core_seconds(
            lambda: synthesise(TerrainParameters(), np.random.default_rng(0)), max(repeats // 3, 2)
        ),
    }


def main() -> None:
    """Measures, prints and keeps."""
    cv2.setNumThreads(1)
    times = frame_times(15) | case_times(9)
    print(f"{'core-seconds':<34}{'median':>9}{'least':>9}{'most':>9}{'bar':>9}")
    for name, values in times.items():
        bar = f"{BARS[name]:9.2f}" if name in BARS else " " * 9
        print(f"{name:<34}{statistics.median(values):9.3f}{min(values):9.3f}{max(values):9.3f}{bar}")
    RESULTS.mkdir(exist_ok=True)
    record = {
        "measured": dt.datetime.now(dt.UTC).isoformat(timespec="seconds"),
        "machine": {"platform": platform.platform(), "processor": processor_features(), "cores": os.cpu_count()},
        "versions": {
            name: version(name) for name in ("marsyard", "numpy", "numba", "pyrender2", "opencv-python-headless")
        },
        "gl": process_renderer(default_backend()).description(),
        "core_seconds": {name: statistics.median(values) for name, values in times.items()},
    }
    path = RESULTS / "descent.json"
    path.write_text(json.dumps(record, indent=2) + "\n")
    print(f"kept in {path}")


if __name__ == "__main__":
    main()
