"""Numbers that can be missing or infinite in JSON: null."""

import math
from typing import Annotated, Any

from pydantic import BeforeValidator, WithJsonSchema

#: A float; JSON represents NaN and infinities by null, which is read as NaN.
Number = Annotated[
    float,
    BeforeValidator(lambda value: math.nan if value is None else value),
    WithJsonSchema({"anyOf": [{"type": "number"}, {"type": "null"}]}),
]


def convert_to_json(value: Any) -> Any:
    """Convert nested tables and lists to JSON types; numbers that are not finite become null."""
    if isinstance(value, dict):
        return {name: convert_to_json(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [convert_to_json(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
