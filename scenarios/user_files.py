"""Files of a user: parameters that name a file with its hash, CSV tables, import paths, and lists of problems."""

from __future__ import annotations

import csv
import difflib
import importlib
import importlib.util
import math
import sys
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, Field, model_validator
from scipy.spatial.transform import Rotation

from marsyard.algorithms.answers import AlgorithmError
from marsyard.sim.files import check_regular
from marsyard.sim.frames import SITE_FROM_WORLD
from marsyard.sim.parameters import Parameters

#: Packages that were imported under their own names before they became parts of `marsyard`.
_FORMER = ("sim", "algorithms", "scenarios", "campaigns", "reports")


def current_module(module: str) -> str:
    """Return the current name of a module that a stored campaign or an older file names by its former one.

    ``algorithms.dimes`` becomes ``marsyard.algorithms.dimes``; names of other packages are returned unchanged.
    """
    if module.partition(".")[0] not in _FORMER:
        return module
    try:
        exists = importlib.util.find_spec(f"marsyard.{module}") is not None
    except ImportError:
        exists = False
    return f"marsyard.{module}" if exists else module


def import_object(path: str) -> Any:
    """Import the object at ``module:name``. Raises ImportError with the reason.

    The current folder is searched last: a file in it never shadows an installed package.
    """
    module, _, name = path.partition(":")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    try:
        return getattr(importlib.import_module(current_module(module)), name)
    except ImportError:
        raise
    except Exception as error:  # a module may raise anything
        raise ImportError(f"{type(error).__name__}: {error}") from error


def source_files(path: str) -> Iterator[tuple[str, Path]]:
    """Yield names and files of the sources of the package or module that contains ``module:name``."""
    parts = current_module(path.partition(":")[0]).split(".")
    top = ".".join(parts[:2] if parts[0] == "marsyard" else parts[:1])
    spec = importlib.util.find_spec(top)
    if spec is None or spec.origin is None:
        return
    origin = Path(spec.origin)
    if spec.submodule_search_locations:
        yield from relative_to(origin.parent.parent, sorted(origin.parent.rglob("*.py")))
    else:
        yield origin.name, origin


def relative_to(base: Path, paths: Iterable[Path]) -> Iterator[tuple[str, Path]]:
    """Yield files with their names relative to a folder."""
    for path in paths:
        yield path.relative_to(base).as_posix(), path


Row = TypeVar("Row")

#: Maximum number of problems of a file in one message.
_MAX_PROBLEMS = 20


@runtime_checkable
class NamesFiles(Protocol):
    """Parameters that name files; options of a user's algorithm may have the method as well."""

    def input_files(self) -> Sequence[str]:
        """Return the paths of the files, as stated."""


def input_files(parameters: Any) -> tuple[str, ...]:
    """Return the distinct files that parameters name anywhere in their tree."""
    return tuple(dict.fromkeys(_files_in(parameters)))


def _files_in(value: Any) -> Iterator[str]:
    if isinstance(value, NamesFiles):
        yield from value.input_files()
    if isinstance(value, BaseModel):
        for name in type(value).model_fields:
            yield from _files_in(getattr(value, name))
    elif isinstance(value, Mapping):
        for inner in value.values():
            yield from _files_in(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _files_in(inner)


class UserFile(Parameters):
    """A file with its hash, which is added when the campaign is read and checked in each case."""

    file: Annotated[str, Field(description="path of the file")]
    sha256: Annotated[str | None, Field(description="of the file; filled in")] = None

    def input_files(self) -> tuple[str, ...]:
        """Return the file."""
        return (self.file,)

    @classmethod
    @abstractmethod
    def file_hash(cls, file: str) -> str:
        """Return the SHA-256 of a usable file. Raises ValueError, which names the file."""

    @model_validator(mode="before")
    @classmethod
    def _add_hash(cls, stated: Any) -> Any:
        if isinstance(stated, Mapping) and isinstance(stated.get("file"), str) and stated.get("sha256") is None:
            return {**stated, "sha256": cls.file_hash(stated["file"])}
        return stated

    @model_validator(mode="after")
    def _check_hash(self) -> UserFile:
        if self.sha256 != self.file_hash(self.file):
            raise ValueError(f"{self.file}: has changed since the campaign was made from it")
        return self


def format_problems(file: Path, problems: Sequence[str]) -> str:
    """Format the problems of a file as one message, with a maximum number of them."""
    more = [f"... and {len(problems) - _MAX_PROBLEMS} more"] if len(problems) > _MAX_PROBLEMS else []
    return "\n  ".join([f"{file}:", *problems[:_MAX_PROBLEMS], *more])


def parse_table(
    path: Path,
    max_rows: int,
    needed: Sequence[str],
    allowed: Sequence[str],
    hint: str,
    parse: Callable[[int, Mapping[str, str]], Row],
) -> tuple[list[Row], list[str]]:
    """Parse the rows of a table by line and cells; return them, and the problems of the others by line.

    Raises ValueError where the file is unreadable, is no table with commas, has too many rows, or lacks columns or has
    unknown ones; `hint` states the allowed ones. `parse` raises ValueError or AlgorithmError.
    """
    header, lines = _read_lines(path, max_rows)
    problems = list(_header_problems(header, needed, allowed, hint))
    if problems:
        raise ValueError(format_problems(path, problems))
    rows: list[Row] = []
    for line, cells in lines:
        try:
            if len(cells) != len(header):
                raise ValueError(f"it has {len(cells)} cells; the first line has {len(header)}")
            rows.append(parse(line, dict(zip(header, cells, strict=True))))
        except (ValueError, AlgorithmError) as error:
            problems.append(f"line {line}: {error}")
    return rows, problems


def _read_lines(path: Path, max_rows: int) -> tuple[list[str], list[tuple[int, list[str]]]]:
    try:
        check_regular(path)
        with path.open(newline="", encoding="utf-8-sig") as text:
            reader = csv.reader(text)
            header = [name.strip() for name in next(reader, [])]
            lines = []
            for cells in reader:
                if any(cell.strip() for cell in cells):
                    lines.append((reader.line_num, [cell.strip() for cell in cells]))
                if len(lines) > max_rows:
                    raise ValueError(f"{path}: has more than {max_rows} rows; divide it")
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: is no table with commas: {error}") from error
    return header, lines


def _header_problems(header: Sequence[str], needed: Sequence[str], allowed: Sequence[str], hint: str) -> Iterator[str]:
    if not header:
        yield "it is empty"
        return
    for name in needed:
        if name not in header:
            yield f"the column '{name}' is missing"
    for name in dict.fromkeys(header):
        if name not in allowed:
            near = difflib.get_close_matches(name, allowed, n=1, cutoff=0.6)
            suggestion = f" (did you mean '{near[0]}'?)" if near else ""
            yield f"unknown column '{name}'{suggestion}; {hint}"
        if header.count(name) > 1:
            yield f"the column '{name}' stands there twice"


def finite_number(name: str, text: str, otherwise: str = "") -> float:
    """Parse a finite number. Raises ValueError, whose message ends with `otherwise`."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{name} is '{text}'; allowed: a finite number{otherwise}")
    return value


def check_together(groups: Iterable[Sequence[str]], given: Mapping[str, float]) -> None:
    """Raise ValueError where a group of columns is filled in part."""
    for names in groups:
        filled = [name for name in names if name in given]
        missing = [name for name in names if name not in given]
        if filled and missing:
            raise ValueError(f"{filled[0]} is given, but {missing[0]} is not")


#: Rotations from a file's world axes to east, north, up.
_WORLD = {"enu": Rotation.identity(), "ned": SITE_FROM_WORLD.inv()}
#: OpenCV's camera axes (x right, y down, z forward) in the body's: camera along -z, columns along x.
_CAMERA_IN_BODY = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))


class RecordedAxes(Parameters):
    """Axes of recorded poses, and mounting of the camera in the recorded vehicle."""

    axes: Annotated[Literal["enu", "ned"], Field(description="world axes: east, north, up; or north, east, down")]
    attitude_of: Annotated[
        Literal["camera", "body"],
        Field(description="whose axes: OpenCV's of the camera, or the body's, whose camera looks along -z"),
    ] = "camera"
    mounting: Annotated[
        tuple[float, float, float, float],
        Field(description="quaternion x, y, z, w from those axes of the camera or body to the recorded vehicle's"),
    ] = (0.0, 0.0, 0.0, 1.0)
    lever_m: Annotated[
        tuple[float, float, float], Field(description="the camera in the recorded vehicle's axes, m")
    ] = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _check_mounting(self) -> RecordedAxes:
        if abs(float(np.linalg.norm(self.mounting)) - 1.0) > 1e-3:
            raise ValueError(f"mounting {list(self.mounting)} is no quaternion of length 1")
        return self

    @property
    def world(self) -> Rotation:
        """Rotation from the file's world axes to east, north, up."""
        return _WORLD[self.axes]

    def bodies(self, world_from_vehicle: Rotation) -> Rotation:
        """Convert attitudes of the recorded vehicle to those of the body, both relative to east, north, up."""
        attitudes = world_from_vehicle * Rotation.from_quat(np.array(self.mounting))
        return attitudes * _CAMERA_IN_BODY.inv() if self.attitude_of == "camera" else attitudes

    def levers(self, world_from_vehicle: Rotation) -> Float64[np.ndarray, "*batch 3"]:
        """Return the offsets from the recorded vehicle to the camera in east, north, up."""
        return np.asarray(world_from_vehicle.apply(np.array(self.lever_m)))
