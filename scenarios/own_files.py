"""Files of a user: parameters that name a file with its hash, and lists of the problems of a file."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Protocol, runtime_checkable

from pydantic import BaseModel, Field, model_validator

from marsyard.sim.parameters import Parameters

#: Maximum number of problems of a file in one message.
_MAX_PROBLEMS = 20


@runtime_checkable
class NamesFiles(Protocol):
    """Parameters that name files; options of a user's algorithm may have the method as well."""

    def input_files(self) -> Sequence[str]:
        """Return the paths of the files, as stated."""
        ...


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


class OwnFile(Parameters):
    """A file with its hash, which is added when the campaign is read and checked in each case."""

    file: Annotated[str, Field(description="path of the file")]
    sha256: Annotated[str | None, Field(description="of the file; filled in")] = None

    def input_files(self) -> tuple[str, ...]:
        """Return the file."""
        return (self.file,)

    @classmethod
    @abstractmethod
    def hash_of(cls, file: str) -> str:
        """Return the SHA-256 of a usable file. Raises ValueError, which names the file."""

    @model_validator(mode="before")
    @classmethod
    def _add_hash(cls, stated: Any) -> Any:
        if isinstance(stated, Mapping) and isinstance(stated.get("file"), str) and stated.get("sha256") is None:
            return {**stated, "sha256": cls.hash_of(stated["file"])}
        return stated

    @model_validator(mode="after")
    def _check_hash(self) -> OwnFile:
        if self.sha256 != self.hash_of(self.file):
            raise ValueError(f"{self.file}: has changed since the campaign was made from it")
        return self


def listed(file: Path, problems: Sequence[str]) -> str:
    """Format the problems of a file as one message, with a maximum number of them."""
    more = [f"... and {len(problems) - _MAX_PROBLEMS} more"] if len(problems) > _MAX_PROBLEMS else []
    return "\n  ".join([f"{file}:", *problems[:_MAX_PROBLEMS], *more])
