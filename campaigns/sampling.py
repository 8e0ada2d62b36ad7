"""The parameters of each case: the campaign's own, with every dispersion's draw put in its place."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from campaigns.configuration import CampaignConfiguration
from scenarios.interface import Scenario
from sim.streams import Streams

#: Half the step of `Generator.random`: keeps a draw off 0, where distributions with endless tails have no value.
_SMALLEST = 2.0**-54


@dataclass(frozen=True)
class Campaign:
    """A campaign ready to run: its configuration, its parameters complete, and the scenario it is made of."""

    configuration: CampaignConfiguration
    scenario: Scenario

    def streams(self, case: int) -> Streams:
        """The random streams of a case."""
        return Streams(seed=self.configuration.seed, campaign=self.configuration.name, case=case)

    def draws(self, case: int) -> dict[str, Any]:
        """What each dispersion draws for a case, by the path of its parameter."""
        streams = self.streams(case)
        return {
            path: dispersion.quantile(max(float(streams.generator(f"dispersion:{path}").random()), _SMALLEST))
            for path, dispersion in self.configuration.dispersions.items()
        }

    def base_parameters(self) -> BaseModel:
        """The parameters before any draw."""
        return self.scenario.parameters_type.model_validate(self.configuration.parameters)

    def parameters(self, case: int) -> BaseModel:
        """The parameters of a case.

        Raises
        ------
        pydantic.ValidationError
            Where the drawn values together are refused by the scenario.
        """
        return self.with_values(self.draws(case))

    def with_values(self, values: Mapping[str, Any]) -> BaseModel:
        """The campaign's parameters with other values at some paths."""
        tree: Any = self.configuration.parameters
        for path, value in values.items():
            tree = replaced(tree, path.split("."), value)
        return self.scenario.parameters_type.model_validate(tree)


def replaced(tree: Any, path: Sequence[str], value: Any) -> Any:
    """A copy of nested tables and lists with another value at a path."""
    if not path:
        return value
    head, *rest = path
    if isinstance(tree, list):
        place = int(head)
        return [*tree[:place], replaced(tree[place], rest, value), *tree[place + 1 :]]
    return {**tree, head: replaced(tree[head], rest, value)}


def leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every value in nested tables and lists with its dotted path."""
    if isinstance(tree, Mapping):
        for name, inner in tree.items():
            yield from leaves(inner, f"{path}.{name}" if path else str(name))
    elif isinstance(tree, list) and tree:
        for place, inner in enumerate(tree):
            yield from leaves(inner, f"{path}.{place}")
    else:
        yield path, tree
