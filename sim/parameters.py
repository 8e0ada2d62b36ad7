"""Base class and common field types of all parameters."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]


class Parameters(BaseModel):
    """User parameters: unknown keys are errors, validated objects are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True)
