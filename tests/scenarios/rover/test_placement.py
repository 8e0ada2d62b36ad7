"""Tests of the placement of the instrument at the end of a run: measured surface, position, and true overlap."""

from typing import Any

import numpy as np
import pytest

from marsyard.algorithms.vtt.placement import Placement, PlacementOutcome, measure_surface
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.placement import placement_row, placement_truth, sample_surface
from marsyard.scenarios.rover.run import Run, prepare_run, track_target
from marsyard.scenarios.rover.scenario import place_target
from marsyard.sim.streams import Streams
from tests.scenarios.rover.short_run import SHORT_RUN

#: A slab that the rover approaches to 2.2 m.
SLAB: dict[str, Any] = {
    **SHORT_RUN,
    "start": {"distance_m": 2.6},
    "target": {"diameter_m": 1.2, "height_m": 0.25, "up": 0.6, "shape": 8, "yaw_deg": 30.0},
    "legs": [{"motion": "approach", "goal_m": 2.2, "step_fraction": 0.1}],
}


@pytest.fixture(scope="module")
def placed_run() -> tuple[bool, Run]:
    """Return whether the target of a short run is placeable, and the run."""
    parameters = RoverScenarioParameters.model_validate(SLAB)
    run = prepare_run(parameters, Streams(1, "placement tests", 0))
    placeable = placement_truth(run)["placeable"]
    return bool(placeable), place_target(track_target(parameters, run))


def test_instrument_is_placed_on_the_target(placed_run: tuple[bool, Run]) -> None:
    placeable, run = placed_run
    row = placement_row(run)
    assert placeable
    assert run.handed_over
    assert (row["placed"], row["placement_safe"]) == (True, True)
    assert run.placement is not None
    # along the normal the contact is on the measured surface, within 3 cm; across, within 8 mm
    assert float(row["placement_error_m"]) < 0.03
    assert float(row["tool_overlap_m"]) <= 0.0


def test_measured_surface_agrees_with_the_rock(placed_run: tuple[bool, Run]) -> None:
    _, run = placed_run
    stop = run.stops[-1]
    target = np.asarray(stop.update.position_rover)
    measured = measure_surface(stop.measurements(run.rig.calibrated), target)
    measured = measured[np.linalg.norm(measured - target, axis=1) < 0.05]
    viewpoint = run.rig.camera_positions(stop.world_from_head)[0]
    true_surface = np.asarray(stop.stance.world_from_rover.inv().apply(sample_surface(run, viewpoint)))
    # the surface within 5 cm covers thousands of pixels of 2 mm; half of them have a match
    assert len(measured) > 500
    distances = np.array([np.linalg.norm(true_surface - point, axis=1).min() for point in measured[::10]])
    # half a pixel of calibration error at 2.6 m is 1.5 cm of range (Eq. 1 of the tracking paper)
    assert np.median(distances) < 0.02


def test_overlap_of_the_true_rock_is_a_collision(placed_run: tuple[bool, Run]) -> None:
    """A tool axis tilted by 60 deg from the surface normal: 5 cm x tan(60 deg) exceeds the clearance."""
    _, run = placed_run
    assert run.placement is not None
    assert run.placement.normal_rover is not None
    normal = run.placement.normal_rover
    across = np.cross(normal, [0.0, 1.0, 0.0])
    tilted = 0.5 * normal + np.sqrt(0.75) * across / np.linalg.norm(across)
    original = run.placement
    run.placement = Placement(PlacementOutcome.PLACED, original.position_rover, tilted)
    row = placement_row(run)
    run.placement = original
    overlap = row["tool_overlap_m"]
    assert isinstance(overlap, float)
    assert overlap > 0.02
    assert not row["placement_safe"]


def test_run_without_a_hand_over_is_not_placed() -> None:
    parameters = RoverScenarioParameters.model_validate({**SLAB, "legs": [{"motion": "stay", "steps": 1}]})
    run = place_target(track_target(parameters, prepare_run(parameters, Streams(1, "placement tests", 0))))
    assert run.placement is None
    assert not placement_row(run)["placed"]
