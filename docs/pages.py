"""Pages of the site that are written from the program itself: commands, parameters, catalogue, ingested folders."""

from __future__ import annotations

import subprocess
import sys
import tomllib
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

from annotated_types import BaseMetadata
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from marsyard.campaigns.definition.loading import catalogue
from marsyard.scenarios.measured.layout import COLUMNS, IngestFile
from marsyard.scenarios.systems import scenario, scenario_names

#: Where they are written, and what each begins with.
FOLDER = Path(__file__).parent / "reference" / "generated"


def write_pages() -> None:
    """Writes them all."""
    FOLDER.mkdir(exist_ok=True)
    (FOLDER / "cli.md").write_text(command_line_page())
    (FOLDER / "catalogue.md").write_text(catalogue_page())
    (FOLDER / "real-pictures.md").write_text(real_pictures_page())
    for name in scenario_names():
        (FOLDER / f"parameters-{name}.md").write_text(parameters_page(name))


def command_line_page() -> str:
    """Every command with its arguments and options, by Typer itself."""
    command = [sys.executable, "-m", "typer", "marsyard.cli.app", "utils", "docs", "--name", "marsyard"]
    written = subprocess.run(command, check=True, capture_output=True, text=True).stdout  # noqa: S603
    return "# Command line\n" + written.split("\n", 1)[1]


def catalogue_page() -> str:
    """The campaigns that ship with Marsyard."""
    rows = []
    for name, path in catalogue().items():
        stated = tomllib.loads(path.read_text(encoding="utf-8"))
        rows.append(f"| `{name}` | `{stated['scenario']}` | {stated['cases']:,} | {stated['description']} |")
    head = ["# Catalogue", "", "`marsyard show NAME` prints a campaign: dispersions, their sources, what it asks.", ""]
    return "\n".join([*head, "| campaign | scenario | cases | what |", "|---|---|---|---|", *rows, ""])


def parameters_page(name: str) -> str:
    """Every key that a campaign of a scenario may set or disperse."""
    described = (scenario(name).__doc__ or "").strip().splitlines()[0]
    head = [
        f"# Parameters of `{name}`",
        "",
        described,
        "",
        "Keys are below `[parameters]`, as in `--set KEY=VALUE`.",
        "",
    ]
    rows = [
        f"| `{key}` | {_kind(field)} | {_default(field)} | {field.description or ''} |"
        for key, field in _fields(scenario(name).parameters_type)
    ]
    return "\n".join([*head, "| key | kind, allowed | default | what |", "|---|---|---|---|", *rows, ""])


def real_pictures_page() -> str:
    """Every key and column of a folder that `marsyard ingest` reads."""
    keys = [
        f"| `{key}` | {_kind(field)} | {_default(field)} | {field.description or ''} |"
        for key, field in _fields(IngestFile)
    ]
    columns = [
        f"| `{one.name}` | {', '.join(one.tasks)} | {one.required or 'no'} | {one.description} |" for one in COLUMNS
    ]
    return "\n".join(
        [
            "# Keys and columns of real pictures",
            "",
            "What `marsyard ingest` reads in a folder; see [real pictures](../../real-pictures.md).",
            "",
            "## `ingest.toml`",
            "",
            "| key | kind, allowed | default | what |",
            "|---|---|---|---|",
            *keys,
            "",
            "## `pictures.csv`",
            "",
            "| column | tasks | needed | what |",
            "|---|---|---|---|",
            *columns,
            "",
        ]
    )


def _fields(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Keys and fields of a model and of the models in it, in order."""
    for name, field in model.model_fields.items():
        inner = _models_of(field.annotation)
        if not inner:
            yield prefix + name, field
        told: set[str] = set()
        for one in inner:
            found = {key: below for key, below in _fields(one, f"{prefix}{name}.") if key not in told}
            told.update(found)
            yield from found.items()


def _models_of(annotation: Any) -> list[type[BaseModel]]:
    """The models that a field holds, where it holds one or one of several."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if get_origin(annotation) is Annotated:
        return _models_of(get_args(annotation)[0])
    return [model for one in get_args(annotation) for model in _models_of(one)] if _is_union(annotation) else []


def _is_union(annotation: Any) -> bool:
    return get_origin(annotation) in (typing.Union, types.UnionType)


def _kind(field: FieldInfo) -> str:
    """Type and bounds of a field, as a user reads them."""
    bounds = [_bound(one) for one in field.metadata if isinstance(one, BaseMetadata)]
    return ", ".join([_type_name(field.annotation), *filter(None, bounds)])


def _bound(one: BaseMetadata) -> str:
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    found = [f"{sign} {getattr(one, name):g}" for name, sign in signs.items() if hasattr(one, name)]
    return " ".join(found)


def _type_name(annotation: Any) -> str:
    """A type in a word or two."""
    if get_origin(annotation) is Annotated:
        return _type_name(get_args(annotation)[0])
    if get_origin(annotation) is typing.Literal:
        return " or ".join(f"`{value}`" for value in get_args(annotation))
    if _is_union(annotation):
        return " or ".join("none" if one is type(None) else _type_name(one) for one in get_args(annotation))
    if get_origin(annotation) in (tuple, list):
        inner = sorted({_type_name(one) for one in get_args(annotation) if one is not Ellipsis})
        return f"list of {', '.join(inner)}"
    if get_origin(annotation) is dict:
        return "table"
    names = {float: "number", int: "whole number", str: "text", bool: "true or false"}
    return names.get(annotation, f"`{getattr(annotation, '__name__', annotation)}`")


def _default(field: FieldInfo) -> str:
    if field.default is PydanticUndefined:
        return "" if field.default_factory is None else "made"
    text = "none" if field.default is None else str(field.default)
    return f"`{text}`" if text and len(text) <= 60 else ""
