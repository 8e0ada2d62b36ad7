"""Base class of scenarios whose cases use terrains of a bank: the terrains are prepared once and shared by cases."""

from collections.abc import Mapping
from typing import Any, Protocol

from pydantic import BaseModel

from marsyard.scenarios.parts.named import SCORE, PartKind
from marsyard.scenarios.typed_scenario import ParametersType, TypedScenario
from marsyard.sim.terrain import TerrainBank


class BankLocation(Protocol):
    """Terrain of a bank: number of terrains in the bank, its seed, and number of the terrain in it, from 0."""

    bank: int
    bank_seed: int
    terrain: int


class TerrainScenario(TypedScenario[ParametersType]):
    """A scenario whose shared inputs are terrains.

    `shared_input` is the number of an input that several cases use, one of `Scenario.shared_inputs`.

    - max_stored_terrains: largest bank whose terrains can be stored on disk before the cases; each case on a larger
      bank builds its terrain in memory
    - algorithm_table: path of the parameter table that selects the algorithms; by default the top level
    - part_keys: parameter keys that select custom parts, and the kind of each part; by default only scores
    """

    max_stored_terrains: int = 64
    algorithm_table: tuple[str, ...] = ()
    part_keys: Mapping[str, PartKind] = {"scores": SCORE}

    def location(self, p: ParametersType) -> BankLocation:
        """Return the terrain of the parameters; by default their table `location`."""
        location: BankLocation = p.location  # type: ignore[attr-defined]
        return location

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Return the numbers of the bank's terrains; empty for a large bank, whose terrains are built by the cases."""
        bank = self.location(self.check_parameters(parameters)).bank
        return tuple(range(bank)) if bank <= self.max_stored_terrains else ()

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """Return the number of the case's terrain in the bank; it is no shared input if the bank is large."""
        return (self.location(self.check_parameters(parameters)).terrain,)

    def input_terrain(self, p: Any, shared_input: int) -> tuple[TerrainBank, int]:
        """Return the bank of a shared input, and the number of the terrain in the bank."""
        return TerrainBank(p.terrain, self.location(p).bank_seed), shared_input

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Build the terrain of a shared input and store it in the cache on disk."""
        bank, number = self.input_terrain(self.check_parameters(parameters), shared_input)
        bank.store(number)

    def terrain_identities(self, parameters: BaseModel, case: int) -> tuple[str, ...]:
        """Return the identities of the terrains of a case with these sampled parameters."""
        p = self.check_parameters(parameters)
        banks = (self.input_terrain(p, shared_input) for shared_input in self.case_inputs(p, case))
        return tuple(bank.identity(number) for bank, number in banks)

    def missing_bytes(self, parameters: BaseModel, shared_input: int) -> int:
        """Return the size in bytes of a terrain that is not yet in the cache on disk; 0 if it is."""
        bank, number = self.input_terrain(self.check_parameters(parameters), shared_input)
        return bank.missing_bytes(number)
