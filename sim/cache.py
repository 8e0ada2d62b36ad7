"""Where things built once are kept on disk."""

from __future__ import annotations

import os
from pathlib import Path


def cache_directory(kind: str) -> Path:
    """The folder for cached things of this kind: under ``MARSYARD_CACHE``, else the user's cache folder. Created."""
    configured = os.environ.get("MARSYARD_CACHE")
    root = (
        Path(configured) if configured else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "marsyard"
    )
    directory = root / kind
    directory.mkdir(parents=True, exist_ok=True)
    return directory
