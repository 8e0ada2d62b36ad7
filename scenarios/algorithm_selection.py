"""Parameters that select the algorithms of a case."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar

from pydantic import Field, field_validator, model_validator

from marsyard.algorithms import exchange
from marsyard.scenarios.tasks import Task
from marsyard.sim.parameters import Parameters


def check_algorithms(task: Task[Any, Any], specs: Sequence[str]) -> None:
    """Raise ValueError if an algorithm does not exist or is listed twice."""
    for index, spec in enumerate(specs):
        task.check(spec)
        if spec in specs[:index]:
            raise ValueError(f"the algorithm '{spec}' is listed twice")


class AlgorithmSelection(Parameters):
    """Parameters of scenarios with selectable algorithms; subclasses define the field `algorithm`."""

    task: ClassVar[Task[Any, Any]]

    algorithm: str
    compared: Annotated[
        tuple[str, ...], Field(description="further algorithms, run on the same cases and compared with the first")
    ] = ()
    executable: Annotated[exchange.ExecutableLimits, Field(description="limits and isolation of custom algorithms")] = (
        exchange.ExecutableLimits()
    )

    @property
    def algorithms(self) -> tuple[str, ...]:
        """All algorithms; the first is the one under test."""
        return (self.algorithm, *self.compared)

    @property
    def options(self) -> Any:
        """Options that `make` gives to each algorithm of `task.shipped`; custom algorithms do not receive them.

        They are the field of the type `task.options`. Its name is chosen by the subclass (`dimes`, `hda`), since it is
        the name of the table in the campaign file. A subclass without such a field has the default options.
        """
        fields = (value for _, value in self)
        return next((value for value in fields if isinstance(value, self.task.options)), self.task.options())

    def make(self, algorithm: str, case: int) -> Any:
        """Create an algorithm for a case. Raises ValueError, and the exceptions of a user's constructor."""
        return self.task.make(algorithm, self.options, self.executable, case)

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
            raise ValueError(f"the algorithm '{self.algorithm}' is listed twice")
        return self

    @model_validator(mode="after")
    def _check_options(self) -> AlgorithmSelection:
        """Create the algorithms of Marsyard once, which checks their options."""
        for name in self.algorithms:
            if name in self.task.shipped:
                self.task.shipped[name](self.options)
        return self
