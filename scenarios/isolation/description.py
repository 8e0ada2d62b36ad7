"""Description of a custom algorithm's class or function; its module is imported in a process of its own."""

import json
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from enum import Enum
from typing import Any

from pydantic import BaseModel


def describe_factory(factory: Any) -> dict[str, Any]:
    """Return kind, members, version and options of a class or function, as JSON values (`AlgorithmDescription`)."""
    version = getattr(factory, "version", None)
    return {
        "kind": type(factory).__name__,
        "is_class": isinstance(factory, type),
        "is_callable": callable(factory),
        "members": [name for name in dir(factory) if not name.startswith("_")],
        "version": version if isinstance(version, str) else None,
        "options": plain_options(getattr(factory, "options", None)),
    }


def plain_options(options: object) -> dict[str, Any]:
    """Convert options to JSON values; empty without options, or if JSON cannot represent the options."""
    try:
        if isinstance(options, BaseModel):
            options = options.model_dump(mode="json")
        elif is_dataclass(options) and not isinstance(options, type):
            options = asdict(options)
        values = {str(key): value for key, value in options.items()} if isinstance(options, Mapping) else {}
        return dict(
            json.loads(json.dumps(values, default=lambda value: value.value if isinstance(value, Enum) else str(value)))
        )
    except Exception:  # custom values may raise anything, and the record must not stop a campaign
        return {}
