"""The campaigns that ship with Marsyard. Listing them reads their files and nothing else."""

from __future__ import annotations

from pathlib import Path

CATALOGUE = Path(__file__).resolve().parents[2] / "scenarios" / "catalogue"


def catalogue() -> dict[str, Path]:
    """The campaigns that ship with Marsyard, by name."""
    return {path.stem: path for path in sorted(CATALOGUE.glob("*.toml"))}
