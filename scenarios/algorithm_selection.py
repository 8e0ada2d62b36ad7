"""Parameters that select the algorithms of a campaign."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from marsyard.algorithms.exchange import ExecutableLimits
from marsyard.scenarios.estimators import Task, check_algorithms


class AlgorithmSelection(BaseModel):
    """Parameters of scenarios with selectable algorithms; subclasses define the field `algorithm`."""

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
        """All algorithms; the first is the one under test."""
        return (self.algorithm, *self.compared)

    @field_validator("algorithm")
    @classmethod
    def _check_algorithm(cls, name: str) -> str:
        cls.task.check(name)
        return name

    @field_validator("compared")
    @classmethod
    def _check_compared(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        check_algorithms(cls.task, names)
        return names

    @model_validator(mode="after")
    def _check_distinct(self) -> AlgorithmSelection:
        if self.algorithm in self.compared:
            raise ValueError(f"the algorithm '{self.algorithm}' is named twice")
        return self
