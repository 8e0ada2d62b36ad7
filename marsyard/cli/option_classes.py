"""Dataclasses as the options of a command."""

import inspect
from collections.abc import Callable
from typing import Any, TypeVar, get_type_hints

Options = TypeVar("Options")


def with_options(kind: type[Options]) -> Callable[[Callable[[Options], None]], Callable[..., None]]:
    """Return a decorator that makes the fields of the dataclass `kind` options and passes the command an instance."""
    hints = get_type_hints(kind, include_extras=True)
    fields = [field.replace(annotation=hints[name]) for name, field in inspect.signature(kind).parameters.items()]

    def decorate(command: Callable[[Options], None]) -> Callable[..., None]:
        def call(**values: Any) -> None:
            command(kind(**values))

        call.__name__, call.__doc__ = command.__name__, command.__doc__
        call.__annotations__ = hints
        call.__signature__ = inspect.Signature(fields)  # type: ignore[attr-defined]
        return call

    return decorate
