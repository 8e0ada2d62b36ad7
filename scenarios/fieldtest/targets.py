"""The surveyed targets, and where pictures of a pass over them show them (paper, III.D.2).

The pictures are not drawn: a target's centroid is where the camera's model puts it, with a centroid's error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from marsyard.scenarios.fieldtest.attitude import Sightings
from marsyard.scenarios.fieldtest.parameters import TargetParameters
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import Motion
from marsyard.sim.terrain import Surface

#: How far inside the picture a target must lie to be measured, pixels.
_BORDER_PX = 4.0


@dataclass(frozen=True)
class Targets:
    """The targets that are used: where they are and where the survey puts them, world axes, metres."""

    true_m: Float64[np.ndarray, "targets 3"]
    surveyed_m: Float64[np.ndarray, "targets 3"]

    @classmethod
    def placed(
        cls,
        parameters: TargetParameters,
        surface: Surface,
        middle_m: Float64[np.ndarray, "2"],
        rng: np.random.Generator,
    ) -> Targets:
        """Targets on the ground around a place; the first ones of those placed are used."""
        p = parameters
        places = middle_m + rng.uniform(-p.within_m, p.within_m, (p.placed, 2))[: p.used]
        true = np.column_stack([places, surface.height(places[:, 0], places[:, 1])])
        return cls(true, true + p.survey_m * rng.standard_normal(true.shape))


def sight_targets(
    targets: Targets,
    camera: CameraModel,
    motion: Motion,
    tags_s: Float64[np.ndarray, "pictures"],
    gps_m: Float64[np.ndarray, "pictures 3"],
    centroid_px: float,
    rng: np.random.Generator,
) -> Sightings:
    """What pictures taken along a motion show of the targets, with their directions by GPS and survey.

    Parameters
    ----------
    targets
        The targets.
    camera
        The camera in the body frame, at its origin.
    motion
        Truth at the exposures.
    tags_s, gps_m
        Time tags of the pictures and measured positions of the camera.
    centroid_px
        Error of a centroid per axis.
    rng
        Stream of the centroids' errors.
    """
    columns, rows = camera.size
    times, seen, expected = [], [], []
    for number, (attitude, position) in enumerate(zip(motion.attitudes, motion.positions_m, strict=True)):
        pixels, visible = camera.project(attitude.inv().apply(targets.true_m - position))
        centroids = pixels + centroid_px * rng.standard_normal(pixels.shape)
        inside = (centroids >= _BORDER_PX) & (centroids <= np.array([columns, rows]) - 1.0 - _BORDER_PX)
        measured = visible & inside.all(axis=1)
        _, directions = camera.rays(centroids[measured])
        seen.append(directions)
        expected.append(_unit(targets.surveyed_m[measured] - gps_m[number]))
        times.append(np.full(int(measured.sum()), tags_s[number]))
    return Sightings(np.concatenate(times), _unit(np.concatenate(seen)), np.concatenate(expected))


def _unit(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    unit: Float64[np.ndarray, "n 3"] = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit
