"""Everything that a campaign of measured cases may set: which case, which algorithms, and their options."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from marsyard.algorithms.dimes import DimesOptions
from marsyard.algorithms.hda import HdaOptions
from marsyard.scenarios.chosen import ChosenAlgorithms
from marsyard.scenarios.descent.parameters import check_binning
from marsyard.scenarios.estimators import LANDING, VELOCITY
from marsyard.scenarios.measured.layout import TaskName
from marsyard.scenarios.measured.store import CasesFile, StoredCase
from marsyard.scenarios.parts.scores import OwnScores, ScoredSite, ScoredVelocity
from marsyard.sim.parameters import Parameters


class MeasuredParameters(Parameters):
    """What all tasks have in common."""

    cases: Annotated[CasesFile, Field(description="`cases.json` of `marsyard ingest`")]
    number: Annotated[int, Field(ge=0, description="of the case in it; a grid over all")] = 0

    @model_validator(mode="after")
    def _case_is_there(self) -> MeasuredParameters:
        count = len(self.cases.stored.cases)
        if self.number >= count:
            raise ValueError(f"number is {self.number}; {self.cases.file} holds 0 to {count - 1}")
        return self

    @property
    def case(self) -> StoredCase:
        """The case."""
        return self.cases.stored.cases[self.number]

    def _check_task(self, task: TaskName) -> None:
        if self.cases.stored.task != task:
            found = self.cases.stored.task
            raise ValueError(f"{self.cases.file}: its task is {found}; the scenario measured-{found} runs it")


class MatchingParameters(MeasuredParameters):
    """Pictures held against their poses alone."""

    @model_validator(mode="after")
    def _task_is_matching(self) -> MatchingParameters:
        self._check_task("matching")
        return self


class MeasuredVelocityParameters(ChosenAlgorithms, OwnScores, MeasuredParameters):
    """Three pictures of a descent."""

    task = VELOCITY
    scored = ScoredVelocity

    algorithm: Annotated[str, Field(description="the velocity estimator under test, whose answers are judged")] = (
        "dimes"
    )
    dimes: Annotated[DimesOptions, Field(description="options of DIMES")] = DimesOptions()

    @model_validator(mode="after")
    def _task_is_velocity(self) -> MeasuredVelocityParameters:
        self._check_task("velocity")
        if "dimes" in self.algorithms:
            for picture in self.case.pictures:
                check_binning(self.dimes.binned_size, picture.size)
        return self


class MeasuredLandingParameters(ChosenAlgorithms, OwnScores, MeasuredParameters):
    """Two pictures of the ground."""

    task = LANDING
    scored = ScoredSite

    algorithm: Annotated[
        str, Field(description="the estimator of landing sites under test, whose answers are judged")
    ] = "hda"
    hda: Annotated[HdaOptions, Field(description="options of the hazard detection and avoidance")] = HdaOptions()

    @model_validator(mode="after")
    def _task_is_landing(self) -> MeasuredLandingParameters:
        self._check_task("landing")
        return self
