"""The parameters of each case: the campaign's own, with every dispersion's draw put in its place."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from pydantic import BaseModel

from marsyard.campaigns.definition.configuration import CampaignConfiguration
from marsyard.campaigns.sampling.correlation import Correlation
from marsyard.campaigns.sampling.design import (
    SMALLEST,
    Layout,
    Place,
    correlated,
    grid_probabilities,
    place_of,
    stratified,
)
from marsyard.campaigns.sampling.dispersion import Dispersion
from marsyard.campaigns.sampling.levels import Derived, Fixed, Grid
from marsyard.campaigns.sampling.ranges import InTurn, Normal
from marsyard.scenarios.interface import Scenario
from marsyard.sim.streams import Streams


@dataclass(frozen=True)
class Campaign:
    """A campaign ready to run.

    Attributes
    ----------
    configuration
        What its file and the options of the command line state, its parameters complete.
    scenario
        What its cases are made of.
    command
        The words of the command that runs it again; empty where it comes from no command.
    """

    configuration: CampaignConfiguration
    scenario: Scenario
    command: tuple[str, ...] = ()

    def streams(self, case: int) -> Streams:
        """The random streams of a case."""
        return Streams(seed=self.configuration.seed, campaign=self.configuration.name, case=case)

    def draws(self, case: int) -> dict[str, Any]:
        """What each dispersion draws for a case, by the path of its parameter, in the file's order.

        The nominal case draws nothing: its values are the parameters' own, except those that follow from others.

        Raises
        ------
        ValueError
            Where a formula has no value at what was drawn, or gives a distribution that is none.
        """
        dispersions = self.marginals
        probabilities = self.probabilities(case)
        values: dict[str, Any] = {}
        for path in self.order:
            dispersion = dispersions[path]
            if probabilities is None and not isinstance(dispersion, Fixed | Derived):
                values[path] = value_at(self.configuration.parameters, path)
                continue
            given = dispersion.given(self._numbers_for(dispersion, values))
            if isinstance(given, InTurn):
                values[path] = given.value(case)
                continue
            probability = 0.5 if probabilities is None else probabilities.get(path, 0.5)
            values[path] = given.quantile(probability)
        return {path: values[path] for path in dispersions}

    def _numbers_for(self, dispersion: Dispersion, drawn: Mapping[str, Any]) -> dict[str, Any]:
        """What a dispersion's formulas name: drawn values, and the parameters' own."""
        parameters = self.configuration.parameters
        return {name: drawn[name] if name in drawn else value_at(parameters, name) for name in dispersion.names}

    def probabilities(self, case: int) -> dict[str, float] | None:
        """The uniform number of each dispersion that is drawn or swept in a case; None for the nominal case."""
        configuration = self.configuration
        grids = {path: len(grid.points) for path, grid in configuration.grids.items()}
        place = place_of(configuration.design, configuration.blocks, configuration.grid_size, case)
        if place is None:
            return None
        at_random = configuration.design.kind == "random"
        drawn = self._independent(case) if at_random else self._stratified(place)
        return {**drawn, **grid_probabilities(grids, place.grid_point)}

    def _independent(self, case: int) -> dict[str, float]:
        """Each dispersion's own stream, and what correlated groups make of them."""
        streams = self.streams(case)
        found = {
            path: max(float(streams.generator(f"dispersion:{path}").random()), SMALLEST) for path in self.drawn_paths
        }
        for group in self.configuration.correlations:
            mixed = correlated(np.array([found[path] for path in group.parameters]), group.factor)
            found.update(zip(group.parameters, mixed.tolist(), strict=True))
        return found

    def _stratified(self, place: Place) -> dict[str, float]:
        """A row of the design that the case belongs to."""
        configuration = self.configuration
        layout = Layout(
            kind=configuration.design.kind,
            seed=configuration.seed,
            campaign=configuration.name,
            first=place.first,
            size=place.size,
            paths=self.drawn_paths,
            groups=self._groups,
        )
        return dict(zip(self.drawn_paths, stratified(layout)[place.index].tolist(), strict=True))

    @cached_property
    def marginals(self) -> Mapping[str, Dispersion]:
        """The dispersions, those of a covariance with the standard deviations that it states."""
        return {path: self._marginal(path, one) for path, one in self.configuration.dispersions.items()}

    def _marginal(self, path: str, dispersion: Dispersion) -> Dispersion:
        stated = (group.standard_deviation(path) for group in self.configuration.correlations)
        sd = next((one for one in stated if one is not None), None)
        if sd is None or not isinstance(dispersion, Normal):
            return dispersion
        return Normal.model_validate({**dispersion.model_dump(), "sd": sd})

    @cached_property
    def drawn_paths(self) -> tuple[str, ...]:
        """The dispersions that take a random number, in the file's order."""
        stated = self.configuration.dispersions.items()
        return tuple(path for path, one in stated if not isinstance(one, Grid | Fixed | Derived | InTurn))

    @cached_property
    def _groups(self) -> tuple[tuple[tuple[int, ...], tuple[tuple[float, ...], ...]], ...]:
        """Correlated groups as a `Layout` has them."""
        return tuple(self._group(group) for group in self.configuration.correlations)

    def _group(self, group: Correlation) -> tuple[tuple[int, ...], tuple[tuple[float, ...], ...]]:
        places = tuple(self.drawn_paths.index(path) for path in group.parameters)
        return places, tuple(tuple(row) for row in group.factor.tolist())

    @cached_property
    def order(self) -> tuple[str, ...]:
        """The dispersions, each behind those that its formulas name.

        Raises
        ------
        ValueError
            Where formulas name one another in a circle.
        """
        return in_order_of_need({path: one.names for path, one in self.configuration.dispersions.items()})

    def base_parameters(self) -> BaseModel:
        """The parameters before any draw."""
        return self.scenario.parameters_type.model_validate(self.configuration.parameters)

    def parameters(self, case: int) -> BaseModel:
        """The parameters of a case.

        Raises
        ------
        ValueError
            Where the drawn values together are refused by the scenario, or cannot be drawn.
        """
        return self.with_values(self.draws(case))

    def with_values(self, values: Mapping[str, Any]) -> BaseModel:
        """The campaign's parameters with other values at some paths."""
        tree: Any = self.configuration.parameters
        for path, value in values.items():
            tree = replaced(tree, path.split("."), value)
        return self.scenario.parameters_type.model_validate(tree)


def in_order_of_need(needs: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Names, each behind those of them that it needs; otherwise as they come. ValueError where that is a circle."""
    done: dict[str, None] = {}
    while len(done) < len(needs):
        ready = [name for name in needs if name not in done and all(one in done for one in needs[name] if one in needs)]
        if not ready:
            circle = [name for name in needs if name not in done]
            raise ValueError(f"formulas depend on one another in a circle: {', '.join(circle)}")
        done.update(dict.fromkeys(ready))
    return tuple(done)


def replaced(tree: Any, path: Sequence[str], value: Any) -> Any:
    """A copy of nested tables and lists with another value at a path."""
    if not path:
        return value
    head, *rest = path
    if isinstance(tree, list):
        place = int(head)
        return [*tree[:place], replaced(tree[place], rest, value), *tree[place + 1 :]]
    return {**tree, head: replaced(tree[head], rest, value)}


def value_at(tree: Any, path: str) -> Any:
    """The value at a dotted path in nested tables and lists.

    Raises
    ------
    ValueError
        Where there is none.
    """
    here = tree
    for part in path.split("."):
        try:
            here = here[int(part)] if isinstance(here, list) else here[part]
        except (KeyError, IndexError, TypeError, ValueError):
            raise ValueError(f"there is no parameter '{path}'") from None
    return here


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
