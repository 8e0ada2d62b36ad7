"""How a part is named, found, and made from its options.

A part is named by ``module:name``, where the module may lie in the current folder, or by the name that an installed
package gives it in its kind's entry point group.
"""

from __future__ import annotations

import difflib
import inspect
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from typing import Any, ClassVar

from pydantic import BaseModel, Discriminator, Field, JsonValue, ValidationError, model_validator

from marsyard.scenarios.dotted import found_at
from marsyard.scenarios.interface import Scalar
from marsyard.sim.parameters import Parameters

Options = Mapping[str, Any]


@dataclass(frozen=True)
class Kind:
    """A kind of part.

    Attributes
    ----------
    name
        As the command line has it.
    group
        The entry point group in which packages name theirs.
    what
        A part of this kind, in words.
    members
        What a class of this kind must have; empty for functions.
    """

    name: str
    group: str
    what: str
    members: tuple[str, ...] = ()

    def path(self, spec: str) -> str:
        """Where a part is found, as ``module:name``. Raises ValueError for a name that no package gives."""
        if ":" in spec:
            return spec
        known = installed(self.group)
        if spec in known:
            return known[spec]
        near = difflib.get_close_matches(spec, known, n=1)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        raise ValueError(
            f"unknown {self.what} '{spec}'{hint}; allowed: {', '.join([*known, 'your own as module:name'])}"
        )

    def found(self, spec: str) -> Any:
        """What stands under a name. Raises ValueError where there is nothing."""
        try:
            return found_at(self.path(spec))
        except ImportError as error:
            raise ValueError(f"no {self.what} at '{spec}': {error}") from error

    def made(self, spec: str, options: Options) -> Any:
        """The part of a class, made from its options.

        Raises
        ------
        ValueError
            Where there is none, it is of another kind, or refuses the options.
        """
        found = self.found(spec)
        if not isinstance(found, type):
            raise ValueError(f"'{spec}' is no {self.what}: it is a {type(found).__name__}, not a class")
        missing = [member for member in self.members if not hasattr(found, member)]
        if missing:
            raise ValueError(f"'{spec}' is no {self.what}: it has no {', '.join(missing)}")
        try:
            return found(**options)
        except Exception as error:  # a class may raise anything
            allowed = ", ".join(defaults(found)) or "none"
            raise ValueError(f"'{spec}' refuses its options: {_said(error)}; it has: {allowed}") from error


DYNAMICS = Kind("dynamics", "marsyard.dynamics", "motion", ("fly", "random"))
INSTRUMENT = Kind("instrument", "marsyard.instruments", "instrument", ("read", "quantity", "random"))
SCORE = Kind("score", "marsyard.scores", "score")

KINDS: Mapping[str, Kind] = {kind.name: kind for kind in (DYNAMICS, INSTRUMENT, SCORE)}


@cache
def installed(group: str) -> Mapping[str, str]:
    """What installed packages name in an entry point group, in the order of the names: where each is found."""
    return {point.name: point.value for point in sorted(entry_points(group=group), key=lambda point: point.name)}


def defaults(found: Any) -> dict[str, JsonValue]:
    """The options of a class and what they are where nothing is stated, as far as TOML can state it."""
    try:
        parameters = inspect.signature(found).parameters.values()
    except (TypeError, ValueError):
        return {}
    stated = {one.name: one.default for one in parameters if one.default is not inspect.Parameter.empty}
    plain: dict[str, JsonValue] = {}
    for name, value in stated.items():
        try:
            plain[name] = json.loads(json.dumps(value, allow_nan=False))
        except (TypeError, ValueError):
            continue
    return plain


def _said(error: Exception) -> str:
    """What an error says in one line."""
    if isinstance(error, ValidationError):
        told = [(".".join(map(str, one["loc"])), str(one["msg"])) for one in error.errors()]
        return "; ".join(f"{where}: {message}" if where else message for where, message in told)
    return str(error) if isinstance(error, TypeError | ValueError) else f"{type(error).__name__}: {error}"


class OwnPart(Parameters):
    """A table that names a class of a user's own, in the key `named_by`, and states its options.

    Options that are not stated are filled in from the class when the campaign is read, so that each is in the
    campaign's record and can be dispersed.
    """

    kind: ClassVar[Kind]
    named_by: ClassVar[str]

    options: dict[str, JsonValue] = Field(
        default_factory=dict, description="handed to the class by name; each can be dispersed"
    )

    @property
    def spec(self) -> str:
        """How the class is named."""
        return str(getattr(self, self.named_by))

    def made(self) -> Any:
        """The part."""
        return self.kind.made(self.spec, self.options)

    @model_validator(mode="before")
    @classmethod
    def _with_its_defaults(cls, stated: Any) -> Any:
        if not isinstance(stated, Mapping) or not isinstance(stated.get(cls.named_by), str):
            return stated
        options = stated.get("options", {})
        if not isinstance(options, Mapping):
            return stated
        return {**stated, "options": {**defaults(cls.kind.found(stated[cls.named_by])), **options}}

    @model_validator(mode="after")
    def _takes_its_options(self) -> OwnPart:
        json.dumps(self.options, allow_nan=False)
        self.made()
        return self

    def columns(self, prefix: str, told: Mapping[str, Scalar]) -> dict[str, Scalar]:
        """Columns of the results: which part it was, its options that are single values, and what it told of the case.

        Raises
        ------
        ValueError
            Where the part tells a column of no allowed name or value, or one that has an option's name.
        """
        options = {name: value for name, value in self.options.items() if isinstance(value, bool | int | float | str)}
        row: dict[str, Scalar] = {f"{prefix}_{self.named_by}": self.spec}
        for name, value in (*options.items(), *checked_columns(self.spec, told).items()):
            column = f"{prefix}_{name}"
            if column in row:
                raise ValueError(f"'{self.spec}' tells the column {name} twice, or it is one of its options")
            row[column] = value
        return row


def usual_or(usual: type[BaseModel], own: type[OwnPart]) -> Discriminator:
    """Tells a table that names a user's own part from the usual one; the tags are the models' names."""

    def model(stated: Any) -> str:
        named = own.named_by in stated if isinstance(stated, Mapping) else isinstance(stated, own)
        return own.__name__ if named else usual.__name__

    return Discriminator(model)


def checked_columns(spec: str, told: object, *, texts: bool = True) -> dict[str, Scalar]:
    """What a part tells of a case, as columns: numbers as floats, truth values and texts as they are.

    Raises
    ------
    ValueError
        Where it is no mapping, a name is no identifier in ASCII, or a value is neither a number nor true or false (nor
        a text, where texts are allowed).
    """
    if not isinstance(told, Mapping):
        raise ValueError(f"'{spec}' gives its columns as a {type(told).__name__}; allowed: a mapping")
    row: dict[str, Scalar] = {}
    for name, value in told.items():
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
