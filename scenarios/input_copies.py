"""Read-only copies of the inputs of an algorithm, and hashes that show whether the inputs were changed."""

import copy
import hashlib
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.faults import AlgorithmError, Fault

Inputs = TypeVar("Inputs")


class InputCopy(Generic[Inputs]):
    """Read-only copy `inputs` of the inputs of one algorithm: data classes, arrays and poses."""

    def __init__(self, original: Inputs) -> None:
        self.inputs = copy_inputs(original)
        self._fingerprint = hash_inputs(self.inputs)

    def check(self) -> None:
        """Raise AlgorithmError (BAD_ANSWER) if the algorithm changed its copy, images included."""
        if hash_inputs(self.inputs) != self._fingerprint:
            raise AlgorithmError(
                Fault.BAD_ANSWER, "it changed its measurements; allowed: reading them, and changing copies"
            )


def copy_inputs(original: Inputs, *, writable: bool = False) -> Inputs:
    """Return a deep copy whose arrays are read-only, or writable to detect changes.

    Rotations and transforms are immutable and not copied: a copy would be normalised again, with different last digits.
    """
    # `deepcopy` does not copy the objects in its second argument
    immutable = {id(item): item for item in _walk_values(original) if isinstance(item, Rotation | RigidTransform)}
    duplicate = copy.deepcopy(original, dict(immutable))
    for item in _walk_values(duplicate):
        if isinstance(item, np.ndarray):
            item.flags.writeable = writable
    return duplicate


def hash_inputs(value: Any, excluded: tuple[str, ...] = ()) -> str:
    """Compute the SHA-256 of all values in arrays, poses and data classes, without the fields in `excluded`."""
    digest = hashlib.sha256()
    array_digests: dict[int, bytes] = {}  # all images of a stream contain the same calibration
    for item in _walk_values(value, excluded):
        if isinstance(item, np.ndarray):
            if id(item) not in array_digests:
                array_digests[id(item)] = hashlib.sha256(np.ascontiguousarray(item).data).digest()
            digest.update(f"{item.dtype}{item.shape}".encode())
            digest.update(array_digests[id(item)])
        elif isinstance(item, Rotation):
            digest.update(item.as_quat().tobytes())
        elif isinstance(item, RigidTransform):
            digest.update(item.as_matrix().tobytes())
        else:
            digest.update(repr(item).encode())
    return digest.hexdigest()


def _walk_values(value: Any, excluded: tuple[str, ...] = ()) -> Iterator[Any]:
    """Walk through data classes, lists and tuples; yield the class names, lengths, arrays, poses and other values."""
    if is_dataclass(value) and not isinstance(value, type):
        yield type(value).__name__
        for field in fields(value):
            if field.name not in excluded:
                yield from _walk_values(getattr(value, field.name), excluded)
    elif isinstance(value, list | tuple):
        yield len(value)
        for inner in value:
            yield from _walk_values(inner, excluded)
    else:
        yield value
