"""Model of a campaign file: scenario, cases, parameters, dispersions, requirements, limits."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from marsyard.campaigns.definition.toml_models import Key
from marsyard.campaigns.errors import suggest_similar
from marsyard.campaigns.sampling.correlation import Correlation
from marsyard.campaigns.sampling.design import Design
from marsyard.campaigns.sampling.dispersions import AnyDispersion, GridDispersion, Normal
from marsyard.sim.parameters import Parameters

#: Maximum number of cases of a campaign.
MAX_CASES = 1_000_000_000
_Cases = Annotated[int, Field(strict=True, ge=1, le=MAX_CASES)]
_Count = Annotated[int, Field(strict=True, ge=1)]
_PositiveNumber = Annotated[float, Field(strict=True, gt=0.0, allow_inf_nan=False)]
_Fraction = Annotated[float, Field(strict=True, gt=0.0, lt=1.0)]
_Text = Annotated[str, Field(min_length=1)]
#: Populations of every campaign; any other name in a population is a boolean column.
POPULATIONS = ("all", "completed", "valid")


class Requirement(Parameters):
    """A condition that at least a fraction `probability` of a population of cases must meet, at a confidence.

    With a `bound`, the metric's absolute value must not exceed the bound; a case without a number fails. Without a
    bound, the metric is a boolean column (`answered`, for example) that must be true.

    `population` is `all`, `completed`, `valid` (answered cases) or a boolean column; several are joined by " and ". A
    metric with a bound may be a sum of columns, joined by " + "; it is multiplied by `scale` before the comparison.
    `decide_by = "estimate"` is for requirements whose source defines no confidence: if the bounds do not result in
    PASS, the observed rate is compared with the probability. The verdict is then at best MET BY RATE, with exit status
    3, or 0 with `accept_rate`.
    """

    id: _Text
    statement: str = ""
    metric: _Text
    bound: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)] | None = None
    probability: _Fraction
    confidence: _Fraction
    population: Annotated[str, Field(pattern=r"^[A-Za-z]\w*( and [A-Za-z]\w*)*$")] = "all"
    decide_by: Literal["confidence", "estimate"] = "confidence"
    accept_rate: Annotated[bool, Field(strict=True)] = Field(
        default=False, description="whether the verdict MET BY RATE results in the exit status 0"
    )
    source: str = ""
    kind: Literal["requirement", "observation", "ours"] | None = Field(
        default=None, description="requirement of a paper, observation of a paper, or our own requirement"
    )
    scale: _PositiveNumber = 1.0
    margin: _Text | None = Field(
        default=None,
        description="for a boolean metric: column of numbers that are negative if and only if the metric is false",
    )

    @model_validator(mode="after")
    def _check_margin(self) -> Requirement:
        if self.margin is not None and self.bound is not None:
            raise ValueError("margin is for a metric without a bound")
        return self

    @model_validator(mode="after")
    def _check_accept_rate(self) -> Requirement:
        if self.accept_rate and self.decide_by != "estimate":
            raise ValueError('accept_rate needs decide_by = "estimate"')
        return self

    @property
    def metric_columns(self) -> tuple[str, ...]:
        """Columns of the metric: one boolean column, or the summands."""
        return (self.metric,) if self.bound is None else tuple(self.metric.split(" + "))

    @property
    def population_columns(self) -> tuple[str, ...]:
        """Boolean columns that define the population."""
        return tuple(part for part in self.population.split(" and ") if part not in POPULATIONS)


class Retain(Parameters):
    """Selection of the cases whose products (histories, images, intermediate results) are stored.

    `showcase` is the case shown in the report: the answered case with the worst metric of the first requirement, the
    first case, or none. The rows of all cases are stored.
    """

    showcase: Literal["worst", "first", "none"] = "worst"
    products: Literal["none", "failed", "worst", "every", "all"] = Field(
        default="failed",
        description="cases in addition to the showcase: none, those that fail a requirement, the `worst` by the metric "
        "of the first requirement with a bound, every `every`-th case, or all",
    )
    worst: _Count = 10
    every: _Count = 100
    budget_gb: Annotated[float, Field(strict=True, ge=0.0, allow_inf_nan=False)] = Field(
        default=1.0, description="maximum disk space of the stored products; further products are not stored"
    )


class CaseLimits(Parameters):
    """Limits of one case. A case that exceeds a limit is terminated; its outcome identifies the limit."""

    case_time_s: _PositiveNumber = Field(default=600.0, description="wall-clock time of a case")
    prepare_time_s: _PositiveNumber = Field(default=3600.0, description="wall-clock time to build a shared input")
    memory_gb: _PositiveNumber | None = Field(
        default=None, description="private memory of a worker; by default an equal fraction of 80 % of the free memory"
    )
    output_mb: _PositiveNumber = Field(default=10.0, description="maximum size of a case's standard output and error")


class CalibrationRun(Parameters):
    """Options that were set by looking at the results of a run."""

    options: Annotated[tuple[_Text, ...], Field(strict=False, min_length=1)] = Field(
        description="parameters that were set, as dotted paths"
    )
    campaign: _Text = Field(description="campaign of the results")
    seed: Annotated[int, Field(strict=True, ge=0, le=2**63 - 1)] = Field(description="seed of the results")
    note: str = ""


class CalibrationRuns(Parameters):
    """Results that determined options of the algorithm; results on the same campaign and seed cannot be PASS."""

    runs: Annotated[tuple[CalibrationRun, ...], Field(strict=False)] = ()


class CampaignDefinition(Parameters):
    """All inputs that determine a campaign's rows, apart from the program and the machine."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)]
    scenario: _Text
    description: str = ""
    cases: _Cases
    seed: Annotated[int, Field(strict=True, ge=0, le=2**63 - 1)] = 0
    design: Design = Design()
    parameters: dict[str, Any] = Field(default_factory=dict)
    dispersions: dict[str, AnyDispersion] = Field(default_factory=dict)
    correlations: tuple[Correlation, ...] = ()
    requirements: tuple[Requirement, ...] = ()
    retain: Retain = Retain()
    limits: CaseLimits = CaseLimits()
    calibration: CalibrationRuns | None = None
    max_cases: _Cases | None = Field(
        default=None,
        description="cases at the last planned evaluation of a campaign that stops when its verdicts are decided; set "
        "by --until-decided",
    )
    appended: tuple[_Cases, ...] = Field(
        default=(), strict=False, description="sizes of the blocks of cases that were added after the first"
    )

    @property
    def total_cases(self) -> int:
        """Number of cases of all blocks."""
        return self.cases + sum(self.appended)

    @model_validator(mode="after")
    def _check_unique_ids(self) -> CampaignDefinition:
        ids = [requirement.id for requirement in self.requirements]
        repeated_ids = sorted({name for name in ids if ids.count(name) > 1})
        if repeated_ids:
            raise ValueError(f"requirements share an id: {', '.join(repeated_ids)}")
        return self

    @property
    def grids(self) -> dict[str, GridDispersion]:
        """Swept dispersions, in the order of the file."""
        return {path: item for path, item in self.dispersions.items() if isinstance(item, GridDispersion)}

    @property
    def grid_size(self) -> int:
        """Number of points of the full factorial of the grids; 1 without grids."""
        return math.prod(len(grid.points) for grid in self.grids.values())

    @property
    def blocks(self) -> tuple[int, ...]:
        """Sizes of the blocks of cases, the first before the appended ones."""
        return (self.cases, *self.appended)

    def find_sampling_problems(self) -> list[tuple[Key, str]]:
        """List problems of the design, the correlated groups and their dispersions: keys and messages."""
        problems: list[tuple[Key, str]] = []
        if (problem := self.design.find_invalid_block(self.blocks, self.grid_size)) is not None:
            block, message = problem
            problems.append((("appended", block - 1) if block else ("cases",), message))
        group_indices: dict[str, int] = {}
        for number, group in enumerate(self.correlations):
            for index, path in enumerate(group.parameters):
                reason = self._find_correlation_problem(group, path)
                if path in group_indices:
                    reason = f"'{path}' is in correlations[{group_indices[path]}] already"
                if reason:
                    problems.append((("correlations", number, "parameters", index), reason))
                group_indices[path] = number
        with_covariance = {path for group in self.correlations if group.covariance for path in group.parameters}
        for path, dispersion in self.dispersions.items():
            if isinstance(dispersion, Normal) and dispersion.sd is None and path not in with_covariance:
                problems.append((("dispersions", path, "sd"), "required, but missing"))
            parent = next((table for table in self.dispersions if path.startswith(f"{table}.")), None)
            if parent is not None:
                problems.append((("dispersions", path), f"its table '{parent}' is already dispersed as a whole"))
        return problems

    def _find_correlation_problem(self, group: Correlation, path: str) -> str:
        """Return the reason why a dispersion cannot be correlated; empty if there is none."""
        dispersion = self.dispersions.get(path)
        if dispersion is None:
            return f"'{path}' is not dispersed{suggest_similar(path, self.dispersions)}"
        if not dispersion.continuous:
            return f"'{path}' has no density: only continuous distributions can be correlated"
        if dispersion.formulas:
            return f"'{path}' has a formula; allowed: distributions that do not change from case to case"
        if group.rank is not None:
            return ""
        if not isinstance(dispersion, Normal) or dispersion.truncate is not None:
            return f"'{path}' is not an untruncated normal, as {group.kind} requires; use the group's rank correlation"
        if group.covariance is not None and dispersion.sd is not None:
            return f"'{path}' has an sd, but the covariance already defines it; remove one of them"
        return ""
