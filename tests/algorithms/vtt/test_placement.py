"""Tests of the placement of an instrument: collision check, re-selection, and the surface measured by stereo."""

import numpy as np
import pytest

from marsyard.algorithms.vtt.placement import Instrument, PlacementOutcome, place_instrument, tool_overlap_m

VIEWPOINT = np.array([0.0, 0.0, 1.5])
TARGET = np.array([2.0, 0.1, 0.3])


def make_surface(ridge_m: float = 1.0, ridge_height_m: float = 0.0) -> np.ndarray:
    """Return level ground around the target every 2 mm, higher by `ridge_height_m` beyond `ridge_m` along x."""
    steps = np.arange(-0.15, 0.15, 0.002)
    x, y = (values.ravel() for values in np.meshgrid(steps, steps))
    heights = np.where(x > ridge_m, ridge_height_m, 0.0)
    return np.asarray(TARGET + np.column_stack([x, y, heights]))


def test_instrument_is_placed_on_flat_ground() -> None:
    placement = place_instrument(make_surface(), TARGET, VIEWPOINT)
    assert placement.outcome is PlacementOutcome.PLACED
    assert placement.position_rover == pytest.approx(TARGET, abs=1e-9)
    assert placement.normal_rover == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)


def test_target_next_to_a_step_is_reselected_away_from_it() -> None:
    """The tools reach 5 cm: with a step of 3 cm at 4.5 cm they collide, 6 mm away they do not."""
    surface = make_surface(0.045, 0.03)
    assert tool_overlap_m(surface, TARGET, np.array([0.0, 0.0, 1.0]), Instrument()) == pytest.approx(0.015)
    placement = place_instrument(surface, TARGET, VIEWPOINT)
    assert placement.outcome is PlacementOutcome.RESELECTED
    assert placement.position_rover is not None
    moved = placement.position_rover - TARGET
    assert 0.004 <= -moved[0] <= 0.008
    # the nearest free position is chosen
    assert np.linalg.norm(moved) == pytest.approx(0.006, abs=0.0021)


def test_no_position_within_8_mm_is_a_collision() -> None:
    # the step is 2.5 cm from the target; the tools would have to move by 2.5 cm
    assert place_instrument(make_surface(0.025, 0.03), TARGET, VIEWPOINT).outcome is PlacementOutcome.COLLISION
    # a step lower than the clearance of 1.5 cm is permitted
    assert place_instrument(make_surface(0.025, 0.01), TARGET, VIEWPOINT).outcome is PlacementOutcome.PLACED


def test_too_few_points_are_no_surface() -> None:
    assert place_instrument(np.empty((0, 3)), TARGET, VIEWPOINT).outcome is PlacementOutcome.NO_SURFACE
    ring = make_surface()
    ring = ring[np.linalg.norm(ring - TARGET, axis=1) > 0.035]
    assert place_instrument(ring, TARGET, VIEWPOINT).outcome is PlacementOutcome.NO_SURFACE
    assert np.isnan(tool_overlap_m(ring, TARGET, np.array([0.0, 0.0, 1.0]), Instrument()))
