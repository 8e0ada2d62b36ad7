"""What stands in a campaign's file where a dispersion takes a number: the number, or a formula that gives it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, PlainValidator
from pydantic_core import PydanticKnownError

from marsyard.campaigns.sampling.formulas import formula


class StatedTable(BaseModel):
    """A table of a file: unknown keys are refused, and nothing changes after it is read."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def _number_or_formula(stated: Any) -> float | str:
    """A finite number, or the text of a formula."""
    if isinstance(stated, str):
        return formula(stated).text
    if isinstance(stated, bool) or not isinstance(stated, int | float):
        raise PydanticKnownError("float_type")
    if not abs(stated) < math.inf:
        raise PydanticKnownError("finite_number")
    try:
        return float(stated)
    except OverflowError:
        raise PydanticKnownError("finite_number") from None


def _positive_number_or_formula(stated: Any) -> float | str:
    """A finite number above 0, or the text of a formula."""
    known = _number_or_formula(stated)
    if isinstance(known, float) and not known > 0.0:
        raise PydanticKnownError("greater_than", {"gt": 0})
    return known


def _whole_number_or_formula(stated: Any) -> int | str:
    """A whole number that a float holds exactly, or the text of a formula."""
    if isinstance(stated, str):
        return formula(stated).text
    if type(stated) is not int:
        raise PydanticKnownError("int_type")
    if abs(stated) > 2**52:
        raise ValueError(f"must lie between -2**52 and 2**52, got {stated}")
    return stated


def _literal(stated: Any) -> Any:
    """A value that is drawn as it stands; numbers in it must be finite, as files of results cannot hold others."""
    tables = stated.values() if isinstance(stated, Mapping) else stated if isinstance(stated, list | tuple) else ()
    for inner in tables:
        _literal(inner)
    if isinstance(stated, float) and not math.isfinite(stated):
        raise PydanticKnownError("finite_number")
    return stated


Number = Annotated[float | str, PlainValidator(_number_or_formula)]
PositiveNumber = Annotated[float | str, PlainValidator(_positive_number_or_formula)]
Limits = tuple[Number, Number]
WholeNumber = Annotated[int | str, PlainValidator(_whole_number_or_formula)]
Literally = Annotated[Any, PlainValidator(_literal)]
Weight = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]


def numbers_of(*stated: float | str) -> list[float]:
    """The numbers, none where one of them is a formula yet."""
    return [] if any(isinstance(one, str) for one in stated) else [float(one) for one in stated]


def limits_of(truncate: Limits | None) -> tuple[float, float] | None:
    """Limits as numbers; a formula among them must have been worked out."""
    return None if truncate is None else (float(truncate[0]), float(truncate[1]))
