"""Measurements in JSON: the keys of a table are the field names of a data class, with the suffix `_xyzw` for rotations.

Arrays are lists. A rotation is a unit quaternion, scalar last; a pose is a position `position_world_m` and a rotation.
A single number that is not finite (no reading) is null, and a missing value has no key. Arrays contain finite numbers
only: `files.write_json` and the lines to a program reject others.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.frames import rigid

Item = TypeVar("Item")
#: Suffix of the key of a rotation, and key of the position of a pose.
_ROTATION, _POSITION = "_xyzw", "position_world_m"


def encode(item: Any, excluded: Collection[str] = ()) -> dict[str, Any]:
    """Encode a data class of measurements for JSON, without the fields in `excluded`."""
    content: dict[str, Any] = {}
    for name in (field.name for field in fields(item) if field.name not in excluded):
        value = getattr(item, name)
        if isinstance(value, RigidTransform):
            content |= encode_pose(name, value)
        elif isinstance(value, Rotation):
            content[name + _ROTATION] = value.as_quat().tolist()
        elif value is not None:
            content[name] = _encode_value(value)
    return content


def encode_pose(name: str, pose: RigidTransform) -> dict[str, Any]:
    """Encode a pose: its position in the world, and the unit quaternion of its rotation under its name."""
    return {_POSITION: np.asarray(pose.translation).tolist(), name + _ROTATION: pose.rotation.as_quat().tolist()}


def decode_pose(name: str, content: Mapping[str, Any]) -> RigidTransform:
    """Decode a pose that `encode_pose` encoded."""
    return rigid(Rotation.from_quat(content[name + _ROTATION]), np.array(content[_POSITION], dtype=np.float64))


def _encode_value(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, tuple):
        return [_encode_value(item) for item in value]
    if is_dataclass(value):
        return encode(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def decode(kind: type[Item], content: Mapping[str, Any], **given: Any) -> Item:
    """Decode a data class that `encode` encoded; `given` are the values of excluded fields.

    Raises KeyError, TypeError or ValueError for other content.
    """
    values, types = dict(given), get_type_hints(kind)
    for name in (field.name for field in fields(kind) if field.name not in given):  # type: ignore[arg-type]
        if name + _ROTATION in content and types[name] is RigidTransform:
            values[name] = decode_pose(name, content)
        elif name + _ROTATION in content:
            values[name] = Rotation.from_quat(content[name + _ROTATION])
        elif name in content:
            values[name] = _decode_value(types[name], content[name])
    return kind(**values)


def _decode_value(kind: Any, value: Any) -> Any:
    """Decode a value of this type: a number, an array, a data class, a tuple of them, or one of them or None."""
    kind = next((part for part in get_args(kind) if part is not type(None)), kind) if _is_optional(kind) else kind
    if is_dataclass(kind):
        return decode(kind, value)  # type: ignore[arg-type]
    if get_origin(kind) is tuple:
        return tuple(_decode_value(get_args(kind)[0], item) for item in value)
    if kind in (float, int):
        return math.nan if value is None else value
    array = np.array(value, dtype=np.float64)
    # without rows, the list does not contain the number of columns
    return array if array.size else array.reshape(-1, 3)


def _is_optional(kind: Any) -> bool:
    return type(None) in get_args(kind)
