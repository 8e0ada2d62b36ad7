"""Run times of visual target tracking: a tracking update, its template search (also by OpenCV), and a rover run."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from benchmarks.timing import Measurement, core_seconds
from marsyard.algorithms.image.correlation import coarse_to_fine_peak, normalized_correlation
from marsyard.algorithms.vtt.matching import extract_patch, search_window
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.algorithms.vtt.tracker import VisualTargetTracker, lucas_kanade_tracker
from marsyard.scenarios.rover.closed_loop import run_case
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.sim.measurements import RoverMeasurements, RoverTarget
from marsyard.sim.streams import Streams
from tests.algorithms.vtt.synthetic_drive import Drive, Plane, Scene, draw_waves, navcam, pose

#: Position of the target in the world frame, m.
TARGET = np.array([10.0, 0.1, 0.2])
#: Runs averaged into one measurement, because one run is near the resolution of the clock.
BATCH = 20


def _simulate_stops(options: VttOptions) -> tuple[RoverMeasurements, RoverMeasurements]:
    """Simulate the measurements of two stops, 10 % of the distance apart, in front of a slanted, textured plane."""
    plane = Plane(TARGET, np.array([-0.8, 0.0, 0.6]))
    drive = Drive(Scene((plane,), draw_waves(seed=1), TARGET), navcam(), VisualTargetTracker(options))
    drive.tracker.designate(RoverTarget(TARGET), pose(0.0, 0.0))
    for x in (0.0, 0.97):
        drive.stop(pose(x, 0.0))
    return drive.measurements[0], drive.measurements[1]


def prepare_update(tracker: VisualTargetTracker | None = None) -> Callable[[], object]:
    """Return a function that updates a tracker at the second of two stops."""
    tracker = tracker or VisualTargetTracker(VttOptions())
    first, second = _simulate_stops(tracker.options)
    tracker.designate(RoverTarget(TARGET), pose(0.0, 0.0))
    tracker.update(first)
    initial_track = tracker.track

    def run() -> None:
        tracker.track = initial_track
        tracker.update(second)

    return run


def _measure_update_ms(tracker: VisualTargetTracker, repeats: int) -> list[float]:
    """Measure the time of one update, ms, averaged over each batch."""
    update = prepare_update(tracker)
    batches = core_seconds(lambda: [update() for _ in range(BATCH)], repeats)
    return [1e3 * seconds / BATCH for seconds in batches]


def measure_updates(repeats: int) -> list[Measurement]:
    """Measure one update: scale, roll, search of 21 x 21 in 161 x 161, refinement, point stereo, criteria."""
    options = VttOptions()
    full_search = replace(options, coarse_levels=0)
    return [
        Measurement("tracking update (ms)", _measure_update_ms(VisualTargetTracker(options), repeats), limit=2.0),
        Measurement(
            "tracking update with full search (ms)", _measure_update_ms(VisualTargetTracker(full_search), repeats)
        ),
        Measurement(
            "tracking update with OpenCV's Lucas-Kanade (ms)", _measure_update_ms(lucas_kanade_tracker(), repeats)
        ),
    ]


def _repeat_batch(search: Callable[[], object]) -> None:
    for _ in range(BATCH):
        search()


def measure_searches(repeats: int) -> list[Measurement]:
    """Measure the template search: coarse to fine, at every position, and by OpenCV's matchTemplate."""
    measurements = []
    for side in (161, 600):
        options = VttOptions(search_px=side)
        first, second = _simulate_stops(options)
        pixel = navcam().left.project(
            navcam().geometry.rover_from_head(first.azimuth_rad, first.elevation_rad).inv().apply(TARGET)
        )[0]
        template = extract_patch(first.left, pixel, 21)
        window = search_window(second.left, pixel, side)[0].astype(np.float64)
        template_32, window_32 = template.astype(np.float32), window.astype(np.float32)
        searches: dict[str, Callable[[], object]] = {
            "coarse to fine": partial(coarse_to_fine_peak, template, window, levels=1, candidates=6),
            "at every position": partial(normalized_correlation, template, window),
            "by cv2.matchTemplate": partial(cv2.matchTemplate, window_32, template_32, cv2.TM_CCOEFF_NORMED),
        }
        for name, search in searches.items():
            batch_ms = [1e3 * seconds / BATCH for seconds in core_seconds(partial(_repeat_batch, search), repeats)]
            measurements.append(
                Measurement(f"search of a 21 x 21 px template in {side} x {side} px, {name} (ms)", batch_ms)
            )
    return measurements


def measure_runs(repeats: int) -> list[Measurement]:
    """Measure closed-loop runs from 10 m to 2 m in steps of 10 %, with 17 stereo pairs of rendered subframes.

    Odometry has simulated errors, or is visual odometry with rendered images; the second run also maps the terrain.
    """
    values: dict[str, Any] = {
        "camera": {"preset": "research-navcam"},
        "target": {"diameter_m": 0.9, "shape": 2, "yaw_deg": 74.0, "across": 0.1},
        "sun": {"azimuth_deg": 260.0, "elevation_deg": 45.0},
        "legs": [{"motion": "approach", "step_fraction": 0.1, "goal_m": 2.0}],
    }
    navigated = values | {"legs": [values["legs"][0] | {"visual_odometry": True, "maps_first": True}]}

    def measure_run(name: str, values: dict[str, Any], limit: float) -> Measurement:
        parameters = RoverScenarioParameters.model_validate(values)
        elapsed_s = core_seconds(lambda: run_case(parameters, Streams(1, "benchmark", 0)), repeats)
        return Measurement(name, elapsed_s, limit=limit)

    return [
        measure_run("rover run from 10 m to 2 m with 34 rendered images", values, 1.3),
        measure_run("the same with rendered visual odometry and terrain maps", navigated, 2.6),
    ]


def measure(repeats: int) -> list[Measurement]:
    """Measure all run times of target tracking."""
    return [*measure_updates(repeats), *measure_searches(repeats), *measure_runs(min(repeats, 3))]
