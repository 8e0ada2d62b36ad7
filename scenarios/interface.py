"""The interface between campaigns and scenarios: parameters, shared inputs, and running one case."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from pydantic import BaseModel

from marsyard.sim.streams import Streams

if TYPE_CHECKING:
    from marsyard.scenarios.estimators import Task
    from marsyard.scenarios.parts.named import Kind
from abc import ABC, abstractmethod
from functools import lru_cache
from typing import Generic, TypeVar

from marsyard.scenarios.algorithm_run import AlgorithmRun
from marsyard.scenarios.parts.named import SCORE, Kind
from marsyard.scenarios.views import SiteGround
from marsyard.sim.terrain import Site, TerrainBank, TerrainParameters

#: A value in a column of the results.
Scalar = float | int | str | bool


_recorder: ContextVar[Callable[[Mapping[str, Scalar]], None] | None] = ContextVar("_recorder", default=None)


def record_conditions(columns: Mapping[str, Scalar]) -> None:
    """Record columns of the running case that depend on no algorithm, before an algorithm runs.

    The engine stores them also if the case raises or its process is killed: they decide the populations of the case.
    `CaseResult.row` must contain them as well. A case may call this several times; no effect outside of a campaign.
    """
    recorder = _recorder.get()
    if recorder is not None:
        recorder(columns)


@contextmanager
def conditions_recorded_by(recorder: Callable[[Mapping[str, Scalar]], None]) -> Iterator[None]:
    """Pass the columns of `record_conditions` to a recorder."""
    token = _recorder.set(recorder)
    try:
        yield
    finally:
        _recorder.reset(token)


@dataclass(frozen=True)
class Failure:
    """Failure of the algorithm under test in an otherwise valid case.

    - outcome: a name of `marsyard.algorithms.answers.Fault`
    - error, trace: stored as `error` and `traceback`
    """

    outcome: str
    error: str
    trace: str


@dataclass(frozen=True)
class CaseResult:
    """One case, run and scored.

    - outcome: a member of the estimate's enumeration, or the name of the failure
    - answered: whether the algorithm under test reported an answer (the population `valid` of requirements)
    - row: scored errors (NaN without an answer) and the drawn values as read back from the simulated objects. Columns
      that may differ between two runs of one case have `time` in their name.
    - products: arrays and texts for the case's figures; stored only for cases that the campaign retains
    - failure: None if the algorithm under test answered
    """

    outcome: str
    answered: bool
    row: Mapping[str, Scalar]
    products: Mapping[str, Any] = field(default_factory=dict)
    failure: Failure | None = None


class Scenario(Protocol):
    """A family of cases. Implementations are stateless: a case depends on its arguments alone."""

    @property
    def name(self) -> str:
        """Name in campaign files."""

    @property
    def parameters_type(self) -> type[BaseModel]:
        """Model (pydantic, extra keys forbidden, frozen) of the values that a campaign may set or disperse."""

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Return the numbers of the inputs shared by cases that `prepare` builds once (the terrains of a bank)."""

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Build one shared input into the cache on disk if it is missing. Safe to call in parallel."""

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Run one case with its drawn parameters and its random streams; see `record_conditions`."""


@runtime_checkable
class SelectsInputs(Protocol):
    """A scenario that states the shared inputs of a case: only those of a campaign's cases are prepared."""

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """Return the numbers, out of `shared_inputs`, of the inputs of a case with these drawn parameters."""

    def missing_bytes(self, parameters: BaseModel, shared_input: int) -> int:
        """Return the bytes that preparing an input would add to the cache; 0 if it is there."""


@runtime_checkable
class HasAlgorithms(Protocol):
    """A scenario with selectable algorithms; its parameters contain an `AlgorithmSelection`."""

    @property
    def task(self) -> Task[Any, Any]:
        """Task of the algorithms."""

    @property
    def algorithm_table(self) -> tuple[str, ...]:
        """Table of the parameters with the selection; empty for the top level."""


@runtime_checkable
class HasParts(Protocol):
    """A scenario whose cases may use parts of a user (`marsyard.scenarios.parts`)."""

    @property
    def part_keys(self) -> Mapping[str, Kind]:
        """Kinds of the parts by the dotted path of the parameter that names them, one name or a list."""


ParametersType = TypeVar("ParametersType", bound=BaseModel)

#: Loads terrain `number` of the bank of a site: site, terrain, seed of the bank, number.
LoadGround = Callable[[Site, TerrainParameters, int, int], SiteGround]


class BaseScenario(Generic[ParametersType]):
    """A scenario with one type of parameters. Subclasses define `name` and `parameters_type`."""

    name: str
    parameters_type: type[ParametersType]

    def check_parameters(self, parameters: BaseModel) -> ParametersType:
        """Return the parameters with their type. Raises TypeError for those of another scenario."""
        if not isinstance(parameters, self.parameters_type):
            expected, given = self.parameters_type.__name__, type(parameters).__name__
            raise TypeError(f"the scenario {self.name} takes {expected}, not {given}")
        return parameters


class TerrainScenario(BaseScenario[ParametersType], ABC):
    """A scenario whose shared inputs are terrains; keeps the most recently used grounds in memory.

    By default algorithms and scores are selected at the top level of the parameters.
    """

    algorithm_table: tuple[str, ...] = ()
    part_keys: Mapping[str, Kind] = {"scores": SCORE}

    def __init__(self, cached_grounds: int = 0) -> None:
        self.load_ground: LoadGround = lru_cache(maxsize=cached_grounds)(SiteGround.from_bank)

    @abstractmethod
    def input_terrain(self, p: ParametersType, shared_input: int) -> tuple[TerrainBank, int]:
        """Return the bank of a shared input, and the number of its terrain there."""

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Build one terrain into the cache on disk."""
        bank, number = self.input_terrain(self.check_parameters(parameters), shared_input)
        bank.terrain(number)

    def missing_bytes(self, parameters: BaseModel, shared_input: int) -> int:
        """Return the bytes of a terrain that is not on disk."""
        bank, number = self.input_terrain(self.check_parameters(parameters), shared_input)
        return bank.missing_bytes(number)


def algorithm_result(
    attempt: AlgorithmRun[Any], answered: bool, row: Mapping[str, Scalar], products: Mapping[str, Any]
) -> CaseResult:
    """Combine an algorithm's answer or failure with its columns and products."""
    outcome = attempt.outcome(lambda answer: str(answer.outcome.name))
    return CaseResult(outcome, answered, row, products, attempt.failure)
