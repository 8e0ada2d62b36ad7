"""Transport of measurements to the process of an algorithm: pickled into shared memory, arrays without an extra copy.

Calibrations are large and the same for all images of a case: each is sent once per case. Received arrays are read-only.
"""

import io
import os
import pickle  # of measurements only, from the worker to the algorithm
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from marsyard.sim.measurements import DetectorCalibration, MastCalibration

#: Types of the objects that are sent once per case.
_SENT_ONCE = (DetectorCalibration, MastCalibration)


@dataclass(frozen=True)
class Layout:
    """Sizes, in bytes, of the consecutive blocks of a message: pickled objects, the last is the arguments; arrays."""

    pickles: list[int]
    arrays: list[int]


class Sender:
    """Writes the arguments of calls into shared memory (a file descriptor). Create a new one for each case."""

    def __init__(self, memory_fd: int) -> None:
        self._memory_fd = memory_fd
        self._sent: list[Any] = []

    def send(self, arguments: tuple[Any, ...]) -> Layout:
        """Write the arguments of a call; the message replaces the previous one."""
        known = len(self._sent)
        main = _dump(arguments, self._sent)
        messages = [*(_dump(item) for item in self._sent[known:]), main]
        pickles = [message for message, _ in messages]
        arrays: list[memoryview] = [buffer.raw() for _, buffers in messages for buffer in buffers]
        offset = 0
        blocks: list[bytes | memoryview] = [*pickles, *arrays]
        for block in blocks:
            view = memoryview(block).cast("B")
            while view.nbytes:
                written = os.pwrite(self._memory_fd, view, offset)
                view, offset = view[written:], offset + written
        return Layout([len(message) for message in pickles], [array.nbytes for array in arrays])


def _dump(value: Any, sent: list[Any] | None = None) -> tuple[bytes, list[pickle.PickleBuffer]]:
    """Pickle a value with separate arrays.

    Objects that are sent once are replaced by their index in `sent`, to which new ones are appended.
    """
    file, buffers = io.BytesIO(), list[pickle.PickleBuffer]()
    pickler = pickle.Pickler(file, protocol=5, buffer_callback=buffers.append)
    if sent is not None:

        def find_index(item: Any) -> int | None:
            if not isinstance(item, _SENT_ONCE):
                return None
            index = next((number for number, other in enumerate(sent) if other is item), len(sent))
            if index == len(sent):
                sent.append(item)
            return index

        pickler.persistent_id = find_index  # type: ignore[method-assign]
    pickler.dump(value)
    return file.getvalue(), buffers


class Receiver:
    """Reads the arguments of calls from shared memory (a file descriptor). Create a new one for each case."""

    def __init__(self, memory_fd: int) -> None:
        self._memory_fd = memory_fd
        self._received: list[Any] = []

    def receive(self, layout: Layout) -> tuple[tuple[Any, ...], int | None]:
        """Return the arguments, and a checksum of their arrays; None without arrays."""
        blocks = self._read(layout.pickles, 0)
        arrays = self._read(layout.arrays, sum(layout.pickles))
        buffers: Iterator[bytes] = iter(arrays)
        for block in blocks[:-1]:
            self._received.append(pickle.loads(block, buffers=buffers))  # noqa: S301
        unpickler = pickle.Unpickler(io.BytesIO(blocks[-1]), buffers=buffers)  # noqa: S301
        unpickler.persistent_load = self._received.__getitem__  # type: ignore[method-assign]
        arguments: tuple[Any, ...] = unpickler.load()
        # a sum over different arrays does not depend on their order, or on which objects refer to the same array
        return arguments, sum({zlib.crc32(array) for array in arrays}) & 0xFFFFFFFF if arrays else None

    def _read(self, sizes: Sequence[int], offset: int) -> list[bytes]:
        blocks = []
        for size in sizes:
            blocks.append(os.pread(self._memory_fd, size, offset))
            offset += size
        return blocks
