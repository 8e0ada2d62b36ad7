"""A campaign as its file states it: scenario, number of cases, parameters, dispersions, requirements, what is kept."""

from __future__ import annotations

import types
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from campaigns.dispersions import FRIENDLY, AnyDispersion
from campaigns.errors import near_match

#: A key in nested tables and lists, part by part.
Key = tuple[str | int, ...]

#: Outcome of a case that raised or took its worker process down; no scenario may use the name.
CRASHED = "CRASHED"

#: The most cases a campaign may have: numbers of cases are stored as 64-bit integers, and a slip of the keyboard shows.
MOST_CASES = 1_000_000_000


#: Populations that every campaign has; any other name in a population is a column of true and false.
POPULATIONS = ("all", "completed", "valid")


class Requirement(BaseModel):
    """What must hold in a stated fraction of a population of cases, with a stated confidence.

    With a `bound`, that the metric's absolute value is at most the bound; a case without a number fails. Without one
    the metric is a column of true and false (`answered`, say) that must be true.

    `population` is `all`, `completed`, `valid` (the cases with an answer) or any column of true and false; several are
    joined by " and ", as in `valid and room`. `decide_by = "estimate"` compares the rate that was seen with the
    probability, whatever its interval, which is stated beside it: for requirements that are not asked at a confidence.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: Annotated[str, Field(min_length=1)]
    statement: str = ""
    metric: Annotated[str, Field(min_length=1)]
    bound: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)] | None = None
    probability: Annotated[float, Field(strict=True, gt=0.0, lt=1.0)]
    confidence: Annotated[float, Field(strict=True, gt=0.0, lt=1.0)]
    population: Annotated[str, Field(pattern=r"^[A-Za-z]\w*( and [A-Za-z]\w*)*$")] = "all"
    decide_by: Literal["confidence", "estimate"] = "confidence"

    @property
    def population_columns(self) -> tuple[str, ...]:
        """Columns of true and false that the population takes its members from."""
        return tuple(part for part in self.population.split(" and ") if part not in POPULATIONS)


class Retain(BaseModel):
    """Which cases keep their products (pictures and intermediate results) beside their rows.

    `showcase` is the case that the report shows: the answered case with the worst metric of the first requirement,
    the first case, or none.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    showcase: Literal["worst", "first", "none"] = "worst"


class CampaignConfiguration(BaseModel):
    """Everything that a campaign's rows depend on, apart from the program and the machine."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)]
    scenario: Annotated[str, Field(min_length=1)]
    description: str = ""
    cases: Annotated[int, Field(strict=True, ge=1, le=MOST_CASES)]
    seed: Annotated[int, Field(strict=True, ge=0)] = 0
    parameters: dict[str, Any] = {}
    dispersions: dict[str, AnyDispersion] = {}
    requirements: tuple[Requirement, ...] = ()
    retain: Retain = Retain()

    @model_validator(mode="after")
    def _requirements_are_told_apart(self) -> CampaignConfiguration:
        ids = [requirement.id for requirement in self.requirements]
        repeated = sorted({name for name in ids if ids.count(name) > 1})
        if repeated:
            raise ValueError(f"requirements share an id: {', '.join(repeated)}")
        return self


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
    """The key as written: without the name of the kind that pydantic adds behind a dispersion's path."""
    if model is CampaignConfiguration and len(location) > 2 and location[0] == "dispersions":
        return (*location[:2], *location[3:])
    return tuple(location)


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
    models = [kind for kind in _alternatives(here) if isinstance(kind, type) and issubclass(kind, BaseModel)]
    return sorted({name for kind in models for name in kind.model_fields})


def _inner(kind: Any, part: str | int) -> Any:
    """The type found under one part of a location."""
    found: list[Any] = []
    for choice in _alternatives(kind):
        if isinstance(choice, type) and issubclass(choice, BaseModel):
            if part in choice.model_fields:
                found.append(choice.model_fields[str(part)].annotation)
            elif part in FRIENDLY and choice is FRIENDLY[str(part)]:
                found.append(choice)
        elif get_origin(choice) in (list, tuple, set, frozenset) and isinstance(part, int):
            found.append(get_args(choice)[0])
        elif get_origin(choice) in (dict, Mapping) and isinstance(part, str):
            found.append(get_args(choice)[1])
    return Union[tuple(found)] if found else None  # noqa: UP007


def _alternatives(kind: Any) -> list[Any]:
    """The members of a union, through annotations."""
    origin = get_origin(kind)
    if origin is Annotated:
        return _alternatives(get_args(kind)[0])
    if origin in (Union, types.UnionType):
        return [inner for choice in get_args(kind) for inner in _alternatives(choice)]
    return [kind]
