"""A campaign and the parameters of each of its cases: the campaign's parameters with the case's sampled values.

A path is the dotted path of a parameter (`marsyard.campaigns.definition.parameter_paths`). A study evaluates cases at
points that it chooses (`marsyard.campaigns.sampling.study_points`).
"""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pydantic import BaseModel

from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.definition.parameter_paths import replace_values, value_at
from marsyard.campaigns.sampling.correlation import MIN_DRAW, CorrelatedGroup, correlate_groups
from marsyard.campaigns.sampling.design import build_stratified_design, compute_grid_quantiles, locate_case
from marsyard.campaigns.sampling.dispersion_base import Dispersion
from marsyard.campaigns.sampling.dispersions import CyclicInteger, Derived, Fixed, GridDispersion, Normal
from marsyard.campaigns.sampling.study_points import StudyPoint, transform_to_uniform
from marsyard.scenarios.error_sources import error_sources
from marsyard.scenarios.interface import Scenario
from marsyard.sim.streams import Streams, stream_name

#: Name of the record of confirmations in the current folder; git searches the history for it.
CONFIRMATIONS_FILE = "confirmations.jsonl"


@dataclass(frozen=True)
class Campaign:
    """A campaign ready to run.

    - definition: contents of the campaign file, changed by command-line options, with complete parameters
    - scenario: scenario of the campaign's cases
    - command: words of the command that repeats the campaign; empty if no command started it
    - file: campaign file; None if the campaign was created or loaded from a record
    - confirms: whether the run is a confirmation (`marsyard.campaigns.definition.evidence`)
    - confirmations: record of confirmations
    - calibration_overlap: fraction of the cases of a confirmation on terrains of calibration runs; None if unknown
    """

    definition: CampaignDefinition
    scenario: Scenario
    command: tuple[str, ...] = ()
    file: Path | None = None
    confirms: bool = False
    confirmations: Path = Path(CONFIRMATIONS_FILE)
    calibration_overlap: float | None = None

    def _repr_html_(self) -> str:
        """Table of the campaign's definition for notebooks."""
        definition = self.definition
        rows = {
            "scenario": definition.scenario,
            "cases": definition.total_cases,
            "seed": definition.seed,
            "dispersions": ", ".join(definition.dispersions),
            "requirements": ", ".join(item.id for item in definition.requirements),
        }
        cells = (f"<tr><th>{name}</th><td>{html.escape(str(value))}</td></tr>" for name, value in rows.items())
        return f"<div><h4>{html.escape(definition.name)}</h4><table>{''.join(cells)}</table></div>"

    def streams(self, case: int) -> Streams:
        """Create the random streams of a case."""
        return Streams(seed=self.definition.seed, campaign=self.definition.name, case=case)

    def streams_at(self, point: StudyPoint) -> Streams:
        """Create the random streams of a case at a point of a study."""
        return replace(self.streams(point.stream), blend=point.blend)

    def at(self, point: StudyPoint) -> Campaign:
        """Return the campaign with the parameters that a point of a study replaces."""
        if not point.values:
            return self
        parameters = replace_values(self.definition.parameters, dict(point.values))
        return replace(self, definition=self.definition.model_copy(update={"parameters": parameters}))

    def draws(self, case: int) -> dict[str, Any]:
        """Compute the sampled values of a case by parameter path, in the order of the file.

        The values of the nominal case are the campaign's parameters; only fixed and derived values are computed.
        Raises ValueError if a formula is undefined for the sampled values or results in an invalid distribution.
        """
        return self._evaluate(self.probabilities(case), case)

    def draws_at(self, point: StudyPoint) -> dict[str, Any]:
        """Compute the values of the dispersions at a point of a study. Raises ValueError like `draws`."""
        uniform = transform_to_uniform(point.coordinates, self.drawn_paths, self.definition.correlations)
        return self._evaluate(uniform, point.stream, point.nominal, dict(point.values))

    def _evaluate(
        self,
        probabilities: Mapping[str, float] | None,
        case: int,
        nominal: Sequence[str] = (),
        replaced: Mapping[str, Any] = MappingProxyType({}),
    ) -> dict[str, Any]:
        """Evaluate the dispersions at cumulative probabilities.

        Dispersions in `replaced` have the value there, also fixed and derived ones. Those in `nominal` have the value
        of the campaign's parameter; all of them if `probabilities` is None.
        Dispersions without a random number are evaluated at the probability 0.5, which does not affect their values.
        """
        parameters = self.definition.parameters
        values: dict[str, Any] = {}
        for path in self.order:
            dispersion = self.marginals[path]
            if path in replaced:
                values[path] = replaced[path]
                continue
            is_nominal = probabilities is None or path in nominal
            if is_nominal and not isinstance(dispersion, Fixed | Derived):
                values[path] = value_at(parameters, path)
                continue
            inputs = {name: values[name] if name in values else value_at(parameters, name) for name in dispersion.names}
            distribution = dispersion.insert_values(inputs)
            if isinstance(distribution, CyclicInteger):
                values[path] = distribution.value(case)
            else:
                values[path] = distribution.quantile(0.5 if probabilities is None else probabilities.get(path, 0.5))
        return {path: values[path] for path in self.marginals}

    def probabilities(self, case: int) -> dict[str, float] | None:
        """Compute the cumulative probability of each random or grid dispersion of a case; None for the nominal case."""
        definition, paths = self.definition, self.drawn_paths
        position = locate_case(definition.design, definition.blocks, definition.grid_size, case)
        if position is None:
            return None
        if definition.design.kind == "random":
            numbers = correlate_groups(self.draw_uniform(case), definition.correlations)
        else:
            groups = tuple(
                CorrelatedGroup(tuple(map(paths.index, group.parameters)), tuple(map(tuple, group.factor.tolist())))
                for group in definition.correlations
            )
            design = build_stratified_design(
                definition.design.kind,
                definition.seed,
                definition.name,
                position.first_case,
                position.case_count,
                tuple(map(stream_name, paths)),
                groups,
            )
            numbers = dict(zip(paths, design[position.design_index].tolist(), strict=True))
        grids = {path: len(grid.points) for path, grid in definition.grids.items()}
        return {**numbers, **compute_grid_quantiles(grids, position.grid_point)}

    def draw_uniform(self, case: int) -> dict[str, float]:
        """Draw the independent uniform numbers of a case of a random design, before the correlation of groups."""
        streams = self.streams(case)
        uniform = {path: streams.generator(f"dispersion:{stream_name(path)}").random() for path in self.drawn_paths}
        return {path: max(float(value), MIN_DRAW) for path, value in uniform.items()}

    @cached_property
    def marginals(self) -> Mapping[str, Dispersion]:
        """Dispersions by path; dispersions in a covariance matrix have the standard deviations of the matrix."""
        marginals: dict[str, Dispersion] = dict(self.definition.dispersions)
        for group in self.definition.correlations:
            for index, row in enumerate(group.covariance or ()):
                path, standard_deviation = group.parameters[index], math.sqrt(row[index])
                marginals[path] = Normal.model_validate({**marginals[path].model_dump(), "sd": standard_deviation})
        return marginals

    @cached_property
    def drawn_paths(self) -> tuple[str, ...]:
        """Paths of the dispersions that use a random number, in the order of the file."""
        dispersions = self.definition.dispersions.items()
        return tuple(
            path for path, item in dispersions if not isinstance(item, GridDispersion | Fixed | Derived | CyclicInteger)
        )

    @cached_property
    def cyclic_paths(self) -> tuple[str, ...]:
        """Paths of the dispersions whose number follows the number of the case or, in a study, of its streams."""
        dispersions = self.definition.dispersions.items()
        return tuple(path for path, item in dispersions if isinstance(item, CyclicInteger))

    @cached_property
    def order(self) -> tuple[str, ...]:
        """Paths in the order of evaluation: a path follows those in its formulas. Raises ValueError for a cycle."""
        inputs = {path: dispersion.names for path, dispersion in self.definition.dispersions.items()}
        sequence: dict[str, None] = {}
        while len(sequence) < len(inputs):
            remaining = [path for path in inputs if path not in sequence]
            ready = [path for path in remaining if all(name in sequence for name in inputs[path] if name in inputs)]
            if not ready:
                raise ValueError(f"formulas depend on each other in a cycle: {', '.join(remaining)}")
            sequence.update(dict.fromkeys(ready))
        return tuple(sequence)

    def base_parameters(self) -> BaseModel:
        """Create the parameters of the campaign without sampled values."""
        return self.scenario.parameters_type.model_validate(self.definition.parameters)

    def parameters(self, case: int) -> BaseModel:
        """Create the parameters of a case. Raises ValueError if sampling fails or the scenario rejects the values."""
        return self.with_values(self.draws(case))

    def with_values(self, values: Mapping[str, Any], removed: Sequence[str] = ()) -> BaseModel:
        """Create the campaign's parameters with other values at some paths, and without the `removed` error sources."""
        tree = replace_values(self.definition.parameters, values)
        for source in error_sources(self.definition.scenario) if removed else ():
            if source.name in removed:
                tree = replace_values(tree, source.exact_values(tree))
        return self.scenario.parameters_type.model_validate(tree)
