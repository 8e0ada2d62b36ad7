"""TOML files as pydantic models: a sentence for each problem, with its key as in the file."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from functools import reduce
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from marsyard.campaigns.errors import DefinitionError, Problem, suggest_similar
from marsyard.campaigns.sampling.dispersions import TAGGED_DISPERSIONS
from marsyard.sim.files import check_regular
from marsyard.sim.parameters import list_alternatives, list_models

Model = TypeVar("Model", bound=BaseModel)
#: Location of a key in nested tables and lists: names and indices.
Key = tuple[str | int, ...]


def read_tables(path: Path) -> dict[str, Any]:
    """Read the tables of a TOML file. Raises DefinitionError if it is unreadable or invalid."""
    try:
        check_regular(path)
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DefinitionError([Problem(str(path), "", f"cannot be read: {error.strerror or error}")]) from error
    except (ValueError, RecursionError) as error:  # ValueError: also numbers of thousands of digits
        raise DefinitionError([Problem(str(path), "", f"not valid TOML: {error}")]) from error


def read_model(path: Path, model: type[Model]) -> Model:
    """Read a complete TOML file into a model. Raises DefinitionError; each problem has its key."""
    try:
        return model.model_validate(read_tables(path))
    except ValidationError as error:
        problems = [Problem(str(path), key_text(key), message) for key, message in validation_problems(error, model)]
        raise DefinitionError(problems) from error


def validation_problems(error: ValidationError, model: type[BaseModel]) -> list[tuple[Key, str]]:
    """List the problems of a validation: keys as in the file, and messages with the allowed values."""
    problems: list[tuple[Key, str]] = []
    for detail in error.errors(include_url=False):
        location, value, message = detail["loc"], detail["input"], str(detail["msg"])
        if detail["type"] == "extra_forbidden":
            models = list_models(reduce(_find_inner_type, location[:-1], model))
            allowed = sorted({name for option in models for name in option.model_fields})
            message = f"unknown key{suggest_similar(str(location[-1]), allowed)}; allowed: {', '.join(allowed)}"
        elif detail["type"] == "missing":
            message = "required, but missing"
        elif detail["type"] == "value_error":
            message = message.removeprefix("Value error, ")
        else:
            value_text = repr(value) if isinstance(value, str | int | float | bool) else type(value).__name__
            message = f"{message[:1].lower()}{message[1:]}, got {value_text}"
        key: Key = ()
        node: Any = model
        for part in location:
            # pydantic adds the names or tags of alternative models, which are no keys of the file
            if not any(_is_alternative(option, part) for option in list_models(node)):
                key = (*key, part)
            node = _find_inner_type(node, part)
        problems.append((key, message))
    return problems


def key_text(key: Iterable[str | int]) -> str:
    """Format a key in TOML syntax: ``dispersions."wind.east_m_s".low`` or ``requirements[0].bound``."""
    text = ""
    for part in key:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            key_part = part if part.replace("-", "_").isidentifier() or part.isdigit() else f'"{part}"'
            text += f".{key_part}" if text else key_part
    return text


def description_at(model: type[BaseModel], path: str) -> str:
    """Return the description of a model's field at a dotted path; empty if the field has none."""
    *tables, name = path.split(".")
    models = list_models(reduce(_find_inner_type, (int(part) if part.isdigit() else part for part in tables), model))
    return next((option.model_fields[name].description or "" for option in models if name in option.model_fields), "")


def _find_inner_type(annotation: Any, key: str | int) -> Any:
    """Find the type of the field, entry or element `key` of a type; None if there is none."""
    inner_types: list[Any] = []
    for choice in list_alternatives(annotation):
        if isinstance(choice, type) and issubclass(choice, BaseModel):
            if key in choice.model_fields:
                inner_types.append(choice.model_fields[str(key)].annotation)
            elif _is_alternative(choice, key):
                inner_types.append(choice)
        elif get_origin(choice) in (list, tuple, set, frozenset) and isinstance(key, int):
            inner_types.append(get_args(choice)[0])
        elif get_origin(choice) in (dict, Mapping) and isinstance(key, str):
            inner_types.append(get_args(choice)[1])
    return Union[tuple(inner_types)] if inner_types else None  # noqa: UP007


def _is_alternative(model: type[BaseModel], part: str | int) -> bool:
    """Whether a part of pydantic's location is the name, or the tag as a dispersion, of one of several models."""
    return part == model.__name__ or TAGGED_DISPERSIONS.get(str(part)) is model
