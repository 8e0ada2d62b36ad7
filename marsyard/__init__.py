"""Marsyard, a virtual Mars Yard: test vision software on rendered cases with ground truth.

This package exports the names of `marsyard.api` and imports that module on first use.
"""

# ruff: noqa: F405  (defined by the star import)
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from marsyard.api import *  # noqa: F403

__all__ = ["CameraModel", "Campaign", "CaseResult", "catalogue", "collect_metric", "create_campaign", "draw", "draws"]
__all__ += ["load_campaign", "open_result", "read_camera", "read_cameras", "render_view", "results", "run"]
__all__ += ["run_campaign", "run_case", "sites", "verdicts"]


def __getattr__(name: str) -> Any:
    """Import the API on first use, so that the command line starts fast."""
    if name not in __all__:
        raise AttributeError(f"module 'marsyard' has no attribute {name!r}; it has {', '.join(__all__)}")
    from marsyard import api

    return getattr(api, name)


def __dir__() -> list[str]:
    """Return the names of the module and of the API."""
    return sorted([*globals(), *__all__])
