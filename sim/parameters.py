"""Base class and common field types of all parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from marsyard.sim.renamed import current_key

Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]


def bounded(low: float, high: float, description: str) -> Any:
    """Field of a number from `low` to `high`, both included."""
    return Field(ge=low, le=high, description=description)


class Parameters(BaseModel):
    """User parameters: unknown keys are errors, validated objects are immutable. Former names of keys are accepted."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _rename_former_keys(cls, given: Any) -> Any:
        if not isinstance(given, Mapping) or cls.model_fields.keys() >= given.keys():
            return given
        return {
            current_key(name, cls.model_fields, given) if isinstance(name, str) else name: value
            for name, value in given.items()
        }


def merge_settings(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Merge changes into nested settings: tables are merged, other values replaced."""
    merged = dict(base)
    for key, value in changes.items():
        below = merged.get(key)
        if isinstance(below, Mapping) and isinstance(value, Mapping):
            value = merge_settings(below, value)
        merged[key] = value
    return merged
