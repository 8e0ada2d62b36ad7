"""What a dotted path names: ``module:name``, in an installed package or in a module of the current folder."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

#: Packages that were imported under their own names before they became parts of `marsyard`.
_FORMER = ("sim", "algorithms", "scenarios", "campaigns", "reports")


def current_module(module: str) -> str:
    """The name under which a module is imported, also where a stored campaign or an older file has its former name.

    ``algorithms.dimes`` is ``marsyard.algorithms.dimes``; names that Marsyard does not have stay as they are.
    """
    if module.partition(".")[0] not in _FORMER:
        return module
    try:
        known = importlib.util.find_spec(f"marsyard.{module}") is not None
    except ImportError:
        known = False
    return f"marsyard.{module}" if known else module


def found_at(path: str) -> Any:
    """What stands at ``module:name``.

    The current folder is searched last, so that a file in it never stands in for an installed package.

    Raises
    ------
    ImportError
        Where nothing does, or the module cannot be loaded; the message says why.
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


def sources_at(path: str) -> Iterator[tuple[str, Path]]:
    """The sources of the package, or the module, that ``module:name`` lies in: their names and files."""
    parts = current_module(path.partition(":")[0]).split(".")
    top = ".".join(parts[:2] if parts[0] == "marsyard" else parts[:1])
    found = importlib.util.find_spec(top)
    if found is None or found.origin is None:
        return
    origin = Path(found.origin)
    if found.submodule_search_locations:
        yield from relative_to(origin.parent.parent, sorted(origin.parent.rglob("*.py")))
    else:
        yield origin.name, origin


def relative_to(base: Path, paths: Iterable[Path]) -> Iterator[tuple[str, Path]]:
    """Files by their names below a folder."""
    for path in paths:
        yield path.relative_to(base).as_posix(), path
