"""A campaign and the parameters of each of its cases: the campaign's parameters with the drawn values inserted."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from pydantic import BaseModel

from marsyard.campaigns.definition.configuration import CampaignConfiguration
from marsyard.campaigns.sampling.design import (
    MIN_DRAW,
    build_stratified_design,
    compute_grid_probabilities,
    correlate_uniform,
    locate_case,
)
from marsyard.campaigns.sampling.dispersion import Dispersion
from marsyard.campaigns.sampling.dispersions import Derived, Fixed, Grid, InTurn, Normal
from marsyard.scenarios.interface import Scenario
from marsyard.sim.parameters import stream_name
from marsyard.sim.streams import Streams


@dataclass(frozen=True)
class Campaign:
    """A campaign ready to run.

    configuration: statements of its file and of the command line's options, with complete parameters.
    scenario: the scenario that its cases run.
    command: words of the command that runs it again; empty where it was not started by a command.
    """

    configuration: CampaignConfiguration
    scenario: Scenario
    command: tuple[str, ...] = ()

    def streams(self, case: int) -> Streams:
        """Random streams of a case."""
        return Streams(seed=self.configuration.seed, campaign=self.configuration.name, case=case)

    def draws(self, case: int) -> dict[str, Any]:
        """Drawn values of a case, by the path of the parameter, in the file's order.

        The nominal case draws nothing: its values are the campaign's parameters, except derived ones.
        Raises ValueError where a formula has no value for the drawn values, or gives an invalid distribution.
        """
        parameters = self.configuration.parameters
        probabilities = self.probabilities(case)
        values: dict[str, Any] = {}
        for path in self.order:
            dispersion = self.marginals[path]
            if probabilities is None and not isinstance(dispersion, Fixed | Derived):
                values[path] = value_at(parameters, path)
                continue
            named = {name: values[name] if name in values else value_at(parameters, name) for name in dispersion.names}
            given = dispersion.insert_values(named)
            if isinstance(given, InTurn):
                values[path] = given.value(case)
            else:
                values[path] = given.quantile(0.5 if probabilities is None else probabilities.get(path, 0.5))
        return {path: values[path] for path in self.marginals}

    def probabilities(self, case: int) -> dict[str, float] | None:
        """Uniform number of each dispersion that is drawn or swept in a case; None for the nominal case."""
        stated, paths = self.configuration, self.drawn_paths
        position = locate_case(stated.design, stated.blocks, stated.grid_size, case)
        if position is None:
            return None
        grid_point, first, size, index = position
        if stated.design.kind == "random":
            streams = self.streams(case)
            uniform = {path: streams.generator(f"dispersion:{stream_name(path)}").random() for path in paths}
            drawn = {path: max(float(number), MIN_DRAW) for path, number in uniform.items()}
            for group in stated.correlations:
                mixed = correlate_uniform(np.array([drawn[path] for path in group.parameters]), group.factor)
                drawn.update(zip(group.parameters, mixed.tolist(), strict=True))
        else:
            groups = tuple(
                (tuple(map(paths.index, group.parameters)), tuple(map(tuple, group.factor.tolist())))
                for group in stated.correlations
            )
            design = build_stratified_design(
                stated.design.kind, stated.seed, stated.name, first, size, tuple(map(stream_name, paths)), groups
            )
            drawn = dict(zip(paths, design[index].tolist(), strict=True))
        grids = {path: len(grid.points) for path, grid in stated.grids.items()}
        return {**drawn, **compute_grid_probabilities(grids, grid_point)}

    @cached_property
    def marginals(self) -> Mapping[str, Dispersion]:
        """Dispersions by path; those in a covariance with the standard deviations that it states."""
        marginals: dict[str, Dispersion] = dict(self.configuration.dispersions)
        for group in self.configuration.correlations:
            for index, row in enumerate(group.covariance or ()):
                path, sd = group.parameters[index], math.sqrt(row[index])
                marginals[path] = Normal.model_validate({**marginals[path].model_dump(), "sd": sd})
        return marginals

    @cached_property
    def drawn_paths(self) -> tuple[str, ...]:
        """Dispersions that take a random number, in the file's order."""
        dispersions = self.configuration.dispersions.items()
        return tuple(path for path, one in dispersions if not isinstance(one, Grid | Fixed | Derived | InTurn))

    @cached_property
    def order(self) -> tuple[str, ...]:
        """Dispersions, each after those that its formulas name. Raises ValueError where formulas form a cycle."""
        needs = {path: one.names for path, one in self.configuration.dispersions.items()}
        done: dict[str, None] = {}
        while len(done) < len(needs):
            cycle = [path for path in needs if path not in done]
            ready = [path for path in cycle if all(one in done for one in needs[path] if one in needs)]
            if not ready:
                raise ValueError(f"formulas depend on one another in a circle: {', '.join(cycle)}")
            done.update(dict.fromkeys(ready))
        return tuple(done)

    def base_parameters(self) -> BaseModel:
        """Parameters before any draw."""
        return self.scenario.parameters_type.model_validate(self.configuration.parameters)

    def parameters(self, case: int) -> BaseModel:
        """Parameters of a case. Raises ValueError where values cannot be drawn, or the scenario refuses them."""
        return self.with_values(self.draws(case))

    def with_values(self, values: Mapping[str, Any]) -> BaseModel:
        """Campaign's parameters with other values at some paths."""
        tree: Any = self.configuration.parameters
        for path, value in values.items():
            tree = replace_value(tree, path.split("."), value)
        return self.scenario.parameters_type.model_validate(tree)


def replace_value(tree: Any, path: Sequence[str], value: Any) -> Any:
    """Copy nested tables and lists with another value at a path."""
    if not path:
        return value
    head, *rest = path
    if isinstance(tree, list):
        index = int(head)
        return [*tree[:index], replace_value(tree[index], rest, value), *tree[index + 1 :]]
    return {**tree, head: replace_value(tree[head], rest, value)}


def value_at(tree: Any, path: str) -> Any:
    """Value at a dotted path in nested tables and lists. Raises ValueError where there is none."""
    node = tree
    for part in path.split("."):
        try:
            node = node[int(part)] if isinstance(node, list) else node[part]
        except (KeyError, IndexError, TypeError, ValueError):
            raise ValueError(f"there is no parameter '{path}'") from None
    return node


def find_value(tree: Any, path: str) -> Any:
    """Value at a dotted path in nested tables and lists; an empty tuple where there is none."""
    try:
        return value_at(tree, path)
    except ValueError:
        return ()


def leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value in nested tables and lists with its dotted path."""
    if isinstance(tree, Mapping):
        for name, inner in tree.items():
            yield from leaves(inner, f"{path}.{name}" if path else str(name))
    elif isinstance(tree, list) and tree:
        for index, inner in enumerate(tree):
            yield from leaves(inner, f"{path}.{index}")
    else:
        yield path, tree
