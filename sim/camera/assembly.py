"""Common parts of the camera file readers: error messages, bounded reading, construction of the camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marsyard.sim.camera.base import CameraModel, Real
from marsyard.sim.camera.models import Cahv, Cahvor, Cahvore
from marsyard.sim.files import open_regular

#: Maximum size of a camera file; some labels have several megabytes.
MAX_BYTES = 1 << 23
#: Names of the models; their letters are the names of their vectors.
MODELS = ("CAHV", "CAHVOR", "CAHVORE")


class CameraFileError(ValueError):
    """A camera file that cannot be used. The message names the file, the field and the allowed values."""


@dataclass(frozen=True)
class Source:
    """Path of the file that is read, for its content and for error messages."""

    path: str

    def error(self, field: str, fault: str, allowed: str) -> CameraFileError:
        """Create the error for a field."""
        return CameraFileError(f"{self.path}: {field}: {fault}; allowed: {allowed}")

    def text(self) -> str:
        """Read the whole file. Raises CameraFileError if it is unreadable, empty or larger than `MAX_BYTES`."""
        contents = self.head(MAX_BYTES + 1)
        if len(contents) > MAX_BYTES:
            raise self.error("file", f"is larger than {MAX_BYTES >> 20} MiB", "a camera file or label, not a picture")
        return contents.decode("latin-1")

    def head(self, count: int) -> bytes:
        """Read at most `count` bytes. Raises CameraFileError if the file is unreadable or empty."""
        try:
            with open_regular(self.path) as file:
                read = file.read(count)
        except OSError as fault:
            raise self.error("file", f"cannot be read ({fault.strerror})", "a readable camera file") from fault
        if not read:
            raise self.error("file", "is empty (0 bytes)", "a camera file")
        return read


def linearity_of_type(kind: Real | None, parameter: float | None, field: str, source: Source) -> float:
    """Return CAHVORE's linearity for its type (1 perspective, 2 fish-eye, 3 general) and the parameter of type 3."""
    if kind in (1, 2):
        return 1.0 if kind == 1 else 0.0
    if kind != 3:
        raise source.error(field, f"CAHVORE's type is {'missing' if kind is None else kind}", "type 1, 2 or 3")
    if parameter is None:
        raise source.error(field, "CAHVORE of type 3 has no parameter", "type 3 with its linearity, from -1 to 1")
    return parameter


def create_camera(
    name: str, vectors: Mapping[str, Sequence[float]], size: tuple[int, int], linearity: float | None, source: Source
) -> CameraModel:
    """Create the camera of a model name and its vectors by letter. Raises CameraFileError for impossible values."""
    c, a, h, v, *lens = (np.array(vectors[letter], dtype=np.float64) for letter in name)
    try:
        if linearity is not None:
            return Cahvore(c, a, h, v, lens[0], lens[1], lens[2], linearity=linearity, size=size)
        return Cahvor(c, a, h, v, lens[0], lens[1], size) if lens else Cahv(c, a, h, v, size)
    except ValueError as fault:
        field, allowed = str(fault).partition(" ")[0].upper(), "a camera model of unit A and O and independent H, V, A"
        raise source.error(field, str(fault), allowed) from fault
