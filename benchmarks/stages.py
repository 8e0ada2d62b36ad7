"""Core-seconds of the stages of a case, measured by Python's profiler."""

import cProfile
import time
from collections.abc import Callable, Mapping

from benchmarks.timing import Measurement

#: Functions of each stage, by its name: end of the file name, and function name. The time of a function includes that
#: of the functions that it calls.
Stages = Mapping[str, tuple[tuple[str, str], ...]]
#: Stages of a `dimes-gusev` case.
DESCENT_STAGES: Stages = {
    "terrain and rocks": (("descent/world.py", "from_parameters"), ("descent/world.py", "scene")),
    "flight": (("descent/flight.py", "create_flight"),),
    "mesh and OpenGL": (("render/renderer.py", "_draw_views"),),
    "ray intersection": (("render/arrays.py", "trace_primary_rays"),),
    "shadow of the ground": (("render/ground_shadow.py", "compute_ground_shadow"),),
    "shading": (("render/renderer.py", "shade_hits"),),
    "rays in edge pixels": (("render/renderer.py", "supersample_rays"), ("render/arrays.py", "trace_subpixel_rays")),
    "detector": (
        ("sensor/detector.py", "draw"),
        ("sensor/detector.py", "expose"),
        ("sensor/image_motion.py", "from_camera"),
    ),
    "instruments": (("descent/measurements.py", "draw"), ("descent/measurements.py", "measure")),
    "DIMES": (("dimes/estimator.py", "estimate"),),
    "feasible overlap": (("descent/overlap.py", "overlap_row"),),
}

#: Name of the time outside all stages.
REMAINDER = "other"


def measure_stages(case: str, run: Callable[[], object], repeats: int, stages: Stages) -> list[Measurement]:
    """Measure the core-seconds of every stage and of the remainder, per run, after a warm-up run.

    Python's profiler slows stages with many small calls (flight, instruments) by up to a half.
    """
    timings = profile_stages(run, repeats, stages)
    return [Measurement(f"{case}, profiled stage: {name}", values) for name, values in timings.items()]


def profile_stages(run: Callable[[], object], repeats: int, stages: Stages) -> dict[str, list[float]]:
    """Return the core-seconds of each stage per run, by name."""
    run()
    timings: dict[str, list[float]] = {name: [] for name in (*stages, REMAINDER)}
    for _ in range(repeats):
        profile = cProfile.Profile(time.process_time)
        profile.runcall(run)
        for name, seconds in _sum_stage_seconds(profile, stages).items():
            timings[name].append(seconds)
    return timings


def _sum_stage_seconds(profile: cProfile.Profile, stages: Stages) -> dict[str, float]:
    """Sum the seconds in the functions of each stage with their callees, and in all other functions."""
    entries = profile.getstats()
    seconds = dict.fromkeys(stages, 0.0)
    for entry in entries:
        if isinstance(entry.code, str):
            continue
        for name, functions in stages.items():
            if any(
                entry.code.co_name == function and entry.code.co_filename.endswith(file) for file, function in functions
            ):
                seconds[name] += entry.totaltime
    return seconds | {REMAINDER: sum(entry.inlinetime for entry in entries) - sum(seconds.values())}
