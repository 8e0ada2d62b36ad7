"""Tests of the true overlap of descent images: widths of footprints that are known from their geometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.scenarios.conformance.parts import swinging_fall
from marsyard.scenarios.descent.overlap import ZERO_PHASE_RADIUS_RAD, footprint, overlap_width_m, zero_phase_spot
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import State
from marsyard.sim.sensor import preset

#: Direction to a sun 10 deg above the horizon in the south: its bright spot is outside of images at the nadir.
LOW_SUN = np.array([0.0, -np.cos(np.radians(10.0)), np.sin(np.radians(10.0))])
#: Resolution of a width: a cell on each side.
CELLS_M = 10.0


def make_camera() -> CameraModel:
    (camera,) = preset("mer-descent-flown").cameras()
    return camera


def make_state(east_m: float, height_m: float = 1000.0) -> State:
    """Return a state at a height above the datum; the camera points down."""
    position_m = np.array([east_m, 0.0, height_m])
    return replace(swinging_fall().state(0.0), position_m=position_m, attitude=Rotation.identity())


def half_widths_m(camera: CameraModel) -> np.ndarray:
    """Return half the width of the footprint from 1000 m, east and north."""
    return np.ptp(footprint(make_state(0.0), camera, 0.0), axis=0) / 2.0


def test_width_without_motion_is_that_of_the_footprint() -> None:
    """A field of view of 45 deg (paper, section II) is 830 m wide at a height of 1000 m."""
    camera = make_camera()
    width = overlap_width_m([make_state(0.0), make_state(0.0)], camera, 0.0, LOW_SUN)
    assert width == pytest.approx(2.0 * half_widths_m(camera).min(), abs=CELLS_M)
    assert width == pytest.approx(830.0, rel=0.05)
    # twice the height above the ground
    raised = overlap_width_m([make_state(0.0), make_state(0.0)], camera, -1000.0, LOW_SUN)
    assert raised == pytest.approx(2.0 * width, rel=0.02)


@pytest.mark.parametrize("width_m", [300.0, 110.0, 0.0])
def test_width_decreases_by_the_motion_between_the_images(width_m: float) -> None:
    camera = make_camera()
    motion_m = 2.0 * half_widths_m(camera)[0] - width_m
    width = overlap_width_m([make_state(0.0), make_state(motion_m)], camera, 0.0, LOW_SUN)
    assert width == pytest.approx(width_m, abs=CELLS_M)
    # no common ground
    assert overlap_width_m([make_state(0.0), make_state(motion_m + width_m + 50.0)], camera, 0.0, LOW_SUN) == 0.0


def test_bright_spot_is_excluded() -> None:
    """With the sun in the zenith the spot is a disc at the nadir; the largest circle is in a corner next to it."""
    camera, sun = make_camera(), np.array([0.0, 0.0, 1.0])
    radius = 1000.0 * np.tan(ZERO_PHASE_RADIUS_RAD)
    spot = zero_phase_spot(make_state(0.0), 0.0, sun)
    assert np.hypot(*spot.T) == pytest.approx(np.full(len(spot), radius), rel=1e-9)
    width = overlap_width_m([make_state(0.0), make_state(0.0)], camera, 0.0, sun)
    # circle of radius r that touches two sides of a square of half width a, and the spot: sqrt(2) (a - r) = r + spot
    half = half_widths_m(camera).min()
    expected = 2.0 * (np.sqrt(2.0) * half - radius) / (1.0 + np.sqrt(2.0))
    assert width == pytest.approx(expected, rel=0.06)
