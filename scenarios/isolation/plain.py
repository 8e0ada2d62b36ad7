"""Plain representation of answers as JSON: the worker reads it without executing anything that an algorithm chose.

Numbers, texts, None, sequences, arrays, poses, enumerations and the data classes of a protocol are represented; the
intermediate products of an answer (`details`) are omitted. A value of any other type is represented by the name of its
type, so that the validation of the answer reports it.
"""

import base64
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.faults import bad_answer

#: Maximum bits of an integer; a float64 is below 2 ** 1024.
_MAX_BITS = 1023
#: Maximum number of letters of a type's name in a message.
_MAX_NAME = 100
#: Field of an answer that stays in the process of the algorithm.
DETAILS = "details"


def encode(value: Any) -> Any:
    """Return the JSON representation of a value of an answer."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, int) and value.bit_length() > _MAX_BITS:
        return {"other": f"integer of {value.bit_length()} bits"}
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value)
        if array.dtype.hasobject:
            return {"other": "array of objects"}
        return {"array": base64.b64encode(array.tobytes()).decode(), "dtype": array.dtype.str, "shape": value.shape}
    if isinstance(value, Enum):
        return {"member": value.name, "class": _lineage(value)}
    if isinstance(value, tuple | list):
        return {"tuple" if isinstance(value, tuple) else "list": [encode(item) for item in value]}
    if isinstance(value, Rotation):
        return {"rotation": encode(value.as_quat())}
    if isinstance(value, RigidTransform):
        return {"pose": encode(value.as_matrix())}
    if is_dataclass(value) and not isinstance(value, type):
        contents = {field.name: encode(getattr(value, field.name)) for field in fields(value) if field.name != DETAILS}
        return {"fields": contents, "class": _lineage(value)}
    return {"other": type(value).__name__}


def _lineage(value: object) -> list[str]:
    """Return the names of the value's class and of its bases."""
    return [item.__qualname__ for item in type(value).__mro__[:-1]]


def decode(value: Any, classes: Mapping[str, type]) -> Any:
    """Return the value of a representation; `classes` are the enumerations and data classes of the protocol, by name.

    Raises AlgorithmError (BAD_ANSWER) if it is not a representation.
    """
    try:
        return _decode(value, classes)
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError, MemoryError) as error:
        raise bad_answer(f"its answer cannot be read: {type(error).__name__}: {error}") from None


def _decode(value: Any, classes: Mapping[str, type]) -> Any:
    if not isinstance(value, dict):
        return value
    if "array" in value:
        shape = tuple(int(extent) for extent in value["shape"])
        return np.frombuffer(base64.b64decode(value["array"]), np.dtype(str(value["dtype"]))).reshape(shape).copy()
    if "tuple" in value or "list" in value:
        items = [_decode(item, classes) for item in value["tuple" if "tuple" in value else "list"]]
        return tuple(items) if "tuple" in value else items
    if "rotation" in value:
        return Rotation.from_quat(_decode(value["rotation"], classes))
    if "pose" in value:
        return RigidTransform.from_matrix(_decode(value["pose"], classes))
    if "class" in value:
        lineage = [str(name) for name in value["class"]]
        known = next((classes[name] for name in lineage if name in classes), None)
        if known is None:
            return _placeholder(lineage[0])
        if issubclass(known, Enum):
            return known[value["member"]]
        contents = {name: _decode(item, classes) for name, item in value["fields"].items()}
        return known(**{field.name: contents[field.name] for field in fields(known) if field.name in contents})  # type: ignore[arg-type]
    return _placeholder(str(value["other"]))


def _placeholder(name: str) -> object:
    """Return an object without contents, whose type has this name."""
    return type(name[:_MAX_NAME], (), {})()
