"""Base class of scenarios: one type of parameters, and no inputs that several cases share."""

from typing import Generic, TypeVar

from pydantic import BaseModel

ParametersType = TypeVar("ParametersType", bound=BaseModel)


class TypedScenario(Generic[ParametersType]):
    """A scenario with one type of parameters. Subclasses define `name`, `parameters_type` and `run`."""

    name: str
    parameters_type: type[ParametersType]

    def check_parameters(self, parameters: BaseModel) -> ParametersType:
        """Return the parameters with their type. Raises TypeError for parameters of another scenario."""
        if not isinstance(parameters, self.parameters_type):
            expected_name, actual_name = self.parameters_type.__name__, type(parameters).__name__
            raise TypeError(f"the scenario {self.name} needs {expected_name}, not {actual_name}")
        return parameters

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Return the numbers of the inputs shared by cases; here none."""
        return ()

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Build one shared input into the cache on disk; here there is none."""
