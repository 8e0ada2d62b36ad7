"""What a dotted path names: ``module:name``, in an installed package or in a module of the current folder."""

from __future__ import annotations

import importlib
import sys
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
