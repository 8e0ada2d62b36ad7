"""The base class of all parameters, and the types that many of their fields have."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]


def bounded(low: float, high: float, description: str) -> Any:
    """Field of a number from `low` to `high`, both included."""
    return Field(ge=low, le=high, description=description)


class Parameters(BaseModel):
    """Values that a user may state: an unknown key is an error, and a validated object does not change."""

    model_config = ConfigDict(extra="forbid", frozen=True)
