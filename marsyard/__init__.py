"""Marsyard, a virtual Mars Yard: tests vision software on rendered cases with known truth.

The names of `marsyard.api` are available here, and imported on first use.
"""

# ruff: noqa: F405  (the names are those of marsyard.api)
from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from marsyard.api import *  # noqa: F403

__all__ = ["CameraModel", "Campaign", "CaseResult", "catalogue", "draw", "draws", "load_campaign", "read_camera"]
__all__ += ["read_cameras", "render_view", "results", "run_campaign", "run_case", "score", "sites", "verdicts"]


def __getattr__(name: str) -> Any:
    """Import the API on first use: the command line starts without it."""
    if name not in __all__:
        raise AttributeError(f"module 'marsyard' has no attribute {name!r}; it has {', '.join(__all__)}")
    from marsyard import api

    return getattr(api, name)


def __dir__() -> list[str]:
    """Return the names of the module and of the API."""
    return sorted([*globals(), *__all__])
