"""Velocity estimators for tests of the isolation: one counts its constructions, another searches for the truth."""

import gc
import os
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentFrame, DescentMeasurements

#: Largest number of elements of an array that is searched.
_MAX_ELEMENTS = 100_000


def append_line(text: str) -> None:
    """Append a line to the file to which the environment variable LOG points."""
    with Path(os.environ["LOG"]).open("a") as file:
        file.write(f"{text}\n")


class Counting:
    """Writes a line for its construction, for each reset and for each case, with its process and device."""

    def __init__(self, device: str) -> None:
        self.device = device
        append_line(f"construct {os.getpid()} {device}")

    def reset(self) -> None:
        """Start a case."""
        append_line("reset")

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """See `VelocityEstimator`; the velocity is random."""
        append_line(f"estimate {os.getpid()}")
        return VelocityEstimate(VelocityOutcome.VALID, np.random.random_sample(2))  # noqa: NPY002


class Wandering:
    """Velocity estimator with a random answer, drawn at its construction and before each case; its start is slow."""

    def __init__(self) -> None:
        time.sleep(1.0)
        self.first = np.random.random_sample()  # noqa: NPY002

    def reset(self) -> None:
        """Start a case."""
        self.second = np.random.random_sample()  # noqa: NPY002

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """See `VelocityEstimator`; takes 0.2 s of processor time."""
        start_s = time.process_time()
        while time.process_time() - start_s < 0.2:
            pass
        return VelocityEstimate(VelocityOutcome.VALID, np.array([self.first, self.second]))


class Slow:
    """Velocity stream that waits at each image."""

    def start(self) -> None:
        """See `VelocityStream`."""

    def process_image(self, frame: DescentFrame) -> VelocityEstimate | None:
        time.sleep(0.5)
        return None

    def finish(self) -> VelocityEstimate:
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)


class Hanging:
    """Velocity estimator without an answer."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        time.sleep(3600.0)
        raise AssertionError


class Stream:
    """Velocity stream that counts the images it received."""

    def __init__(self) -> None:
        self.images = 0

    def start(self) -> None:
        self.images = 0

    def process_image(self, frame: DescentFrame) -> VelocityEstimate | None:
        self.images += 1
        append_line(f"{type(frame).__name__} {self.images}")
        return None

    def finish(self) -> VelocityEstimate:
        return VelocityEstimate(VelocityOutcome.VALID, np.array([float(self.images), 0.0]))


def _numbers(value: Any) -> Iterator[float]:
    """Yield the numbers in an object: floats, and elements of arrays."""
    if isinstance(value, float):
        yield value
    elif isinstance(value, np.ndarray) and value.dtype.kind == "f" and value.size <= _MAX_ELEMENTS:
        yield from value.ravel().tolist()


def _search_memory() -> Iterator[float]:
    """Yield all numbers in the containers and objects of this process, and in the variables of its frames."""
    frame: FrameType | None = sys._getframe()
    containers: list[Any] = [dict(vars(module)) for module in list(sys.modules.values()) if module is not None]
    while frame is not None:
        containers.append(dict(frame.f_locals))
        frame = frame.f_back
    for item in [*gc.get_objects(), *containers]:
        yield from _numbers(item)
        values = item.values() if isinstance(item, dict) else item if isinstance(item, list | tuple | set) else ()
        for value in list(values):
            yield from _numbers(value)
        contents = getattr(type(item), "__dataclass_fields__", {})
        for name in contents:
            yield from _numbers(getattr(item, name, None))


def _search_files() -> Iterator[float]:
    """Yield the numbers in the environment, in the command line, and in all files below the folders that it knows."""
    if "TMPDIR" not in os.environ:
        return  # in the process of the test
    texts = ["\n".join([*os.environ.values(), *sys.argv])]
    folders = {Path.cwd(), Path(os.environ["TMPDIR"]), *(Path(entry) for entry in sys.argv if Path(entry).is_dir())}
    marker = os.environ.get("MARSYARD_WORKER")
    folders |= {Path(marker)} if marker else set()
    for descriptor in Path("/proc/self/fd").iterdir():
        target = Path(os.path.realpath(descriptor))
        folders |= {target.parent} if target.is_file() and target.parent != Path("/") else set()
    for folder in folders:
        for path in folder.rglob("*"):
            is_searched = path.is_file() and path.stat().st_size < 1_000_000 and str(path) != os.environ["LOG"]
            texts += [path.read_bytes().decode(errors="replace")] if is_searched else []
    for text in texts:
        yield from (float(number) for number in re.findall(r"-?\d+\.\d{6,}", text))


class Searching:
    """Searches memory and files for numbers; writes those of the magnitude of a velocity."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        found = {number for search in (_search_memory, _search_files) for number in search()}
        numbers = [float(number) for number in found if isinstance(number, float)]
        append_line(" ".join(repr(number) for number in numbers if abs(number) < 1e3))
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)


class Modules:
    """Writes the names of the modules that its process has loaded."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        append_line("\n".join(sys.modules))
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)
