"""Input files of users among the parameters, with their hashes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Protocol, runtime_checkable

from pydantic import BaseModel, Field, model_validator

from marsyard.sim.parameters import Parameters


@runtime_checkable
class HasInputFiles(Protocol):
    """An object with input files: parameters, or options of a user's algorithm."""

    def input_files(self) -> Sequence[str]:
        """Return the paths of the files, as written."""


def input_files(parameters: Any) -> tuple[str, ...]:
    """Return the distinct input files anywhere in the tree of parameters."""
    return tuple(dict.fromkeys(_find_files(parameters)))


def _find_files(value: Any) -> Iterator[str]:
    """Yield the input files of a value and of the values that it contains."""
    if isinstance(value, HasInputFiles):
        yield from value.input_files()
    if isinstance(value, BaseModel):
        for name in type(value).model_fields:
            yield from _find_files(getattr(value, name))
    elif isinstance(value, Mapping):
        for inner in value.values():
            yield from _find_files(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _find_files(inner)


class UserFile(Parameters):
    """A user's file with its hash; the hash is added when the campaign is read, and checked in each case."""

    file: Annotated[str, Field(description="path of the file")]
    sha256: Annotated[str | None, Field(description="SHA-256 of the file; set automatically")] = None

    def input_files(self) -> tuple[str, ...]:
        """Return the path of the file."""
        return (self.file,)

    @classmethod
    @abstractmethod
    def file_hash(cls, file: str) -> str:
        """Return the SHA-256 of a valid file. Raises ValueError with the file's name."""

    @model_validator(mode="before")
    @classmethod
    def _add_hash(cls, values: Any) -> Any:
        if isinstance(values, Mapping) and isinstance(values.get("file"), str) and values.get("sha256") is None:
            return {**values, "sha256": cls.file_hash(values["file"])}
        return values

    @model_validator(mode="after")
    def _check_hash(self) -> UserFile:
        if self.sha256 != self.file_hash(self.file):
            raise ValueError(f"{self.file}: file has changed since the campaign was created")
        return self
