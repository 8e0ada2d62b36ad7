"""Run times of complete localisation cases, and of their stages."""

from functools import partial

from benchmarks.stages import Stages, measure_stages
from benchmarks.timing import Measurement, case_runner, core_seconds
from marsyard.campaigns.definition.loading import load_campaign

#: Stages of a case of `loc-jezero` with the published algorithm alone.
STAGES: Stages = {
    "terrain": (("views.py", "from_bank"),),
    "map product": (("localisation/map_product.py", "make_map"),),
    "flight": (("localisation/flight.py", "simulate"),),
    "scene": (("localisation/world.py", "scene"),),
    "24 images": (("scenarios/views.py", "render_state"), ("scenarios/radiance.py", "add_haze")),
    "detector": (("sensor/detector.py", "expose"),),
    "landmarks of the map": (("localisation/landmarks.py", "select_landmarks"),),
    "coarse stage": (("localisation/coarse.py", "find_coarse_position"),),
    "fine stage": (("localisation/fine.py", "match_landmarks"),),
    "navigation filter": (
        ("localisation/navigation_filter.py", "propagate"),
        ("localisation/navigation_filter.py", "update_landmarks"),
        ("localisation/navigation_filter.py", "update_altitude"),
    ),
}


def measure(cases: int) -> list[Measurement]:
    """Measure cases of `loc-jezero` with all algorithms, and with `lvs` alone; each one builds a terrain of its own."""
    complete, alone = (load_campaign("loc-jezero", overrides) for overrides in ([], ["compared=[]"]))
    run = case_runner()
    run_next = partial(run, alone)
    return [
        Measurement(
            "loc-jezero case: terrain, map, 24 frames, all algorithms",
            core_seconds(partial(run, complete), cases),
            limit=6.0,
        ),
        Measurement("loc-jezero case: terrain, map, 24 frames, lvs", core_seconds(run_next, cases), limit=6.0),
        *measure_stages("loc-jezero case", run_next, max(cases - 1, 1), STAGES),
    ]
