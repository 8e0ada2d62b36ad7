"""What an algorithm may do to its inputs and its process, and what it may look at: taken down, compared, watched."""

from __future__ import annotations

import ast
import copy
import hashlib
import os
import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.scenarios.estimators import sources_of

Thing = TypeVar("Thing")

#: Of `sim`, what an algorithm may know (docs/architecture.md), and of the other packages.
OPEN = ("marsyard.sim.frames", "marsyard.sim.camera", "marsyard.sim.measurements", "marsyard.algorithms")

_HOME = Path(__file__).resolve().parents[2]
#: Files that hold truth, by their names, and by the folder that they lie in.
_TRUE_FILES = ("campaign.json", "cases.sqlite", "cases.parquet")
_TRUE_FOLDER = "terrain"


def own_copy(thing: Thing, *, writable: bool = False) -> Thing:
    """A deep copy; its arrays are read-only, as campaigns hand them over, or writable, to detect what is written."""
    made = copy.deepcopy(thing)
    for array in _arrays(made):
        array.flags.writeable = writable
    return made


def _arrays(thing: Any) -> Iterator[np.ndarray]:
    if isinstance(thing, np.ndarray):
        yield thing
    elif is_dataclass(thing):
        for field in fields(thing):
            yield from _arrays(getattr(thing, field.name))
    elif isinstance(thing, list | tuple):
        for inner in thing:
            yield from _arrays(inner)


def fingerprint(thing: Any, leave: tuple[str, ...] = ("details",)) -> str:
    """A hash of all numbers, bit for bit, in arrays, poses and data classes; fields named in `leave` aside."""
    digest = hashlib.sha256()
    for part in _parts(thing, leave):
        digest.update(part)
    return digest.hexdigest()


def _parts(thing: Any, leave: tuple[str, ...]) -> Iterator[bytes]:
    if isinstance(thing, np.ndarray):
        yield f"{thing.dtype}{thing.shape}".encode() + np.ascontiguousarray(thing).tobytes()
    elif isinstance(thing, Rotation):
        yield thing.as_quat().tobytes()
    elif isinstance(thing, RigidTransform):
        yield thing.as_matrix().tobytes()
    elif is_dataclass(thing):
        yield type(thing).__name__.encode()
        for field in fields(thing):
            if field.name not in leave:
                yield from _parts(getattr(thing, field.name), leave)
    elif isinstance(thing, list | tuple):
        yield f"{len(thing)} in".encode()
        for inner in thing:
            yield from _parts(inner, leave)
    else:
        yield repr(thing).encode()


def surroundings() -> Mapping[str, object]:
    """What of its process an algorithm could change for the cases after it."""
    signals = {name: signal.getsignal(number) for name, number in _SIGNALS.items()}
    return {
        "the current folder": str(Path.cwd()),
        "environment variables": dict(os.environ),
        "NumPy's error handling": dict(np.geterr()),
        "NumPy's global random state": fingerprint(list(np.random.get_state())),  # noqa: NPY002
        "handlers of signals": signals,
    }


_SIGNALS = {"SIGINT": signal.SIGINT, "SIGTERM": signal.SIGTERM, "SIGALRM": signal.SIGALRM}


def closed_imports(spec: str) -> list[str]:
    """What the sources of a Python algorithm import that knows more than an algorithm may: file, line and name."""
    found = []
    for name, path in sources_of(spec):
        try:
            tree = ast.parse(path.read_bytes())
        except (SyntaxError, ValueError):
            continue
        found += [f"{name}, line {line}: {module}" for line, module in _imports(tree) if _is_closed(module)]
    return found


def _imports(tree: ast.AST) -> Iterator[tuple[int, str]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None and node.level == 0:
            yield from ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)


def _is_closed(module: str) -> bool:
    return module.partition(".")[0] == "marsyard" and not any(f"{module}.".startswith(f"{one}.") for one in OPEN)


class _Watcher:
    """Python's audit hook, which cannot be taken away again, and what it has seen while it was asked to look."""

    def __init__(self) -> None:
        self.seen: list[str] | None = None
        self._sources: frozenset[str] = frozenset()
        self._hooked = False

    @contextmanager
    def looking(self, sources: frozenset[str]) -> Iterator[list[str]]:
        """Notes what reaches for truth: files, objects of the process, frames of callers of these sources."""
        if not self._hooked:
            sys.addaudithook(self._hook)
            self._hooked = True
        self.seen, self._sources = [], sources
        try:
            yield self.seen
        finally:
            self.seen = None

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        seen = self.seen
        if seen is None or event not in ("open", "gc.get_objects", "gc.get_referrers", "sys._getframe"):
            return
        self.seen = None  # what is done here is not to be noted
        try:
            said = self._told(event, arguments)
        finally:
            self.seen = seen
        if said and said not in seen:
            seen.append(said)

    def _told(self, event: str, arguments: tuple[Any, ...]) -> str:
        if event == "open":
            return f"it opens {arguments[0]}" if _holds_truth(arguments[0]) else ""
        if event == "sys._getframe":
            frame = arguments[0] if arguments else None
            theirs = isinstance(frame, FrameType) and self._is_theirs(frame)
            return "it looks at its callers' frames (sys._getframe, inspect)" if theirs else ""
        return f"it goes through all objects of the process ({event})"

    def _is_theirs(self, frame: FrameType) -> bool:
        """Whether a frame is the algorithm's own, or one of ours that it has got hold of."""
        file = frame.f_code.co_filename
        return file in self._sources or str(_HOME / "scenarios") in file


def _holds_truth(path: object) -> bool:
    if not isinstance(path, str | os.PathLike):
        return False
    known = Path(path)
    cached = known.parent.name == _TRUE_FOLDER and known.suffix == ".npy"
    return cached or known.name.removesuffix("-wal") in _TRUE_FILES


WATCHER = _Watcher()
