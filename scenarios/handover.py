"""Inputs handed to an algorithm: its own read-only copy, which is compared after it has answered."""

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
    """One algorithm's copy of its inputs: data classes, arrays and poses. The original stays unchanged for the others.

    Attributes
    ----------
    given
        The copy; its arrays are read-only.
    """

    def __init__(self, original: Given) -> None:
        self.given = handed_copy(original)
        self._fingerprint = fingerprint(self.given)

    def check(self) -> None:
        """Raises AlgorithmError (BAD_ANSWER) if the algorithm changed its copy, pictures included."""
        if fingerprint(self.given) != self._fingerprint:
            raise AlgorithmError(
                Fault.BAD_ANSWER, "it changed the measurements that it was given; allowed: to read them, or copies"
            )


def handed_copy(original: Given, *, writable: bool = False) -> Given:
    """A deep copy whose arrays are read-only, or writable to detect what is written.

    Single rotations and transforms cannot be changed and stay the same objects: a copy of them would be normalised
    again and differ in its last digits.
    """
    poses = {id(part): part for part in _parts(original) if isinstance(part, Rotation | RigidTransform)}
    made = copy.deepcopy(original, dict(poses))
    for part in _parts(made):
        if isinstance(part, np.ndarray):
            part.flags.writeable = writable
    return made


def fingerprint(value: Any, leave: tuple[str, ...] = ()) -> str:
    """SHA-256 of all values, bit for bit, in arrays, poses and data classes; fields named in `leave` are left out."""
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
    """The arrays, poses and other values in data classes, lists and tuples, and the names of their types."""
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
