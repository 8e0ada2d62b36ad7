"""Run times of a tracking update, of its search compared with OpenCV's, and of a complete run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from benchmarks.timing import Measurement, core_seconds
from marsyard.algorithms.image.correlation import coarse_to_fine_peak, normalized_correlation
from marsyard.algorithms.vtt.lucas_kanade import lucas_kanade_tracker
from marsyard.algorithms.vtt.matching import extract_patch, search_window
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.algorithms.vtt.tracker import VisualTargetTracker
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run import run_case
from marsyard.sim.measurements import RoverMeasurements, RoverTarget
from marsyard.sim.streams import Streams
from tests.algorithms.vtt.synthetic_drive import Drive, Plane, Scene, draw_waves, navcam, pose

TARGET = np.array([10.0, 0.1, 0.2])
#: Runs averaged into one measurement, because one run is near the resolution of the clock.
BATCH = 20


def _stops(options: VttOptions) -> tuple[RoverMeasurements, RoverMeasurements]:
    """Two stops, 10 % of the distance apart, in front of a slanted face."""
    face = Plane(TARGET, np.array([-0.8, 0.0, 0.6]))
    drive = Drive(Scene((face,), draw_waves(1), TARGET), navcam(), VisualTargetTracker(options))
    drive.tracker.designate(RoverTarget(TARGET), pose(0.0, 0.0))
    for x in (0.0, 0.97):
        drive.stop(pose(x, 0.0))
    return drive.measurements[0], drive.measurements[1]


def seeded_update(tracker: VisualTargetTracker | None = None) -> Callable[[], object]:
    """Return a function that updates a tracker at the second of two stops."""
    tracker = tracker or VisualTargetTracker(VttOptions())
    first, second = _stops(tracker.options)
    tracker.designate(RoverTarget(TARGET), pose(0.0, 0.0))
    tracker.update(first)
    seeded = tracker.track

    def run() -> None:
        tracker.track = seeded
        tracker.update(second)

    return run


def _update_ms(tracker: VisualTargetTracker, repeats: int) -> list[float]:
    update = seeded_update(tracker)
    batches = core_seconds(lambda: [update() for _ in range(BATCH)], repeats)
    return [1e3 * seconds / BATCH for seconds in batches]


def updates(repeats: int) -> list[Measurement]:
    """One update: scale, roll, 21 x 21 in 161 x 161, refinement, point stereo, criteria."""
    options = VttOptions()
    brute = replace(options, coarse_levels=0)
    return [
        Measurement("target tracking update, ms", _update_ms(VisualTargetTracker(options), repeats), limit=2.0),
        Measurement("the same by the full search, ms", _update_ms(VisualTargetTracker(brute), repeats)),
        Measurement("the same by OpenCV's Lucas-Kanade, ms", _update_ms(lucas_kanade_tracker(), repeats)),
    ]


def _repeat(search: Callable[[], object]) -> None:
    for _ in range(BATCH):
        search()


def searches(repeats: int) -> list[Measurement]:
    """Template search: coarse to fine, at every position, and OpenCV's matchTemplate."""
    figures = []
    for side in (161, 600):
        options = VttOptions(search_px=side)
        first, second = _stops(options)
        place = navcam().left.project(
            navcam().geometry.rover_from_head(first.azimuth_rad, first.elevation_rad).inv().apply(TARGET)
        )[0]
        template = extract_patch(first.left, place, 21)
        window = search_window(second.left, place, side)[0].astype(np.float64)
        a, b = template.astype(np.float32), window.astype(np.float32)
        timed: dict[str, Callable[[], object]] = {
            "coarse to fine": partial(coarse_to_fine_peak, template, window, 1, 6),
            "at every position": partial(normalized_correlation, template, window),
            "by cv2.matchTemplate": partial(cv2.matchTemplate, b, a, cv2.TM_CCOEFF_NORMED),
        }
        for name, search in timed.items():
            batch = [1e3 * s / BATCH for s in core_seconds(partial(_repeat, search), repeats)]
            figures.append(Measurement(f"21 x 21 in {side} x {side} {name}, ms", batch))
    return figures


def runs(repeats: int) -> list[Measurement]:
    """Closed loop from 10 m to 2 m in steps of 10 %, with 17 stereo pairs of rendered subframes among rocks."""
    of_run = {
        "camera": {"preset": "research-navcam"},
        "target": {"diameter_m": 0.9, "shape": 2, "yaw_deg": 74.0, "across": 0.1},
        "sun": {"azimuth_deg": 260.0, "elevation_deg": 45.0},
        "legs": [{"motion": "approach", "step_fraction": 0.1, "goal_m": 2.0}],
    }
    parameters = RoverScenarioParameters.model_validate(of_run)
    elapsed_s = core_seconds(lambda: run_case(parameters, Streams(1, "benchmark", 0)), repeats)
    return [Measurement("a rover's run from 10 m to 2 m, rendered", elapsed_s, limit=1.5)]


def measure(repeats: int) -> list[Measurement]:
    """All figures of target tracking."""
    return [*updates(repeats), *searches(repeats), *runs(min(repeats, 3))]
