"""The campaigns of the systems. Listing them reads folders and nothing else."""

from __future__ import annotations

from pathlib import Path

from marsyard.scenarios.systems import systems


def catalogue() -> dict[str, Path]:
    """The campaign files of all systems, by their campaigns' names in order."""
    return dict(sorted((name, path) for system in systems() for name, path in system.campaigns.items()))
