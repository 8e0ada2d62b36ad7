"""A campaign as its file states it: scenario, number of cases, parameters, dispersions, requirements, what is kept."""

from __future__ import annotations

import math
import tomllib
import types
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, Field, ValidationError, model_validator

from marsyard.campaigns.errors import ConfigurationError, Problem, near_match
from marsyard.campaigns.sampling.correlation import Correlation
from marsyard.campaigns.sampling.design import Design
from marsyard.campaigns.sampling.dispersions import FRIENDLY, AnyDispersion
from marsyard.campaigns.sampling.levels import Grid
from marsyard.campaigns.sampling.ranges import Normal
from marsyard.sim.files import check_regular
from marsyard.sim.parameters import Parameters

Model = TypeVar("Model", bound=BaseModel)

#: A key in nested tables and lists, part by part.
Key = tuple[str | int, ...]

#: The most cases a campaign may have: numbers of cases are stored as 64-bit integers, and a slip of the keyboard shows.
MAX_CASES = 1_000_000_000


#: Populations that every campaign has; any other name in a population is a column of true and false.
POPULATIONS = ("all", "completed", "valid")


class Requirement(Parameters):
    """What must hold in a stated fraction of a population of cases, with a stated confidence.

    With a `bound`, that the metric's absolute value is at most the bound; a case without a number fails. Without one
    the metric is a column of true and false (`answered`, say) that must be true.

    `population` is `all`, `completed`, `valid` (the cases with an answer) or any column of true and false; several are
    joined by " and ", as in `valid and room`. A metric with a bound may be a sum of columns, joined by " + ", and is
    multiplied by `scale` before it is held against the bound. `decide_by = "estimate"` compares the rate that was seen
    with the probability, whatever its interval, which is stated beside it: for requirements that are not asked at a
    confidence. They are at best MET BY RATE, with the exit status 3, which `accept_rate` makes 0. `source` and `kind`
    say whose requirement it is.
    """

    id: Annotated[str, Field(min_length=1)]
    statement: str = ""
    metric: Annotated[str, Field(min_length=1)]
    bound: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)] | None = None
    probability: Annotated[float, Field(strict=True, gt=0.0, lt=1.0)]
    confidence: Annotated[float, Field(strict=True, gt=0.0, lt=1.0)]
    population: Annotated[str, Field(pattern=r"^[A-Za-z]\w*( and [A-Za-z]\w*)*$")] = "all"
    decide_by: Literal["confidence", "estimate"] = "confidence"
    accept_rate: Annotated[bool, Field(strict=True)] = Field(
        default=False, description="whether MET BY RATE, where the estimate decides, gives the exit status 0"
    )
    source: str = ""
    kind: Literal["requirement", "observation", "ours"] | None = Field(
        default=None, description="of a paper: its requirement, or what it observed; or ours"
    )
    scale: Annotated[float, Field(strict=True, gt=0.0, allow_inf_nan=False)] = 1.0

    @model_validator(mode="after")
    def _rate_is_accepted_where_it_decides(self) -> Requirement:
        if self.accept_rate and self.decide_by != "estimate":
            raise ValueError('accept_rate needs decide_by = "estimate"')
        return self

    @property
    def metric_columns(self) -> tuple[str, ...]:
        """Columns that the metric is made of: one of true and false, or those of numbers that are summed."""
        return (self.metric,) if self.bound is None else tuple(self.metric.split(" + "))

    @property
    def population_columns(self) -> tuple[str, ...]:
        """Columns of true and false that the population takes its members from."""
        return tuple(part for part in self.population.split(" and ") if part not in POPULATIONS)


class Retain(Parameters):
    """Which cases keep their products (histories, pictures, intermediate results) beside their rows.

    Rows are always kept. `showcase` is the case that the report shows: the answered case with the worst metric of the
    first requirement, the first case, or none.
    """

    showcase: Literal["worst", "first", "none"] = "worst"
    products: Literal["none", "failed", "worst", "every", "all"] = Field(
        default="none",
        description="of no case beside the showcase, of those that fail a requirement, of the `worst` by the metric of "
        "the first requirement with a bound, of `every` so manieth, or of all",
    )
    worst: Annotated[int, Field(strict=True, ge=1)] = 10
    every: Annotated[int, Field(strict=True, ge=1)] = 100
    budget_gb: Annotated[float, Field(strict=True, ge=0.0, allow_inf_nan=False)] = Field(
        default=10.0, description="disk that kept products may take; when it is used up no more are kept"
    )


#: A number above zero, of seconds or bytes.
_Amount = Annotated[float, Field(strict=True, gt=0.0, allow_inf_nan=False)]


class Limits(Parameters):
    """What one case may use before it is ended; rows of cases that were ended say so in their outcome."""

    case_time_s: _Amount = Field(default=600.0, description="wall-clock time of a case")
    prepare_time_s: _Amount = Field(default=3600.0, description="wall-clock time of building a shared input")
    memory_gb: _Amount | None = Field(
        default=None,
        description="memory that a worker has to itself; by default a share of 80 % of what is free at the start",
    )
    output_mb: _Amount = Field(default=10.0, description="what a case may write to standard output and error")


class CampaignConfiguration(Parameters):
    """Everything that a campaign's rows depend on, apart from the program and the machine."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)]
    scenario: Annotated[str, Field(min_length=1)]
    description: str = ""
    cases: Annotated[int, Field(strict=True, ge=1, le=MAX_CASES)]
    seed: Annotated[int, Field(strict=True, ge=0, le=2**63 - 1)] = 0
    design: Design = Design()
    parameters: dict[str, Any] = Field(default_factory=dict)
    dispersions: dict[str, AnyDispersion] = Field(default_factory=dict)
    correlations: tuple[Correlation, ...] = ()
    requirements: tuple[Requirement, ...] = ()
    retain: Retain = Retain()
    limits: Limits = Limits()
    most_cases: Annotated[int, Field(strict=True, ge=1, le=MAX_CASES)] | None = Field(
        default=None,
        description="cases of the last look at a campaign that stops itself when its verdicts are decided; set by "
        "--until-decided",
    )
    appended: tuple[Annotated[int, Field(strict=True, ge=1, le=MAX_CASES)], ...] = Field(
        default=(), strict=False, description="sizes of the blocks of cases that were added behind the first"
    )

    @property
    def total_cases(self) -> int:
        """Cases of all blocks."""
        return self.cases + sum(self.appended)

    @model_validator(mode="after")
    def _requirements_are_told_apart(self) -> CampaignConfiguration:
        ids = [requirement.id for requirement in self.requirements]
        repeated = sorted({name for name in ids if ids.count(name) > 1})
        if repeated:
            raise ValueError(f"requirements share an id: {', '.join(repeated)}")
        return self

    @property
    def grids(self) -> dict[str, Grid]:
        """The dispersions that are swept, in the file's order."""
        return {path: one for path, one in self.dispersions.items() if isinstance(one, Grid)}

    @property
    def grid_size(self) -> int:
        """Points of the full factorial over the grids; 1 where there are none."""
        return math.prod(len(grid.points) for grid in self.grids.values())

    @property
    def blocks(self) -> tuple[int, ...]:
        """Sizes of the blocks of cases, the first one's before those appended."""
        return (self.cases, *self.appended)

    def sampling_problems(self) -> list[tuple[Key, str]]:
        """What is wrong with design, correlated groups and their dispersions together: keys, and what is allowed."""
        problems: list[tuple[Key, str]] = []
        unlaid = self.design.problem(self.blocks, self.grid_size)
        if unlaid is not None:
            block, message = unlaid
            problems.append((("appended", block - 1) if block else ("cases",), message))
        grouped: dict[str, int] = {}
        for number, group in enumerate(self.correlations):
            for place, path in enumerate(group.parameters):
                wrong = self._member_problem(group, path)
                if path in grouped:
                    wrong = f"'{path}' is in correlations[{grouped[path]}] already"
                if wrong:
                    problems.append((("correlations", number, "parameters", place), wrong))
                grouped[path] = number
        stated = {path for group in self.correlations if group.covariance for path in group.parameters}
        for path, dispersion in self.dispersions.items():
            if isinstance(dispersion, Normal) and dispersion.sd is None and path not in stated:
                problems.append((("dispersions", path, "sd"), "required, but missing"))
            inside = next((other for other in self.dispersions if path.startswith(f"{other}.")), None)
            if inside is not None:
                problems.append((("dispersions", path), f"lies within '{inside}', which is dispersed as a whole"))
        return problems

    def _member_problem(self, group: Correlation, path: str) -> str:
        """What keeps a dispersion from being correlated; empty if nothing does."""
        dispersion = self.dispersions.get(path)
        if dispersion is None:
            return f"'{path}' is not dispersed{near_match(path, self.dispersions)}"
        if not dispersion.continuous:
            return f"'{path}' has no density: only continuous distributions can be correlated"
        if dispersion.formulas:
            return f"'{path}' has a formula; allowed: distributions that do not change from case to case"
        if group.rank is not None:
            return ""
        if not isinstance(dispersion, Normal) or dispersion.truncate is not None:
            return f"'{path}' is not normal and uncut, as {group.kind} asks; state the group's rank correlation instead"
        if group.covariance is not None and dispersion.sd is not None:
            return f"'{path}' has an sd, which the covariance states already; leave one of them out"
        return ""


def read_tables(path: Path) -> dict[str, Any]:
    """The tables of a TOML file. Raises ConfigurationError where it cannot be read, or is none."""
    try:
        check_regular(path)
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigurationError([Problem(str(path), "", f"cannot be read: {error.strerror or error}")]) from error
    except (ValueError, RecursionError) as error:  # a ValueError of its own too for numbers of thousands of digits
        raise ConfigurationError([Problem(str(path), "", f"not valid TOML: {error}")]) from error


def read_table(path: Path, model: type[Model]) -> Model:
    """What a TOML file states as a whole. Raises ConfigurationError, every problem with its key."""
    try:
        return model.model_validate(read_tables(path))
    except ValidationError as error:
        found = [Problem(str(path), key_text(key), message) for key, message in problems_of(error, model)]
        raise ConfigurationError(found) from error


def problems_of(error: ValidationError, model: type[BaseModel]) -> list[tuple[Key, str]]:
    """What a validation found: each with its key as written in the file, and what is wrong and allowed there."""
    return [
        (_written(model, detail["loc"]), _message(dict(detail), model)) for detail in error.errors(include_url=False)
    ]


def key_text(key: Iterable[str | int]) -> str:
    """A key as TOML writes it: ``dispersions."wind.east_m_s".low`` or ``requirements[0].bound``."""
    text = ""
    for part in key:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            quoted = part if part.replace("-", "_").isidentifier() or part.isdigit() else f'"{part}"'
            text += f".{quoted}" if text else quoted
    return text


def _written(model: type[BaseModel], location: Sequence[str | int]) -> Key:
    """The key as written: without the names of the kind that pydantic adds where one of several models is chosen."""
    if model is CampaignConfiguration and len(location) > 2 and location[0] == "dispersions":
        return (*location[:2], *location[3:])
    here: Any = model
    written: list[str | int] = []
    for part in location:
        if not any(kind.__name__ == part for kind in _models(here)):
            written.append(part)
        here = _inner(here, part)
    return tuple(written)


def _message(detail: Mapping[str, Any], model: type[BaseModel]) -> str:
    """What is wrong at one place and what is allowed there."""
    location, given = detail["loc"], detail["input"]
    if detail["type"] == "extra_forbidden":
        allowed = fields_at(model, location[:-1])
        return f"unknown key{near_match(str(location[-1]), allowed)}; allowed: {', '.join(allowed)}"
    if detail["type"] == "missing":
        return "required, but missing"
    if detail["type"] == "value_error":
        return str(detail["msg"]).removeprefix("Value error, ")
    message = str(detail["msg"])
    message = message[:1].lower() + message[1:]
    shown = isinstance(given, str | int | float | bool)
    return f"{message}, got {given!r}" if shown else f"{message}, got {type(given).__name__}"


def fields_at(model: type[BaseModel], location: Sequence[str | int]) -> list[str]:
    """Names of the fields of the model found at a location inside a model; empty where there is none."""
    here: Any = model
    for part in location:
        here = _inner(here, part)
    return sorted({name for kind in _models(here) for name in kind.model_fields})


def description_at(model: type[BaseModel], path: str) -> str:
    """What a model says of its field at a dotted path; empty where it says nothing."""
    *tables, name = path.split(".")
    here: Any = model
    for part in tables:
        here = _inner(here, int(part) if part.isdigit() else part)
    for kind in _alternatives(here):
        if isinstance(kind, type) and issubclass(kind, BaseModel) and name in kind.model_fields:
            return kind.model_fields[name].description or ""
    return ""


def _inner(kind: Any, part: str | int) -> Any:
    """The type found under one part of a location."""
    found: list[Any] = []
    for choice in _alternatives(kind):
        if isinstance(choice, type) and issubclass(choice, BaseModel):
            if part in choice.model_fields:
                found.append(choice.model_fields[str(part)].annotation)
            elif choice.__name__ == part or (part in FRIENDLY and choice is FRIENDLY[str(part)]):
                found.append(choice)
        elif get_origin(choice) in (list, tuple, set, frozenset) and isinstance(part, int):
            found.append(get_args(choice)[0])
        elif get_origin(choice) in (dict, Mapping) and isinstance(part, str):
            found.append(get_args(choice)[1])
    return Union[tuple(found)] if found else None  # noqa: UP007


def _models(kind: Any) -> list[type[BaseModel]]:
    """The models among the members of a union."""
    return [one for one in _alternatives(kind) if isinstance(one, type) and issubclass(one, BaseModel)]


def _alternatives(kind: Any) -> list[Any]:
    """The members of a union, through annotations."""
    origin = get_origin(kind)
    if origin is Annotated:
        return _alternatives(get_args(kind)[0])
    if origin in (Union, types.UnionType):
        return [inner for choice in get_args(kind) for inner in _alternatives(choice)]
    return [kind]
