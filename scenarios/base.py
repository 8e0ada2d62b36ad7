"""What scenarios share: the check of their parameters' type, and shared inputs that are terrains of a bank."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, Generic, TypeVar

from pydantic import BaseModel

from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.trial import Attempt, Judged
from marsyard.scenarios.views import SiteGround
from marsyard.sim.terrain import Site, TerrainBank, TerrainParameters

Stated = TypeVar("Stated", bound=BaseModel)

#: Loads terrain `number` of the bank of a site: site, terrain, seed of the bank, number.
LoadGround = Callable[[Site, TerrainParameters, int, int], SiteGround]


class BaseScenario(Generic[Stated]):
    """A scenario whose parameters are of one type. Subclasses state `name` and `parameters_type`."""

    name: str
    parameters_type: type[Stated]

    def checked(self, parameters: BaseModel) -> Stated:
        """Return the parameters. Raises TypeError where they are another scenario's."""
        if not isinstance(parameters, self.parameters_type):
            expected, found = self.parameters_type.__name__, type(parameters).__name__
            raise TypeError(f"the scenario {self.name} takes {expected}, not {found}")
        return parameters


class TerrainScenario(BaseScenario[Stated], ABC):
    """A scenario whose shared inputs are terrains.

    Parameters
    ----------
    grounds
        Grounds that are kept in memory, the least recently used ones dropped first. A ground is a function of its
        key: which ones are kept changes no result.
    """

    def __init__(self, grounds: int = 0) -> None:
        self.load_ground: LoadGround = lru_cache(maxsize=grounds)(SiteGround.from_bank)

    @abstractmethod
    def input_terrain(self, p: Stated, shared_input: int) -> tuple[TerrainBank, int]:
        """The bank of a shared input, and the number of its terrain there."""

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Build one terrain into the cache on disk."""
        bank, number = self.input_terrain(self.checked(parameters), shared_input)
        bank.terrain(number)

    def missing_bytes(self, parameters: BaseModel, shared_input: int) -> int:
        """Bytes of a terrain that is not on disk."""
        bank, number = self.input_terrain(self.checked(parameters), shared_input)
        return bank.missing_bytes(number)


def judged_attempt(
    attempt: Attempt[Any], answered: bool, row: Mapping[str, Scalar], products: Mapping[str, Any]
) -> Judged:
    """An algorithm's answer, or its failure to give one, with its columns and products."""
    return Judged(
        outcome=attempt.outcome(lambda answer: str(answer.outcome.name)),
        answered=answered,
        row=row,
        products=products,
        failure=attempt.failure,
    )
