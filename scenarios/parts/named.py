"""Names and construction of user-defined parts.

A part is named by ``module:name``, also of a module in the current folder, or by an installed package's entry point in
the group of its kind.
"""

from __future__ import annotations

import difflib
import inspect
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from typing import Any, ClassVar

from pydantic import BaseModel, Discriminator, Field, JsonValue, ValidationError, model_validator

from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.user_files import import_object
from marsyard.sim.parameters import Parameters


@dataclass(frozen=True)
class Kind:
    """A kind of part.

    - name: word of the command line
    - group: entry point group of installed packages
    - noun: its name in messages
    - members: required members of a class; empty for functions
    """

    name: str
    group: str
    noun: str
    members: tuple[str, ...] = ()

    def path(self, spec: str) -> str:
        """Import path ``module:name`` of a part. Raises ValueError for an unknown entry point."""
        if ":" in spec:
            return spec
        names = list_installed(self.group)
        if spec in names:
            return names[spec]
        near = difflib.get_close_matches(spec, names, n=1)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        raise ValueError(
            f"unknown {self.noun} '{spec}'{hint}; allowed: {', '.join([*names, 'your own as module:name'])}"
        )

    def load(self, spec: str) -> Any:
        """Import a part. Raises ValueError if it does not exist."""
        try:
            return import_object(self.path(spec))
        except ImportError as error:
            raise ValueError(f"no {self.noun} at '{spec}': {error}") from error

    def create(self, spec: str, options: Mapping[str, Any]) -> Any:
        """Construct a part's class. Raises ValueError for a missing class, another kind, or invalid options."""
        part = self.load(spec)
        if not isinstance(part, type):
            raise ValueError(f"'{spec}' is no {self.noun}: it is a {type(part).__name__}, not a class")
        missing = [member for member in self.members if not hasattr(part, member)]
        if missing:
            raise ValueError(f"'{spec}' is no {self.noun}: it has no {', '.join(missing)}")
        try:
            return part(**options)
        except Exception as error:  # a user's class may raise anything
            message = str(error) if isinstance(error, TypeError | ValueError) else f"{type(error).__name__}: {error}"
            if isinstance(error, ValidationError):
                faults = [(".".join(map(str, one["loc"])), str(one["msg"])) for one in error.errors()]
                message = "; ".join(f"{key}: {text}" if key else text for key, text in faults)
            allowed = ", ".join(defaults(part)) or "none"
            raise ValueError(f"'{spec}' refuses its options: {message}; it has: {allowed}") from error


DYNAMICS = Kind("dynamics", "marsyard.dynamics", "motion", ("fly", "random"))
INSTRUMENT = Kind("instrument", "marsyard.instruments", "instrument", ("read", "quantity", "random"))
SCORE = Kind("score", "marsyard.scores", "score")

KINDS: Mapping[str, Kind] = {kind.name: kind for kind in (DYNAMICS, INSTRUMENT, SCORE)}


@cache
def list_installed(group: str) -> Mapping[str, str]:
    """Import paths in an entry point group of installed packages, by sorted names."""
    return {point.name: point.value for point in sorted(entry_points(group=group), key=lambda point: point.name)}


def defaults(part: Any) -> dict[str, JsonValue]:
    """Options of a class with their default values, as far as TOML can state them."""
    plain: dict[str, JsonValue] = {}
    with suppress(TypeError, ValueError):  # a class without a signature
        for name, argument in inspect.signature(part).parameters.items():
            with suppress(TypeError, ValueError):  # required, or a default that TOML cannot state
                plain[name] = json.loads(json.dumps(argument.default, allow_nan=False))
    return plain


class CustomPart(Parameters):
    """A parameter table with a user-defined class, named in the key `named_by`, and its options.

    Missing options are completed with the class's defaults when the campaign is read, so that each is in the campaign's
    record and can be dispersed.
    """

    kind: ClassVar[Kind]
    named_by: ClassVar[str]

    options: dict[str, JsonValue] = Field(default_factory=dict, description="the class's arguments; can be dispersed")

    @property
    def spec(self) -> str:
        """Name of the class."""
        return str(getattr(self, self.named_by))

    def create(self) -> Any:
        """Construct the part."""
        return self.kind.create(self.spec, self.options)

    @model_validator(mode="before")
    @classmethod
    def _complete_options(cls, stated: Any) -> Any:
        if not isinstance(stated, Mapping) or not isinstance(stated.get(cls.named_by), str):
            return stated
        options = stated.get("options", {})
        if not isinstance(options, Mapping):
            return stated
        return {**stated, "options": {**defaults(cls.kind.load(stated[cls.named_by])), **options}}

    @model_validator(mode="after")
    def _check_options(self) -> CustomPart:
        json.dumps(self.options, allow_nan=False)
        self.create()
        return self

    def columns(self, prefix: str, reported: Mapping[str, Scalar]) -> dict[str, Scalar]:
        """Columns of the row: name of the part, its scalar options, and columns that it reports of the case.

        Raises ValueError for a reported column with an invalid name or value, or with the name of an option.
        """
        options = {name: value for name, value in self.options.items() if isinstance(value, bool | int | float | str)}
        row: dict[str, Scalar] = {f"{prefix}_{self.named_by}": self.spec}
        for name, value in (*options.items(), *check_columns(self.spec, reported).items()):
            if f"{prefix}_{name}" in row:
                raise ValueError(f"'{self.spec}' reports the column {name} twice, or it is one of its options")
            row[f"{prefix}_{name}"] = value
        return row


def default_or_custom(default: type[BaseModel], custom: type[CustomPart]) -> Discriminator:
    """Discriminator between a table with a user-defined part and the default one; tags are the models' names."""

    def model(stated: Any) -> str:
        is_custom = custom.named_by in stated if isinstance(stated, Mapping) else isinstance(stated, custom)
        return custom.__name__ if is_custom else default.__name__

    return Discriminator(model)


def check_columns(spec: str, reported: object, *, texts: bool = True) -> dict[str, Scalar]:
    """Columns reported by a part: numbers as floats, truth values and texts unchanged.

    Raises ValueError for anything but a mapping, names that are no ASCII identifiers, or values of another type (with
    `texts` false also for texts).
    """
    if not isinstance(reported, Mapping):
        raise ValueError(f"'{spec}' gives its columns as a {type(reported).__name__}; allowed: a mapping")
    row: dict[str, Scalar] = {}
    for name, value in reported.items():
        if not (isinstance(name, str) and name.isidentifier() and name.isascii()):
            raise ValueError(f"'{spec}' names a column {name!r}; allowed: letters, digits and _")
        plain = value.item() if hasattr(value, "item") and getattr(value, "ndim", 0) == 0 else value
        if isinstance(plain, bool) or (texts and isinstance(plain, str)):
            row[name] = plain
        elif isinstance(plain, int | float):
            row[name] = float(plain)
        else:
            allowed = "a number, true or false" + (", a text" if texts else "")
            raise ValueError(f"'{spec}' gives {name} as a {type(value).__name__}; allowed: {allowed}")
    return row
