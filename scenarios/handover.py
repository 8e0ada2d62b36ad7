"""What an algorithm is given: a copy of its own, which it cannot write to, checked when it has answered."""

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
    """One algorithm's copy of its inputs: data classes, arrays and poses. The original stays as it is for the others.

    Attributes
    ----------
    given
        The copy; its arrays are read-only.
    """

    def __init__(self, original: Given) -> None:
        self.given = _read_only_copy(original)
        self._digest = _digest(self.given)

    def check(self) -> None:
        """Raises AlgorithmError (BAD_ANSWER) if the algorithm changed its copy, pictures included."""
        if _digest(self.given) != self._digest:
            raise AlgorithmError(
                Fault.BAD_ANSWER, "it changed the measurements that it was given; allowed: to read them, or copies"
            )


def _read_only_copy(original: Given) -> Given:
    """A deep copy whose arrays are read-only. Single rotations and transforms cannot be changed and stay the same
    objects: a copy of them would be normalised again and differ in its last digits.
    """
    poses = {id(part): part for part in _parts(original) if isinstance(part, Rotation | RigidTransform)}
    made = copy.deepcopy(original, dict(poses))
    for part in _parts(made):
        if isinstance(part, np.ndarray):
            part.flags.writeable = False
    return made


def _digest(thing: Any) -> bytes:
    """SHA-256 of all arrays, bit for bit."""
    digest = hashlib.sha256()
    for part in _parts(thing):
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype}{part.shape}".encode())
            digest.update(np.ascontiguousarray(part).data)
    return digest.digest()


def _parts(thing: Any) -> Iterator[Any]:
    """The arrays, poses and other values in data classes, lists and tuples."""
    if is_dataclass(thing):
        for field in fields(thing):
            yield from _parts(getattr(thing, field.name))
    elif isinstance(thing, list | tuple):
        for inner in thing:
            yield from _parts(inner)
    else:
        yield thing
