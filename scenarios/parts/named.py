"""Import and construct user-defined parts of a scenario by name, and check the columns that they report.

Parts are motions, instruments and scores. The name of a part is ``module:name`` (the module may be in the current
folder), or the name of an entry point of an installed package in the group of the part's kind.
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

from marsyard.scenarios.imports import import_object
from marsyard.scenarios.interface import Scalar
from marsyard.sim.parameters import Parameters


@dataclass(frozen=True)
class PartKind:
    """A kind of user-defined parts, and how its parts are found and checked.

    - name: name of the kind on the command line
    - group: entry point group for installed packages
    - noun: noun for a part of this kind in messages
    - members: required members of a part's class; empty if parts are functions
    """

    name: str
    group: str
    noun: str
    members: tuple[str, ...] = ()

    def path(self, spec: str) -> str:
        """Return the import path ``module:name`` of a part. Raises ValueError for an unknown entry point."""
        if ":" in spec:
            return spec
        names = list_installed(self.group)
        if spec in names:
            return names[spec]
        matches = difflib.get_close_matches(spec, names, n=1)
        hint = f" (did you mean '{matches[0]}'?)" if matches else ""
        raise ValueError(
            f"unknown {self.noun} '{spec}'{hint}; allowed: {', '.join([*names, 'a custom one as module:name'])}"
        )

    def load(self, spec: str) -> Any:
        """Import a part. Raises ValueError if it does not exist."""
        try:
            return import_object(self.path(spec))
        except ImportError as error:
            raise ValueError(f"cannot import {self.noun} '{spec}': {error}") from error

    def create(self, spec: str, options: Mapping[str, Any]) -> Any:
        """Construct a part from its class. Raises ValueError for a missing or unsuitable class, or invalid options."""
        part = self.load(spec)
        if not isinstance(part, type):
            raise ValueError(f"'{spec}' is not a valid {self.noun}: it is a {type(part).__name__}, not a class")
        missing = [member for member in self.members if not hasattr(part, member)]
        if missing:
            raise ValueError(f"'{spec}' is not a valid {self.noun}: missing members: {', '.join(missing)}")
        try:
            return part(**options)
        except Exception as error:  # a user's class may raise anything
            message = str(error) if isinstance(error, TypeError | ValueError) else f"{type(error).__name__}: {error}"
            if isinstance(error, ValidationError):
                errors = [(".".join(map(str, detail["loc"])), str(detail["msg"])) for detail in error.errors()]
                message = "; ".join(f"{key}: {text}" if key else text for key, text in errors)
            allowed = ", ".join(default_options(part)) or "none"
            raise ValueError(f"invalid options for '{spec}': {message}; available options: {allowed}") from error


DYNAMICS = PartKind("dynamics", "marsyard.dynamics", "motion", ("fly", "random"))
INSTRUMENT = PartKind("instrument", "marsyard.instruments", "instrument", ("read", "quantity", "random"))
SCORE = PartKind("score", "marsyard.scores", "score")

KINDS: Mapping[str, PartKind] = {kind.name: kind for kind in (DYNAMICS, INSTRUMENT, SCORE)}


@cache
def list_installed(group: str) -> Mapping[str, str]:
    """Return the import paths in an entry point group of installed packages, sorted by name."""
    return {point.name: point.value for point in sorted(entry_points(group=group), key=lambda point: point.name)}


def default_options(part: Any) -> dict[str, JsonValue]:
    """Return the options of a class that have a default value which TOML can represent, with this value."""
    options: dict[str, JsonValue] = {}
    with suppress(TypeError, ValueError):  # a class without a signature
        for name, argument in inspect.signature(part).parameters.items():
            with suppress(TypeError, ValueError):  # no default, or a default that TOML cannot represent
                options[name] = json.loads(json.dumps(argument.default, allow_nan=False))
    return options


class CustomPart(Parameters):
    """A parameter table with the name of a user-defined class, in the key `name_key`, and the options of the class.

    When the campaign is read, missing options are set to the defaults of the class. The campaign's record therefore
    contains all options, and each option can be dispersed.
    """

    kind: ClassVar[PartKind]
    name_key: ClassVar[str]

    options: dict[str, JsonValue] = Field(default_factory=dict, description="the class's arguments; can be dispersed")

    @property
    def spec(self) -> str:
        """Name of the class."""
        return str(getattr(self, self.name_key))

    def create(self) -> Any:
        """Construct the part."""
        return self.kind.create(self.spec, self.options)

    @model_validator(mode="before")
    @classmethod
    def _complete_options(cls, table: Any) -> Any:
        """Add the default values of missing options."""
        if not isinstance(table, Mapping) or not isinstance(table.get(cls.name_key), str):
            return table
        options = table.get("options", {})
        if not isinstance(options, Mapping):
            return table
        return {**table, "options": {**default_options(cls.kind.load(table[cls.name_key])), **options}}

    @model_validator(mode="after")
    def _check_options(self) -> CustomPart:
        json.dumps(self.options, allow_nan=False)
        self.create()
        return self

    def columns(self, prefix: str, reported_columns: Mapping[str, Scalar]) -> dict[str, Scalar]:
        """Return the result columns of a part: its name, its scalar options, and the columns that it reports.

        Raises ValueError for a reported column with an invalid name or value, or with the name of an option.
        """
        options = {name: value for name, value in self.options.items() if isinstance(value, bool | int | float | str)}
        row: dict[str, Scalar] = {f"{prefix}_{self.name_key}": self.spec}
        for name, value in (*options.items(), *check_columns(self.spec, reported_columns).items()):
            if f"{prefix}_{name}" in row:
                raise ValueError(f"'{self.spec}' reports the column {name}, which is also the name of an option")
            row[f"{prefix}_{name}"] = value
        return row


def default_or_custom(default: type[BaseModel], custom: type[CustomPart]) -> Discriminator:
    """Create the discriminator between a table with a user-defined part and the default table.

    The tags are the names of the models.
    """

    def select_tag(table: Any) -> str:
        is_custom = custom.name_key in table if isinstance(table, Mapping) else isinstance(table, custom)
        return custom.__name__ if is_custom else default.__name__

    return Discriminator(select_tag)


def check_columns(spec: str, reported_columns: object, *, texts: bool = True) -> dict[str, Scalar]:
    """Check and return the columns reported by a part: numbers as floats, booleans and texts unchanged.

    Raises ValueError if `reported_columns` is not a mapping, a name is not an ASCII identifier, or a value is not a
    number, a boolean or a text; texts are allowed only if `texts` is true.
    """
    if not isinstance(reported_columns, Mapping):
        raise ValueError(f"'{spec}' returns columns of type {type(reported_columns).__name__}; allowed: a mapping")
    row: dict[str, Scalar] = {}
    for name, value in reported_columns.items():
        if not (isinstance(name, str) and name.isidentifier() and name.isascii()):
            raise ValueError(f"'{spec}' returns the invalid column name {name!r}; allowed: letters, digits and _")
        scalar = value.item() if hasattr(value, "item") and getattr(value, "ndim", 0) == 0 else value
        if isinstance(scalar, bool) or (texts and isinstance(scalar, str)):
            row[name] = scalar
        elif isinstance(scalar, int | float):
            row[name] = float(scalar)
        else:
            allowed = "a number, true or false" + (", a text" if texts else "")
            raise ValueError(f"'{spec}' returns {name} of type {type(value).__name__}; allowed: {allowed}")
    return row
