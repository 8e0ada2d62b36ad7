"""A user's own files: a campaign knows one again by the hash of its contents; what is wrong with one is listed."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Protocol, runtime_checkable

from pydantic import BaseModel, Field, model_validator

from marsyard.sim.parameters import Parameters

#: Problems of a file that are told at once.
_TOLD = 20


@runtime_checkable
class NamesFiles(Protocol):
    """Parameters that name files; a user's own options may have the method, too."""

    def input_files(self) -> Sequence[str]:
        """Paths of the files, as stated."""
        ...


def input_files(parameters: Any) -> tuple[str, ...]:
    """The files that a scenario's parameters name, anywhere in their tree; each once."""
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
    """A file that a campaign is made from. The hash is filled in when the campaign is read; each case checks it."""

    file: Annotated[str, Field(description="path of the file")]
    sha256: Annotated[str | None, Field(description="of the file; filled in")] = None

    def input_files(self) -> tuple[str, ...]:
        """The file."""
        return (self.file,)

    @classmethod
    @abstractmethod
    def hash_of(cls, file: str) -> str:
        """SHA-256 of a file's contents. Raises ValueError, naming it, where it cannot be used."""

    @model_validator(mode="before")
    @classmethod
    def _with_its_hash(cls, stated: Any) -> Any:
        if isinstance(stated, Mapping) and isinstance(stated.get("file"), str) and stated.get("sha256") is None:
            return {**stated, "sha256": cls.hash_of(stated["file"])}
        return stated

    @model_validator(mode="after")
    def _is_as_it_was(self) -> OwnFile:
        if self.sha256 != self.hash_of(self.file):
            raise ValueError(f"{self.file}: has changed since the campaign was made from it")
        return self


def listed(file: Path, problems: Sequence[str]) -> str:
    """What is wrong with a file as one message, the first problems of very many."""
    more = [f"... and {len(problems) - _TOLD} more"] if len(problems) > _TOLD else []
    return "\n  ".join([f"{file}:", *problems[:_TOLD], *more])
