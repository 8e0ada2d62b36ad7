"""Base class and field types of all user parameters; merging of nested parameters, and alternatives of their types."""

import types
from collections.abc import Mapping
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]


def bounded_field(low: float, high: float, description: str) -> Any:
    """Create a field of a number from `low` to `high`, both included."""
    return Field(ge=low, le=high, description=description)


class Parameters(BaseModel):
    """Base class of user parameters: unknown keys are errors, objects are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _complete_presets(cls, values: Any) -> Any:
        """Complete tables whose default is a preset."""
        if not isinstance(values, Mapping):
            return values
        completed = {}
        for name, field in cls.model_fields.items():
            if isinstance(values.get(name), Mapping):
                default = field.get_default(call_default_factory=True)
                if isinstance(default, BaseModel):
                    completed[name] = _complete_table(default, values[name])
        return {**values, **completed} if completed else values


def _complete_table(preset: BaseModel, table: Mapping[Any, Any]) -> Mapping[Any, Any]:
    """Complete a table by the values of the field's default, if these are not the defaults of their class.

    A table that changes one value of a preset, such as the noise of an instrument, then keeps the other values. A table
    with keys of another class, such as a custom instrument, or with the name of a file is returned unchanged.
    """
    kind = type(preset)
    try:
        is_preset = preset != kind()
    except ValidationError:
        is_preset = True
    names_file = table.get("file") is not None
    if not is_preset or names_file or not table.keys() <= kind.model_fields.keys():
        return table
    values = {name: getattr(preset, name) for name in kind.model_fields}
    for name, value in table.items():
        is_table = isinstance(value, Mapping) and isinstance(values[name], BaseModel)
        values[name] = _complete_table(values[name], value) if is_table else value
    return values


def merge_parameters(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Merge changes into nested parameters: tables are merged, other values replaced."""
    merged = dict(base)
    for key, value in changes.items():
        current = merged.get(key)
        if isinstance(current, Mapping) and isinstance(value, Mapping):
            value = merge_parameters(current, value)
        merged[key] = value
    return merged


def list_models(annotation: Any) -> list[type[BaseModel]]:
    """List the tables among the alternatives of a parameter's type."""
    return [item for item in list_alternatives(annotation) if isinstance(item, type) and issubclass(item, BaseModel)]


def list_alternatives(annotation: Any) -> list[Any]:
    """List the members of a union, or the type itself; metadata of `Annotated` types are removed."""
    origin = get_origin(annotation)
    if origin is Annotated:
        return list_alternatives(get_args(annotation)[0])
    if origin in (Union, types.UnionType):
        return [inner for choice in get_args(annotation) for inner in list_alternatives(choice)]
    return [annotation]
