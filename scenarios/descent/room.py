"""Whether the geometry of a descent leaves room for a template and its search area, by truth."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float64

from marsyard.algorithms.dimes import DimesOptions
from marsyard.algorithms.dimes.binning import View, bin_factors, placed_camera
from marsyard.algorithms.dimes.overlap import search_geometry, template_candidates
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import State
from marsyard.sim.measurements import DetectorCalibration
from marsyard.sim.terrain import Surface

#: Width of the ground patch whose mean height is the ground's, m.
PATCH_M = 200.0


def true_altitude_m(surface: Surface, position_m: Float64[np.ndarray, "3"]) -> float:
    """Height above the mean ground of a patch below."""
    samples = PATCH_M / surface.spacing_m
    level = int(np.clip(np.rint(np.log2(max(samples, 1.0))), 0, len(surface.levels) - 1))
    return float(position_m[2] - surface.height(position_m[0], position_m[1], level))


def room(
    states: Sequence[State],
    surface: Surface,
    camera: CameraModel,
    calibration: DetectorCalibration,
    sun_direction: Float64[np.ndarray, "3"],
    options: DimesOptions,
) -> tuple[int, int]:
    """In how many places of DIMES' grid a template and its search area fit, in each pair of pictures.

    With true attitudes, times and altitudes and the true camera; as in DIMES the zero-phase spot is left out. 0 in
    either pair is a descent that leaves DIMES no room.
    """
    views = [_view(state, surface, camera, calibration, options) for state in states]
    first, second = (
        len(template_candidates(one, other, search_geometry(one, other, options), sun_direction, options).pixels)
        for one, other in pairwise(views)
    )
    return first, second


def _view(
    state: State, surface: Surface, camera: CameraModel, calibration: DetectorCalibration, options: DimesOptions
) -> View:
    """A picture's geometry; what it shows does not matter."""
    columns, rows = bin_factors(camera.size[::-1], options.binned_size)
    altitude_m = true_altitude_m(surface, state.position_m)
    placed, centre = placed_camera(camera.binned(columns, rows), state.attitude, altitude_m)
    blank = np.zeros(options.binned_size[::-1], dtype=np.float32)
    return View(blank, blank, placed, centre, state.time_s, calibration, calibration.rows_summed * rows)
