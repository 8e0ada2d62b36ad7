"""What a dotted path names: ``module:name``, in an installed package or in a module of the current folder."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any


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
        return getattr(importlib.import_module(module), name)
    except ImportError:
        raise
    except Exception as error:  # a module may raise anything
        raise ImportError(f"{type(error).__name__}: {error}") from error


def sources_at(path: str) -> Iterator[tuple[str, Path]]:
    """The sources of the package, or the module, that ``module:name`` lies in: their names and files."""
    top = path.partition(":")[0].partition(".")[0]
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
