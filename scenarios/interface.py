"""What a campaign knows of a scenario: its parameters, what it prepares once, and how one case runs."""

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

#: A value that can stand in a column of the results.
Scalar = float | int | str | bool


_recorder: ContextVar[Callable[[Mapping[str, Scalar]], None] | None] = ContextVar("_recorder", default=None)


def record_conditions(columns: Mapping[str, Scalar]) -> None:
    """Records columns of the running case that depend on no algorithm; to be called before an algorithm runs.

    The engine stores them also where the case then raises or its process is killed, so that it is known to which
    populations the case belongs. A case may call this several times. Outside of a campaign it does nothing.

    Parameters
    ----------
    columns
        As in `CaseResult.row`, which must hold them again.
    """
    recorder = _recorder.get()
    if recorder is not None:
        recorder(columns)


@contextmanager
def conditions_recorded_by(recorder: Callable[[Mapping[str, Scalar]], None]) -> Iterator[None]:
    """Gives the columns of `record_conditions` to a recorder."""
    token = _recorder.set(recorder)
    try:
        yield
    finally:
        _recorder.reset(token)


@dataclass(frozen=True)
class Failure:
    """How the algorithm under test failed to answer, where it did no more than that: the case itself is whole.

    Attributes
    ----------
    outcome
        A name of `marsyard.algorithms.faults.Fault`.
    error, trace
        What is stored as `error` and `traceback`.
    """

    outcome: str
    error: str
    trace: str


@dataclass(frozen=True)
class CaseResult:
    """One case, run and scored.

    Attributes
    ----------
    outcome
        The name of the outcome: a member of the estimate's enumeration, or the failure's.
    answered
        Whether the algorithm under test reported an answer (the population `valid` of requirements).
    row
        What is stored of the case: scored errors (NaN where nothing was reported) and the drawn values as read back
        from the simulated objects. Columns that may differ between two runs of one case have `time` in their name.
    products
        Arrays and texts from which the case's figures are drawn; kept only for cases that the campaign retains.
    failure
        How the algorithm under test failed to answer; None where it did not.
    """

    outcome: str
    answered: bool
    row: Mapping[str, Scalar]
    products: Mapping[str, Any] = field(default_factory=dict)
    failure: Failure | None = None


class Scenario(Protocol):
    """A family of cases. Implementations are stateless: everything a case depends on is in its arguments."""

    @property
    def name(self) -> str:
        """The name by which campaign files ask for the scenario."""
        ...

    @property
    def parameters_type(self) -> type[BaseModel]:
        """The model (pydantic, extra keys forbidden, frozen) of every value that a campaign may set or disperse."""
        ...

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Numbers of the inputs that many cases share and that `prepare` builds once (the terrains of a bank)."""
        ...

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Builds one shared input into the cache on disk; does nothing if it is there. Safe to call in parallel."""
        ...

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Runs one case with its parameters (dispersions already drawn into them) and its random streams.

        Columns that depend on no algorithm should be recorded first (`record_conditions`).
        """
        ...


@runtime_checkable
class SelectsInputs(Protocol):
    """A scenario that states which shared inputs a case uses: only those of a campaign's own cases are prepared."""

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """Numbers, out of `shared_inputs`, of the inputs that a case with these drawn parameters uses."""
        ...

    def missing_bytes(self, parameters: BaseModel, shared_input: int) -> int:
        """Bytes on disk that preparing an input would add to the cache; 0 where the input is there."""
        ...


@runtime_checkable
class TakesAlgorithms(Protocol):
    """A scenario whose algorithms under test a campaign chooses.

    Among its parameters are `algorithm` (the one that is judged), `compared` (further ones, run on the same case) and
    `executable` (limits of those that are programs).
    """

    @property
    def task(self) -> Task[Any, Any]:
        """What the algorithms do."""
        ...

    @property
    def algorithm_table(self) -> tuple[str, ...]:
        """The table in the parameters that holds the three; empty where they stand at its top."""
        ...


@runtime_checkable
class TakesParts(Protocol):
    """A scenario whose cases can be made of a user's own parts (`marsyard.scenarios.parts`)."""

    @property
    def part_keys(self) -> Mapping[str, Kind]:
        """The parameters that name parts, by their dotted paths, each a name or a list of names; their kinds."""
        ...
