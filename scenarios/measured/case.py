"""What the scenarios of measured cases share: nothing is built, all algorithms are asked, pictures meet their poses."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.hda.view import camera_pose
from marsyard.scenarios.base import BaseScenario
from marsyard.scenarios.chosen import ChosenAlgorithms
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.measured.parameters import MeasuredParameters
from marsyard.scenarios.measured.store import StoredPicture, pose_of
from marsyard.scenarios.trial import Attempt, attempted_with
from marsyard.sim.measurements import DetectorImage

Answer = TypeVar("Answer")
Stated = TypeVar("Stated", bound=BaseModel)

NAN = float("nan")


class MeasuredScenario(BaseScenario[Stated]):
    """A scenario whose cases are files that are there."""

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """None: there is nothing to build."""
        return ()

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Nothing."""


def tried(
    p: ChosenAlgorithms, options: Any, measurements: Any, check: Callable[[object], Answer], case: int
) -> Mapping[str, Attempt[Answer]]:
    """What came of asking each of the algorithms."""

    def ask(spec: str) -> Attempt[Answer]:
        return attempted_with(
            lambda given: p.task.make(spec, options, p.executable, case).estimate(given), check, measurements
        )

    return {spec: ask(spec) for spec in p.algorithms}


def pose(picture: StoredPicture) -> RigidTransform:
    """The body's measured pose; at the origin where no place was measured."""
    return pose_of(picture.position_m or (0.0, 0.0, 0.0), picture.world_from_body_xyzw)


def about(p: MeasuredParameters, images: Sequence[DetectorImage]) -> dict[str, Scalar]:
    """Which case it is, and how far its camera went from one picture to the next, at most."""
    poses = [pose(picture) * camera_pose(image.camera) for picture, image in zip(p.case.pictures, images, strict=True)]
    digest = hashlib.sha256()
    for image in images:
        digest.update(np.ascontiguousarray(image.counts).tobytes())
    steps = [before.inv() * after for before, after in itertools.pairwise(poses)]
    placed = all(picture.position_m is not None for picture in p.case.pictures)
    return {
        "measured_case": p.case.name,
        "pictures": len(images),
        "lasted_s": images[-1].time_s - images[0].time_s,
        "turned_most_deg": max(float(np.degrees(step.rotation.magnitude())) for step in steps),
        "moved_most_m": max(float(np.linalg.norm(step.translation)) for step in steps) if placed else NAN,
        "image_hash": digest.hexdigest(),
    }


def distance(one: Float[np.ndarray, "n"] | None, other: Float[np.ndarray, "n"] | None) -> float:
    """Between two answers; NaN where one is lacking."""
    return NAN if one is None or other is None else float(np.linalg.norm(one - other))
