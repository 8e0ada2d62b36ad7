"""Parameters, scenario and columns that the tasks with recorded images share."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Annotated, ClassVar, TypeVar

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, Field, model_validator

from marsyard.scenarios.base import BaseScenario
from marsyard.scenarios.image_provenance import hash_images
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.measured import store
from marsyard.scenarios.measured.layout import TaskName
from marsyard.sim.camera import camera_pose
from marsyard.sim.measurements import DetectorImage
from marsyard.sim.parameters import Parameters

Answer = TypeVar("Answer")
ParametersType = TypeVar("ParametersType", bound=BaseModel)

NAN = float("nan")


class MeasuredParameters(Parameters):
    """Parameters of all tasks; subclasses define `task_name`, the required task of `cases.json`."""

    task_name: ClassVar[TaskName]

    cases: Annotated[store.CasesFile, Field(description="`cases.json` of `marsyard ingest`")]
    number: Annotated[int, Field(ge=0, description="index of the case in the file; usually a grid over all cases")] = 0

    @model_validator(mode="after")
    def _check_case_and_task(self) -> MeasuredParameters:
        stored = self.cases.stored
        if self.number >= len(stored.cases):
            raise ValueError(f"number is {self.number}; {self.cases.file} contains 0 to {len(stored.cases) - 1}")
        if stored.task != self.task_name:
            raise ValueError(
                f"{self.cases.file}: its task is {stored.task}; the scenario measured-{stored.task} runs it"
            )
        return self

    @property
    def case(self) -> store.StoredCase:
        """The case with this number."""
        return self.cases.stored.cases[self.number]


class MeasuredScenario(BaseScenario[ParametersType]):
    """A scenario whose cases are stored files, so there are no inputs to prepare before the cases."""

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Return an empty tuple: no inputs are shared by cases."""
        return ()

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Do nothing: there is no input to prepare."""


def case_row(p: MeasuredParameters, images: Sequence[DetectorImage]) -> dict[str, Scalar]:
    """Return the columns of the case: name, images, and the maximum motion of the camera between two images."""
    poses = [item.pose * camera_pose(image.camera) for item, image in zip(p.case.images, images, strict=True)]
    steps = [earlier.inv() * later for earlier, later in itertools.pairwise(poses)]
    has_positions = all(image.position_m is not None for image in p.case.images)
    return {
        "measured_case": p.case.name,
        "images": len(images),
        "duration_s": images[-1].time_s - images[0].time_s,
        "max_rotation_deg": max(float(np.degrees(step.rotation.magnitude())) for step in steps),
        "max_translation_m": max(float(np.linalg.norm(step.translation)) for step in steps) if has_positions else NAN,
        "image_hash": hash_images(image.counts for image in images),
    }


def distance(first: Float[np.ndarray, "n"] | None, second: Float[np.ndarray, "n"] | None) -> float:
    """Return the distance between two answers; NaN if one is missing."""
    return NAN if first is None or second is None else float(np.linalg.norm(first - second))
