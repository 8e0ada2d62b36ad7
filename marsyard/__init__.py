"""Marsyard, a virtual Mars Yard: runs vision software through rendered, truth-known cases and says whether it holds.

What a notebook needs is here by name, and imported when it is first asked for (`marsyard.api` documents it).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from marsyard.api import (
        CameraModel,
        Campaign,
        CaseResult,
        catalogue,
        draw,
        draws,
        load_campaign,
        read_camera,
        read_cameras,
        render_view,
        results,
        run_campaign,
        run_case,
        score,
        sites,
        verdicts,
    )

__all__ = [
    "CameraModel",
    "Campaign",
    "CaseResult",
    "catalogue",
    "draw",
    "draws",
    "load_campaign",
    "read_camera",
    "read_cameras",
    "render_view",
    "results",
    "run_campaign",
    "run_case",
    "score",
    "sites",
    "verdicts",
]


def __getattr__(name: str) -> Any:
    """Loads the API with the first of its names, so that the command line starts at once."""
    if name not in __all__:
        raise AttributeError(f"module 'marsyard' has no attribute {name!r}; it has {', '.join(__all__)}")
    from marsyard import api

    return getattr(api, name)


def __dir__() -> list[str]:
    """The API's names."""
    return sorted([*globals(), *__all__])
