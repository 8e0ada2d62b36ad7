"""Give each algorithm a read-only copy of its inputs, and check afterwards that the copy is unchanged."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.faults import AlgorithmError, Fault

Given = TypeVar("Given")


class Handover(Generic[Given]):
    """One algorithm's read-only copy `given` of its inputs: data classes, arrays and poses."""

    def __init__(self, original: Given) -> None:
        self.given = copy_inputs(original)
        self._fingerprint = hash_inputs(self.given)

    def check(self) -> None:
        """Raise AlgorithmError (BAD_ANSWER) if the algorithm changed its copy, pictures included."""
        if hash_inputs(self.given) != self._fingerprint:
            raise AlgorithmError(
                Fault.BAD_ANSWER, "it changed the measurements that it was given; allowed: to read them, or copies"
            )


def copy_inputs(original: Given, *, writable: bool = False) -> Given:
    """Return a deep copy whose arrays are read-only, or writable to detect changes.

    Rotations and transforms are immutable and not copied: a copy would be normalised again, with other last digits.
    """
    poses = {id(part): part for part in _parts(original) if isinstance(part, Rotation | RigidTransform)}
    copied = copy.deepcopy(original, dict(poses))
    for part in _parts(copied):
        if isinstance(part, np.ndarray):
            part.flags.writeable = writable
    return copied


def hash_inputs(value: Any, leave: tuple[str, ...] = ()) -> str:
    """Compute the SHA-256 of all values in arrays, poses and data classes, without the fields in `leave`."""
    digest = hashlib.sha256()
    for part in _parts(value, leave):
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype}{part.shape}".encode())
            digest.update(np.ascontiguousarray(part).data)
        elif isinstance(part, Rotation):
            digest.update(part.as_quat().tobytes())
        elif isinstance(part, RigidTransform):
            digest.update(part.as_matrix().tobytes())
        else:
            digest.update(repr(part).encode())
    return digest.hexdigest()


def _parts(value: Any, leave: tuple[str, ...] = ()) -> Iterator[Any]:
    """Yield the arrays, poses and other values in data classes, lists and tuples, and the names of the types."""
    if is_dataclass(value) and not isinstance(value, type):
        yield type(value).__name__
        for field in fields(value):
            if field.name not in leave:
                yield from _parts(getattr(value, field.name), leave)
    elif isinstance(value, list | tuple):
        yield len(value)
        for inner in value:
            yield from _parts(inner, leave)
    else:
        yield value
