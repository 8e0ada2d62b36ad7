"""How a system's results are presented: its report sections, and the pictures of its cases.

A system names its `Presentation` in `marsyard.scenarios.system.System.report`; reports know systems by the registry
alone (`marsyard.scenarios.systems`).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from marsyard.reports.section import Plate, SectionMaker
from marsyard.scenarios.dotted import found_at
from marsyard.scenarios.system import System
from marsyard.scenarios.systems import systems

Products = Mapping[str, Any]


@dataclass(frozen=True)
class TableRow:
    """A row of a case's table: its values as texts, and whether the case that it describes succeeded."""

    values: Sequence[str]
    succeeded: bool


@dataclass(frozen=True)
class CaseView:
    """A case as its page shows it: facts by name, figures, and a table; `legend` in place of its kind's."""

    facts: Sequence[tuple[str, str]]
    plates: Sequence[Plate]
    head: Sequence[str]
    rows: Sequence[TableRow]
    legend: str | None = None


@dataclass(frozen=True)
class CaseKind:
    """How cases of one kind are drawn, from their products alone.

    Attributes
    ----------
    is_case
        Whether products are those of such a case.
    view
        What the page shows of it; the text names it in figures' identifiers.
    write
        Writes its figures into a folder and returns their paths; raises OSError where they cannot be written.
    legend
        What a reader of the page's figures must know.
    """

    is_case: Callable[[Products], bool]
    view: Callable[[Products, str], CaseView]
    write: Callable[[Path, Products], list[Path]]
    legend: str


@dataclass(frozen=True)
class Presentation:
    """What reports show of a system beyond what they show of every campaign.

    Attributes
    ----------
    cases
        Kinds of case; the first whose products they are draws a case.
    sections
        Sections after those that every campaign has, in the order of the page. A section is left out where its
        function returns None, so that each applies to its own rows alone.
    first
        Sections before those that every campaign has.
    """

    cases: Sequence[CaseKind] = ()
    sections: Sequence[SectionMaker] = ()
    first: Sequence[SectionMaker] = ()


@cache
def presentations() -> tuple[Presentation, ...]:
    """The presentations of all systems that have one, in the order of the registry.

    One that cannot be used is left out with a warning: no system keeps the others from their reports.
    """
    found = []
    for system in systems():
        try:
            found += [_presentation(system)] if system.report else []
        except ValueError as error:
            warnings.warn(f"{error}; its sections and pictures are left out", stacklevel=2)
    return tuple(found)


def _presentation(system: System) -> Presentation:
    """The presentation of a system that names one. Raises ValueError where it cannot be used."""
    stated = f"the report '{system.report}' of system '{system.name}'"
    try:
        presentation = found_at(system.report)
    except ImportError as error:
        raise ValueError(f"{stated} cannot be imported: {error}") from error
    if not isinstance(presentation, Presentation):
        kind = type(presentation).__name__
        raise ValueError(f"{stated} is a {kind}; allowed: a marsyard.reports.presentation.Presentation")
    return presentation


def case_kind(products: Products) -> CaseKind | None:
    """The kind of case whose products these are; None where no system knows them."""
    kinds = (kind for presentation in presentations() for kind in presentation.cases)
    return next((kind for kind in kinds if kind.is_case(products)), None)


def save_figures(directory: Path, figures: Mapping[str, Figure], dpi: int = 110) -> list[Path]:
    """Write figures as PNG on white, by their names; returns their paths."""
    paths = [directory / f"{name}.png" for name in figures]
    for path, figure in zip(paths, figures.values(), strict=True):
        figure.savefig(path, dpi=dpi, facecolor="#ffffff", metadata={"Software": None})
    return paths


def numbers(value: object) -> Float[np.ndarray, "..."] | None:
    """A product as float64; None where it is something else. Products come from files."""
    if value is None:
        return None
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None


def plane(value: object) -> Float[np.ndarray, "_ _"] | None:
    """A product of two dimensions with something in it; None where it is something else."""
    values = numbers(value)
    return values if values is not None and values.ndim == 2 and values.size else None


def shaped(value: object, *shape: int | None) -> Float[np.ndarray, "..."] | None:
    """A product of this shape, where None stands for any length; None where it is something else."""
    values = numbers(value)
    if values is None or values.ndim != len(shape):
        return None
    fits = all(wanted in (None, length) for wanted, length in zip(shape, values.shape, strict=True))
    return values if fits else None
