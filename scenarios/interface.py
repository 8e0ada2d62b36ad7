"""Interface between campaigns and scenarios: parameters, shared inputs, and running one case."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from pydantic import BaseModel

from marsyard.sim.streams import Streams

if TYPE_CHECKING:
    from marsyard.scenarios.parts.named import PartKind
    from marsyard.scenarios.tasks import Task

#: Value of a column of the results.
Scalar = float | int | str | bool


@dataclass(frozen=True)
class Failure:
    """Failure of the algorithm under test in an otherwise valid case.

    - outcome: a name of `marsyard.algorithms.faults.Fault`
    - error, trace: message and traceback, stored in the columns `error` and `traceback`
    """

    outcome: str
    error: str
    trace: str


@dataclass(frozen=True)
class CaseResult:
    """Result of a case that was run and scored.

    - outcome: a member of the estimate's enumeration, or the name of the failure
    - answered: whether the algorithm under test reported an answer (the population `valid` of requirements)
    - row: values by column: errors (NaN without an answer), and conditions, read from the simulated objects. The engine
      adds the sampled values. Columns that may differ between two runs of one case have `time` in their name.
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
        """Run one case with its sampled parameters and its random streams."""


@runtime_checkable
class SelectsInputs(Protocol):
    """A scenario that reports the shared inputs of a case: only the inputs of a campaign's cases are prepared."""

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """Return the numbers, out of `shared_inputs`, of the inputs of a case with these sampled parameters."""

    def missing_bytes(self, parameters: BaseModel, shared_input: int) -> int:
        """Return the bytes that preparing an input would add to the cache; 0 if it is cached."""


@runtime_checkable
class IdentifiesTerrains(Protocol):
    """A scenario whose terrains have an identity: two cases with equal identities use the same terrain."""

    def terrain_identities(self, parameters: BaseModel, case: int) -> tuple[str, ...]:
        """Return the identities of the terrains of a case with these sampled parameters."""


@runtime_checkable
class HasRecordedCases(Protocol):
    """A scenario with recorded cases, which are not random draws: a campaign runs each of them once."""

    @property
    def recorded_case(self) -> str:
        """Path of the parameter that selects the recorded case."""


@runtime_checkable
class HasAlgorithms(Protocol):
    """A scenario whose algorithms are selected in the campaign file.

    The keys are `algorithm` (under test) and `compared` (further algorithms on the same cases), the fields of
    `AlgorithmSelection` (`marsyard.scenarios.algorithm_selection`). A scenario without these keys does not implement
    this protocol.
    """

    @property
    def task(self) -> Task[Any, Any]:
        """Task that the algorithms solve, such as velocity estimation; it lists the accepted algorithms."""

    @property
    def algorithm_table(self) -> tuple[str, ...]:
        """Path of the TOML table, below `[parameters]`, that contains the keys `algorithm` and `compared`.

        ``("drive",)`` for `[parameters.drive]`; ``()`` for `[parameters]` itself.
        """


@runtime_checkable
class HasParts(Protocol):
    """A scenario in which users can replace parts of the simulation: motions, instruments or scores.

    A campaign file selects a part by its name (`marsyard.scenarios.parts`, docs/custom-parts.md).
    """

    @property
    def part_keys(self) -> Mapping[str, PartKind]:
        """Kind of part for each parameter that selects parts.

        A key is the dotted path of the parameter, such as ``"flight.motion"``. The value of the parameter in the
        campaign file is the name of one part, or a list of names.
        """
