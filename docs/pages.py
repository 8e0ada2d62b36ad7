"""Generated pages of the documentation: commands, parameters of scenarios, catalogue, folders of `marsyard ingest`."""

import inspect
import re
import subprocess
import sys
import tomllib
import types
import typing
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

from annotated_types import BaseMetadata
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from marsyard.scenarios.declared_columns import row_columns
from marsyard.scenarios.error_sources import error_sources
from marsyard.scenarios.measured.layout import COLUMNS, IngestFile
from marsyard.scenarios.systems import catalogue, scenario, scenario_names
from marsyard.sim.parameters import list_alternatives, list_models

#: Folder of the generated pages.
FOLDER = Path(__file__).parent / "reference" / "generated"


def write_pages() -> None:
    """Write all generated pages."""
    FOLDER.mkdir(exist_ok=True)
    (FOLDER / "cli.md").write_text(format_commands())
    (FOLDER / "catalogue.md").write_text(format_catalogue())
    (FOLDER / "real-images.md").write_text(format_ingest_keys())
    for name in scenario_names():
        (FOLDER / f"parameters-{name}.md").write_text(format_parameters(name))
        (FOLDER / f"columns-{name}.md").write_text(format_columns(name))


def format_commands() -> str:
    """Format every command with its arguments and options, by Typer."""
    command = [sys.executable, "-m", "typer", "marsyard.cli.app", "utils", "docs", "--name", "marsyard"]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout  # noqa: S603
    return "# Command line\n" + text.split("\n", 1)[1]


def format_catalogue() -> str:
    """Format a table of the campaigns of the catalogue."""
    rows = []
    for name, path in catalogue().items():
        campaign = tomllib.loads(path.read_text(encoding="utf-8"))
        rows.append(f"| `{name}` | `{campaign['scenario']}` | {campaign['cases']:,} | {campaign['description']} |")
    header = [
        "# Catalogue",
        "",
        "This page lists the campaigns that are included in Marsyard: the scenario that simulates the cases, the",
        "number of cases, and a description. `marsyard run NAME` runs a campaign. `marsyard show NAME` prints its",
        "dispersions with their sources, and its requirements. The [glossary](../../glossary.md) defines the terms.",
        "",
    ]
    return "\n".join([*header, "| campaign | scenario | cases | description |", "|---|---|---|---|", *rows, ""])


def format_parameters(name: str) -> str:
    """Format a table of every key that a campaign of a scenario can set or disperse."""
    description = (scenario(name).__doc__ or "").strip().splitlines()[0]
    sources = {path: f" (*{source.name}*)" for source in error_sources(name) for path in source.parameters}
    header = [
        f"# Parameters of `{name}`",
        "",
        description,
        "",
        "This table lists every parameter that a campaign of this scenario can set or disperse. Keys are below",
        "`[parameters]` in the campaign file, or in `--set KEY=VALUE` on the command line. Units are in the names of",
        "the keys (`_m`, `_deg`, `_s`, `_px`) or in the description; SD is the standard deviation. A",
        "[source of error](../../error-budget.md#sources-of-error) follows the description of its parameters.",
        "",
    ]
    rows = [
        f"| `{key}` | {_format_type(field)} | {_format_default(field)} "
        f"| {field.description or ''}{sources.get(key, '')} |"
        for key, field in _walk_fields(scenario(name).parameters_type)
    ]
    return "\n".join([*header, "| key | type, allowed | default | description |", "|---|---|---|---|", *rows, ""])


def format_columns(name: str) -> str:
    """Format a table of the columns of a scenario's rows."""
    header = [
        f"# Columns of `{name}`",
        "",
        "This table lists the columns that the scenario writes in each row. The engine adds the columns `case`,",
        "`outcome`, `answered`, times and errors, and the sampled values of dispersed parameters, whose names are the",
        "paths of the parameters. A star stands for any text, such as the number of an image. The columns of a",
        "compared algorithm begin with its label and a dot.",
        "",
    ]
    rows = [
        f"| `{column.name}` | {column.kind} | {_COLUMN_TYPES.get(column.type, column.unit)} | {column.meaning} |"
        for column in row_columns(name) or ()
    ]
    return "\n".join([*header, "| column | kind | type or unit | meaning |", "|---|---|---|---|", *rows, ""])


_COLUMN_TYPES = {bool: "true or false", str: "text"}


def format_ingest_keys() -> str:
    """Format tables of every key and column of a folder that `marsyard ingest` reads."""
    keys = [
        f"| `{key}` | {_format_type(field)} | {_format_default(field)} | {field.description or ''} |"
        for key, field in _walk_fields(IngestFile)
    ]
    columns = [
        f"| `{column.name}` | {', '.join(column.tasks)} | {column.required or 'no'} | {column.description} |"
        for column in COLUMNS
    ]
    return "\n".join(
        [
            "# Keys and columns of real images",
            "",
            "This page lists the keys and columns that `marsyard ingest` reads in a folder of recorded images. [Real",
            "images](../../real-images.md) describes the folder and gives an example.",
            "",
            "## `ingest.toml`",
            "",
            "| key | type, allowed | default | description |",
            "|---|---|---|---|",
            *keys,
            "",
            "## `images.csv`",
            "",
            "| column | tasks | required | description |",
            "|---|---|---|---|",
            *columns,
            "",
        ]
    )


def _walk_fields(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Yield keys and fields of a model and of its nested models, in order."""
    for name, field in model.model_fields.items():
        nested_models = list_models(field.annotation)
        options = [item for item in list_alternatives(field.annotation) if is_dataclass(item)]
        if options:
            yield from _walk_options(options[0], field.default, f"{prefix}{name}.")
        elif not nested_models:
            yield prefix + name, field
        # alternative models can have the same key: yield the first
        keys: set[str] = set()
        for nested_model in nested_models:
            fields = {key: entry for key, entry in _walk_fields(nested_model, f"{prefix}{name}.") if key not in keys}
            keys.update(fields)
            yield from fields.items()


def _walk_options(options: Any, values: Any, prefix: str) -> Iterator[tuple[str, FieldInfo]]:
    """Yield keys and fields of an algorithm's options; the docstring describes them as ``- name, name: text``."""
    entries = re.findall(r"^- ([a-z_, \d]+): (.*(?:\n  .*)*)", inspect.getdoc(options) or "", re.MULTILINE)
    descriptions = {name: " ".join(text.split()) for names, text in entries for name in names.split(", ")}
    types_of = typing.get_type_hints(options, include_extras=True)
    for field in fields(options):
        default = getattr(values, field.name, field.default)
        if is_dataclass(types_of[field.name]):
            yield from _walk_options(types_of[field.name], default, f"{prefix}{field.name}.")
        else:
            description = descriptions.get(field.name, "").replace("|", "\\|")
            described = FieldInfo(annotation=types_of[field.name], default=default, description=description)
            yield prefix + field.name, described


def _is_union(annotation: Any) -> bool:
    """Whether a type is a union of alternatives."""
    return get_origin(annotation) in (typing.Union, types.UnionType)


def _format_type(field: FieldInfo) -> str:
    """Format the type and the limits of a field."""
    limits = [_format_limits(entry) for entry in field.metadata if isinstance(entry, BaseMetadata)]
    return ", ".join([_type_name(field.annotation), *filter(None, limits)])


def _format_limits(metadata: BaseMetadata) -> str:
    """Format the limits of a number, such as ``> 0``."""
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    limits = [f"{sign} {getattr(metadata, name):g}" for name, sign in signs.items() if hasattr(metadata, name)]
    return " ".join(limits)


def _type_name(annotation: Any) -> str:
    """Name a type in a few words."""
    if get_origin(annotation) is Annotated:
        return _type_name(get_args(annotation)[0])
    if get_origin(annotation) is typing.Literal:
        return " or ".join(f"`{value}`" for value in get_args(annotation))
    if _is_union(annotation):
        return " or ".join("none" if part is type(None) else _type_name(part) for part in get_args(annotation))
    if get_origin(annotation) in (tuple, list):
        elements = sorted({_type_name(part) for part in get_args(annotation) if part is not Ellipsis})
        return f"list of {', '.join(elements)}"
    if get_origin(annotation) is dict:
        return "table"
    if inspect.isclass(annotation) and issubclass(annotation, Enum):
        return " or ".join(f"`{member.value}`" for member in annotation)
    names = {float: "number", int: "integer", str: "text", bool: "true or false", Path: "path"}
    return names.get(annotation, f"`{getattr(annotation, '__name__', annotation)}`")


def _format_default(field: FieldInfo) -> str:
    """Format the default of a field; empty if the field is required or the text is long."""
    if field.default is PydanticUndefined:
        return "" if field.default_factory is None else "computed"
    value = field.default.value if isinstance(field.default, Enum) else field.default
    text = "none" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    return f"`{text}`" if text and len(text) <= 60 else ""
