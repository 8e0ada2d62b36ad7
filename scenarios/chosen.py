"""The parameters by which a campaign chooses its algorithms."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from marsyard.algorithms.exchange import ExecutableLimits
from marsyard.scenarios.estimators import Task, check_chosen


class ChosenAlgorithms(BaseModel):
    """What the parameters of every scenario hold that lets algorithms be chosen; subclasses add `algorithm` itself."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    task: ClassVar[Task[Any, Any]]

    algorithm: str
    compared: Annotated[
        tuple[str, ...], Field(description="further algorithms, run on the same cases and compared with the first")
    ] = ()
    executable: Annotated[ExecutableLimits, Field(description="what an algorithm that is a program may use")] = (
        ExecutableLimits()
    )

    @property
    def algorithms(self) -> tuple[str, ...]:
        """All of them, the one that is judged first."""
        return (self.algorithm, *self.compared)

    @field_validator("algorithm")
    @classmethod
    def _algorithm_is_there(cls, name: str) -> str:
        cls.task.check(name)
        return name

    @field_validator("compared")
    @classmethod
    def _compared_are_there(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        check_chosen(cls.task, names)
        return names

    @model_validator(mode="after")
    def _are_told_apart(self) -> ChosenAlgorithms:
        if self.algorithm in self.compared:
            raise ValueError(f"the algorithm '{self.algorithm}' is named twice")
        return self
