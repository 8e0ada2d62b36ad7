"""Import objects by ``module:name``, and find the sources of their packages."""

import importlib
import importlib.util
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from marsyard.scenarios.stored_objects import SUFFIX, load_object


def search_current_folder() -> None:
    """Let Python find modules in the current folder, after those of installed packages."""
    current_folder = str(Path.cwd())
    if current_folder not in sys.path:
        sys.path.append(current_folder)


def import_object(path: str) -> Any:
    """Import the object at ``module:name``, or a stored object. Raises ImportError with the reason.

    The current folder is searched last: a file in it never shadows an installed package.
    """
    module, _, name = path.rpartition(":")
    search_current_folder()
    if module.endswith(SUFFIX):
        return load_object(module)
    try:
        return getattr(importlib.import_module(module), name)
    except ImportError:
        raise
    except Exception as error:  # a module may raise anything
        raise ImportError(f"{type(error).__name__}: {error}") from error


def source_files(path: str) -> Iterator[tuple[str, Path]]:
    """Yield names and files of the sources of the package or module that contains ``module:name``."""
    module = path.rpartition(":")[0]
    if module.endswith(SUFFIX):
        source = Path(module).with_suffix(".py")
        yield source.name, source if source.is_file() else Path(module)
        return
    parts = module.split(".")
    package = ".".join(parts[:2] if parts[0] == "marsyard" else parts[:1])
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        return
    origin = Path(spec.origin)
    if spec.submodule_search_locations:
        yield from relative_to(origin.parent.parent, sorted(origin.parent.rglob("*.py")))
    else:
        yield origin.name, origin


def source_root(path: str) -> tuple[Path, ...]:
    """Return the folders of the package, or the file, that contains ``module:name``; empty if it is not found.

    A namespace package has several folders.
    """
    module = path.rpartition(":")[0]
    if module.endswith(SUFFIX):
        return (Path(module),)
    search_current_folder()
    try:
        spec = importlib.util.find_spec(module.split(".")[0])
    except (ImportError, ValueError):
        return ()
    if spec is None:
        return ()
    if spec.submodule_search_locations:
        return tuple(map(Path, spec.submodule_search_locations))
    return (Path(spec.origin),) if spec.origin else ()


def relative_to(base: Path, paths: Iterable[Path]) -> Iterator[tuple[str, Path]]:
    """Yield files with their names relative to a folder."""
    for path in paths:
        yield path.relative_to(base).as_posix(), path
