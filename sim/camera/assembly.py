"""What the readers of camera files share: their error, and putting a camera together from what was read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.cahv import Cahv
from marsyard.sim.camera.cahvor import Cahvor
from marsyard.sim.camera.cahvore import Cahvore
from marsyard.sim.camera.vectors import Real
from marsyard.sim.files import open_regular

#: Labels of several megabytes are there; camera files are small.
_MOST_BYTES = 1 << 23


class CameraFileError(ValueError):
    """A camera file that cannot be used. The message names the file, the field and what is allowed."""


@dataclass(frozen=True)
class Source:
    """The file that is being read, for messages."""

    path: str

    def error(self, field: str, fault: str, allowed: str) -> CameraFileError:
        """The error to raise for a field."""
        return CameraFileError(f"{self.path}: {field}: {fault}; allowed: {allowed}")

    def text(self) -> str:
        """The whole file.

        Raises
        ------
        CameraFileError
            If it cannot be read, or is larger than any camera file is.
        """
        contents = self.head(_MOST_BYTES + 1)
        if len(contents) > _MOST_BYTES:
            raise self.error("file", f"is larger than {_MOST_BYTES >> 20} MiB", "a camera file or label, not a picture")
        return contents.decode("latin-1")

    def head(self, count: int) -> bytes:
        """The file's first bytes, of which there must be some."""
        try:
            with open_regular(self.path) as file:
                read = file.read(count)
        except OSError as fault:
            raise self.error("file", f"cannot be read ({fault.strerror})", "a readable camera file") from fault
        if not read:
            raise self.error("file", "is empty (0 bytes)", "a camera file")
        return read


#: The models by their names, whose letters are the names of their vectors.
MODELS = ("CAHV", "CAHVOR", "CAHVORE")


def linearity_of_type(kind: Real | None, parameter: float | None, field: str, source: Source) -> float:
    """CAHVORE's linearity from its type (1 perspective, 2 fish-eye, 3 general) and, for type 3, its parameter."""
    if kind == 1:
        return 1.0
    if kind == 2:
        return 0.0
    if kind != 3:
        raise source.error(field, f"CAHVORE's type is {'missing' if kind is None else kind}", "type 1, 2 or 3")
    if parameter is None:
        raise source.error(field, "CAHVORE of type 3 has no parameter", "type 3 with its linearity, from -1 to 1")
    return parameter


def assembled(
    name: str,
    vectors: Mapping[str, Sequence[float]],
    size: tuple[int, int],
    linearity: float | None,
    source: Source,
) -> CameraModel:
    """The camera from what a file holds: the name of its model, and its vectors by their letters.

    Raises
    ------
    CameraFileError
        If the camera refuses it.
    """
    c, a, h, v, *lens = (np.array(vectors[letter], dtype=np.float64) for letter in name)
    try:
        if name == "CAHV":
            return Cahv(c, a, h, v, size)
        if name == "CAHVOR":
            return Cahvor(c, a, h, v, lens[0], lens[1], size)
        if linearity is None:
            raise ValueError("linearity is missing")
        return Cahvore(c, a, h, v, lens[0], lens[1], lens[2], linearity=linearity, size=size)
    except ValueError as fault:
        field, _, _ = str(fault).partition(" ")
        raise source.error(
            field.upper(), str(fault), "a camera model of unit A and O and independent H, V, A"
        ) from fault
