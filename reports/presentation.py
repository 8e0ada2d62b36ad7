"""Presentation of a system: its report sections, and which cases are shown with their pictures.

`marsyard.scenarios.systems.System.report` names it; reports find systems in `marsyard.scenarios.systems`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure

from marsyard.reports.rates import members
from marsyard.reports.section import SectionMaker, SvgFigure
from marsyard.reports.stored import StoredRun
from marsyard.reports.wording import NOTHING, numbers, primary_metric
from marsyard.scenarios.systems import systems
from marsyard.scenarios.user_files import import_object

Products = Mapping[str, Any]


@dataclass(frozen=True)
class TableRow:
    """A row of a case's table, and whether its item succeeded."""

    values: Sequence[str]
    succeeded: bool


@dataclass(frozen=True)
class CaseView:
    """View of a case on the page: facts, figures and a table; `legend` replaces the legend of its kind."""

    facts: Sequence[tuple[str, str]]
    plates: Sequence[SvgFigure]
    head: Sequence[str]
    rows: Sequence[TableRow]
    legend: str | None = None


@dataclass(frozen=True)
class CaseKind:
    """Functions that draw cases of one kind from their products.

    view: view for the page; its text argument prefixes identifiers of figures
    write: write the figures into a folder and return the paths; raises OSError if they cannot be written
    """

    is_case: Callable[[Products], bool]
    view: Callable[[Products, str], CaseView]
    write: Callable[[Path, Products], list[Path]]
    legend: str


@dataclass(frozen=True)
class Presentation:
    """Report sections and case figures of a system.

    cases: kinds of case; the first that matches the products draws a case
    sections, first: sections after and before those of every campaign; makers return None for rows of other systems
    """

    cases: Sequence[CaseKind] = ()
    sections: Sequence[SectionMaker] = ()
    first: Sequence[SectionMaker] = ()


@cache
def presentations() -> tuple[Presentation, ...]:
    """The presentations of all systems in the order of the registry; an unusable one is left out with a warning."""
    selected: list[Presentation] = []
    for system in systems():
        if not system.report:
            continue
        stated = f"the report '{system.report}' of system '{system.name}'"
        try:
            presentation = import_object(system.report)
        except ImportError as error:
            _warn(f"{stated} cannot be imported: {error}")
            continue
        if isinstance(presentation, Presentation):
            selected.append(presentation)
        else:
            kind = type(presentation).__name__
            _warn(f"{stated} is a {kind}; allowed: a marsyard.reports.presentation.Presentation")
    return tuple(selected)


def _warn(reason: str) -> None:
    warnings.warn(f"{reason}; its sections and pictures are left out", stacklevel=3)


def case_kind(products: Products) -> CaseKind | None:
    """The kind of case of these products; None if no system recognizes them."""
    kinds = (kind for presentation in presentations() for kind in presentation.cases)
    return next((kind for kind in kinds if kind.is_case(products)), None)


def save_figures(directory: Path, figures: Mapping[str, Figure], dpi: int = 110) -> list[Path]:
    """Write figures as PNG on white; returns their paths."""
    paths = [directory / f"{name}.png" for name in figures]
    for path, figure in zip(paths, figures.values(), strict=True):
        figure.savefig(path, dpi=dpi, facecolor="#ffffff", metadata={"Software": None})
    return paths


def numeric_product(value: object) -> Float[np.ndarray, "..."] | None:
    """A product as float64; None if it is not numeric."""
    if value is None:
        return None
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None


def plane(value: object) -> Float[np.ndarray, "_ _"] | None:
    """A non-empty product of two dimensions; None otherwise."""
    values = numeric_product(value)
    return values if values is not None and values.ndim == 2 and values.size else None


def check_shape(value: object, *shape: int | None) -> Float[np.ndarray, "..."] | None:
    """A product of a shape, where None is any length; None otherwise."""
    values = numeric_product(value)
    if values is None or values.ndim != len(shape):
        return None
    fits = all(wanted in (None, length) for wanted, length in zip(shape, values.shape, strict=True))
    return values if fits else None


def read_arrays(
    products: Products, shapes: Mapping[str, tuple[int | None, ...]], *, finite: bool = False
) -> list[Float[np.ndarray, "..."]] | None:
    """Products by name and shape, optionally finite; None if one of them is something else."""
    arrays = [check_shape(products.get(name), *shape) for name, shape in shapes.items()]
    valid = [one for one in arrays if one is not None and (not finite or np.isfinite(one).all())]
    return valid if len(valid) == len(shapes) else None


#: Cases of each kind (largest errors, no answer, random); the pictures of one take about half a megabyte of a page.
CASES_OF_A_KIND = 2
#: Fixed seeds of the random choice: the same files give the same cases.
_GALLERY_SEED, _NOTABLE_SEED = 20260301, 20260302


@dataclass(frozen=True)
class ShownCase:
    """A kept case with its outcome, its view and its legend."""

    case: int
    outcome: str
    view: CaseView
    legend: str


def shown_cases(run: StoredRun) -> list[ShownCase]:
    """The kept cases of the page that a system can draw, as far as their products were kept."""
    return [shown for case in gallery_cases(run) if (shown := shown_case(run, case)) is not None]


def gallery_cases(run: StoredRun) -> list[int]:
    """Kept cases in the order of the page: the one chosen for the report, largest errors, no answer, random ones."""
    kept = list(run.showcases)
    metric = primary_metric(run.frame, run.requirements)
    if len(kept) <= 1 or metric is None or "case" not in run.whole:
        return kept[: 3 * CASES_OF_A_KIND]
    by_error, silent = _by_error(run.whole[run.whole["case"].isin(kept)], metric)
    unanswered = [case for case in kept if case in silent]
    return _pick(kept[:1], by_error, unanswered, np.random.default_rng(_GALLERY_SEED).permutation(kept).tolist())


def notable_cases(run: StoredRun) -> list[int]:
    """Completed cases: the largest errors, the first without one, and others at random."""
    rows = run.whole[members(run.whole, "completed")]
    metric = primary_metric(run.frame, run.requirements)
    if "case" not in rows or metric is None:
        return []
    by_error, silent = _by_error(rows, metric)
    cases = rows["case"].to_numpy(dtype=np.int64)
    return _pick([], by_error, silent, cases[np.random.default_rng(_NOTABLE_SEED).permutation(cases.size)].tolist())


def _by_error(rows: pd.DataFrame, metric: str) -> tuple[list[int], list[int]]:
    """Cases with an error, largest first, and cases without one."""
    cases, sizes = rows["case"].to_numpy(dtype=np.int64), np.abs(numbers(rows, metric))
    finite = np.isfinite(sizes)
    return cases[finite][np.argsort(-sizes[finite], kind="stable")].tolist(), cases[~finite].tolist()


def _pick(first: list[int], *kinds: list[int]) -> list[int]:
    """The first cases, then up to `CASES_OF_A_KIND` further ones of each kind."""
    chosen = list(first)
    for kind in kinds:
        chosen += [case for case in dict.fromkeys(kind) if case not in chosen][:CASES_OF_A_KIND]
    return chosen


def shown_case(run: StoredRun, case: int) -> ShownCase | None:
    """A kept case with its view; None if no system recognizes its products."""
    products = run.products(case)
    kind = case_kind(products)
    if kind is None:
        return None
    view = kind.view(products, f"case{case}")
    rows = run.whole
    outcomes = rows.loc[rows["case"] == case, "outcome"] if {"case", "outcome"} <= {*rows} else pd.Series(dtype=object)
    outcome = str(outcomes.iloc[0]) if len(outcomes) else NOTHING
    return ShownCase(case, outcome, view, kind.legend if view.legend is None else view.legend)


def write_case_figures(directory: Path, products: Mapping[str, Any]) -> list[Path]:
    """Write a case's figures into a folder; returns their paths, none if no system recognizes the products.

    Raises OSError if they cannot be written.
    """
    kind = case_kind(products)
    return [] if kind is None else kind.write(directory, products)
