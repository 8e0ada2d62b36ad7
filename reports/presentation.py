"""Presentation of a system (DIMES, for example): its report sections, and the views of its cases on the page.

Products are the arrays and texts that a case stores for its figures. The gallery consists of the cases that the page
shows: some of the cases with stored products. Notable cases are those that `marsyard report --gallery` reruns, in order
to store their products.

Each system of `marsyard.scenarios.systems` defines the import path of its presentation in `System.report`.
"""

from __future__ import annotations

import base64
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure

from marsyard.reports.rates import population_mask
from marsyard.reports.section import SectionMaker, SvgFigure, svg_figure
from marsyard.reports.stored import StoredRun
from marsyard.reports.timeline.figure import draw_timeline
from marsyard.reports.wording import NOTHING, numbers, primary_metric
from marsyard.scenarios.imports import import_object
from marsyard.scenarios.systems import find_system, systems
from marsyard.scenarios.timeline import Timeline

Products = Mapping[str, Any]


@dataclass(frozen=True)
class TableRow:
    """A row of a case's table, and whether its item (a track or a stage, for example) succeeded."""

    values: Sequence[str]
    succeeded: bool


@dataclass(frozen=True)
class CaseFigure:
    """A figure of a case: its name (that of its file without the ending), and its caption on the page.

    wide: whether the figure has the full width of the page
    """

    name: str
    figure: Figure
    caption: str = ""
    wide: bool = True


@dataclass(frozen=True)
class CaseView:
    """View of a case: its figures, and on the page further texts.

    - facts: names and values
    - head, rows: headings and rows of the case's table
    - legend: text that explains the figures; None for the legend of the `CaseKind`
    """

    figures: Sequence[CaseFigure]
    facts: Sequence[tuple[str, str]] = ()
    head: Sequence[str] = ()
    rows: Sequence[TableRow] = ()
    legend: str | None = None


@dataclass(frozen=True)
class CaseKind:
    """Functions that draw the cases of one kind (landings, for example) from their products.

    - is_case: return whether the products are those of this kind of case
    - view: create the view; the second argument is true for files, which contain all figures, and false for the page
    - legend: text that explains the figures of a view
    """

    is_case: Callable[[Products], bool]
    view: Callable[[Products, bool], CaseView]
    legend: str = ""


@dataclass(frozen=True)
class Cause:
    """Cause of a violation: a short name, by which violations are grouped, and a text with the case's numbers."""

    name: str
    detail: str


@dataclass(frozen=True)
class Presentation:
    """Report sections and case figures of a system.

    - cases: kinds of case; the first kind that matches the products is used
    - sections: functions that create sections after the sections common to all campaigns
    - first: functions that create sections before the common sections
    - outcomes: enumerations of outcomes; each value describes its outcome
    - explain: return the cause of a row's violation of a requirement with this metric; None if it is unknown
    """

    cases: Sequence[CaseKind] = ()
    sections: Sequence[SectionMaker] = ()
    first: Sequence[SectionMaker] = ()
    outcomes: Sequence[type[Enum]] = ()
    explain: Callable[[Mapping[str, Any], str], Cause | None] | None = None


@cache
def presentations() -> tuple[Presentation, ...]:
    """Import the presentations of all systems, those of recorded data first; omit an invalid one with a warning."""
    valid_presentations: list[Presentation] = []
    # cases of recorded data also contain products of other systems, which must not claim them
    for system in sorted(systems(), key=lambda system: not system.ingest):
        if not system.report:
            continue
        description = f"the report '{system.report}' of system '{system.name}'"
        try:
            presentation = import_object(system.report)
        except ImportError as error:
            _warn(f"{description} cannot be imported: {error}")
            continue
        if isinstance(presentation, Presentation):
            valid_presentations.append(presentation)
        else:
            type_name = type(presentation).__name__
            _warn(f"{description} is a {type_name}; allowed: a marsyard.reports.presentation.Presentation")
    return tuple(valid_presentations)


def system_presentation(scenario: str) -> Presentation | None:
    """Return the presentation of the system with this scenario; None without one."""
    system = find_system(scenario)
    if system is None or not system.report:
        return None
    try:
        presentation = import_object(system.report)
    except ImportError:
        return None
    return presentation if isinstance(presentation, Presentation) else None


def _warn(reason: str) -> None:
    warnings.warn(f"{reason}; its sections and images are omitted", stacklevel=3)


def find_case_kind(products: Products) -> CaseKind | None:
    """Find the kind of case of these products; None if no system recognizes them."""
    kinds = (kind for presentation in presentations() for kind in presentation.cases)
    return next((kind for kind in kinds if kind.is_case(products)), None)


#: Size of thumbnails, pixels, and their JPEG quality.
_THUMBNAIL_PX, _THUMBNAIL_QUALITY = 96, 70
#: Minimum size of an image, pixels. An image that is wider by a larger ratio than this has summed rows.
_MIN_IMAGE_PX, _MAX_ASPECT = 48, 2.0


def thumbnail(products: Products) -> str:
    """Return a square preview of a case's last image as a data URI; empty if the products contain no image.

    An image is a product at the top level with integer values and two dimensions.
    """
    images = [value for value in products.values() if isinstance(value, np.ndarray) and _is_image(value)]
    if not images:
        return ""
    image = images[-1].astype(np.float32)
    rows, columns = image.shape
    if columns < _MAX_ASPECT * rows and rows < _MAX_ASPECT * columns:
        size = min(rows, columns)
        top, left = (rows - size) // 2, (columns - size) // 2
        image = image[top : top + size, left : left + size]
    low, high = np.percentile(image, (1.0, 99.0))
    small = cv2.resize(image, (_THUMBNAIL_PX, _THUMBNAIL_PX), interpolation=cv2.INTER_AREA)
    grey = np.clip((small - low) * (255.0 / max(high - low, 1.0)), 0.0, 255.0).astype(np.uint8)
    _, jpeg = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, _THUMBNAIL_QUALITY])
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg.tobytes()).decode()}"


def _is_image(value: np.ndarray) -> bool:
    return value.ndim == 2 and np.issubdtype(value.dtype, np.integer) and min(value.shape) >= _MIN_IMAGE_PX


def numeric_product(value: object) -> Float[np.ndarray, "..."] | None:
    """Convert a product to float64; None if it is not numeric."""
    if value is None:
        return None
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None


def to_float(value: object) -> float:
    """Convert a number to float; NaN for other values."""
    return float(value) if isinstance(value, int | float | np.number) and not isinstance(value, bool) else np.nan


def is_true(value: object) -> bool:
    """Whether a value of a row is true; missing values are not."""
    return isinstance(value, bool | np.bool_) and bool(value)


def to_matrix(value: object) -> Float[np.ndarray, "_ _"] | None:
    """Convert a product to a non-empty array of two dimensions; None if it is not one."""
    values = numeric_product(value)
    return values if values is not None and values.ndim == 2 and values.size else None


#: Shape of a product: lengths, names of lengths that are equal in products read together, and None for any length.
Shape = tuple[int | str | None, ...]


def check_shape(value: object, *shape: int | None) -> Float[np.ndarray, "..."] | None:
    """Convert a product to an array of a shape, where None is any length; None if it has another shape."""
    arrays = read_arrays({"value": value}, {"value": shape})
    return None if arrays is None else arrays[0]


def read_arrays(
    products: Products, shapes: Mapping[str, Shape], *, finite: bool = False
) -> list[Float[np.ndarray, "..."]] | None:
    """Read products by name and shape; None if a product is missing, invalid, or not finite if `finite` is set."""
    arrays, lengths = [], dict[str, int]()
    for name, shape in shapes.items():
        values = numeric_product(products.get(name))
        if values is None or values.ndim != len(shape) or (finite and not np.isfinite(values).all()):
            return None
        for required, length in zip(shape, values.shape, strict=True):
            expected = lengths.setdefault(required, length) if isinstance(required, str) else required
            if expected not in (None, length):
                return None
        arrays.append(values)
    return arrays


#: Number of selected cases of each group (largest errors, no answer, random); a case has half a megabyte of images.
CASES_PER_GROUP = 2
#: Maximum number of violations that the gallery shows.
MAX_SHOWN_VIOLATIONS = 6
#: Fixed seeds of the random selection, for reproducible reports.
_GALLERY_SEED, _NOTABLE_SEED = 20260301, 20260302


@dataclass(frozen=True)
class ShowcaseView:
    """A stored case with its outcome, its view, and the figures of the view for the page."""

    case: int
    outcome: str
    view: CaseView
    figures: Sequence[SvgFigure]


#: Resolution of figures in files.
_FILE_DPI = 130
#: Caption of the perspective view of a case with a timeline.
_SPACE_CAPTION = (
    "The case in space: visible ground, true and estimated path, and the cameras at the times of images. "
    "`marsyard replay` with `--rerun` exports a view with a time line."
)


def showcase_views(run: StoredRun, violations: Sequence[int] = ()) -> list[ShowcaseView]:
    """Create the views of the gallery's cases; cases that no system can draw are omitted."""
    return [view for case in gallery_cases(run, violations) if (view := showcase_view(run, case)) is not None]


def gallery_cases(run: StoredRun, violations: Sequence[int] = ()) -> list[int]:
    """List the cases of the gallery: violations, the case selected for the report, and cases of three groups.

    The groups are the largest errors, no answer, and random cases. All listed cases have stored products. Without a
    metric, the first cases with products are listed. `violations` are those that the page lists by requirement.
    """
    shown_violations = [case for case in violations if case in run.showcases][:MAX_SHOWN_VIOLATIONS]
    stored_cases = list(run.showcases)
    metric = primary_metric(run.frame, run.requirements)
    if len(stored_cases) <= 1 or metric is None or "case" not in run.all_cases:
        return list(dict.fromkeys([*shown_violations, *stored_cases[: 3 * CASES_PER_GROUP]]))
    if len(shown_violations) == MAX_SHOWN_VIOLATIONS:
        return list(dict.fromkeys([*shown_violations, *stored_cases[:1]]))
    by_error, without_error = _sort_by_error(run.all_cases[run.all_cases["case"].isin(stored_cases)], metric)
    unanswered = [case for case in stored_cases if case in without_error]
    random_order = np.random.default_rng(_GALLERY_SEED).permutation(stored_cases)
    first = list(dict.fromkeys([*shown_violations, *stored_cases[:1]]))
    return _select_cases(first, by_error, unanswered, random_order.tolist())


def notable_cases(run: StoredRun) -> list[int]:
    """List completed cases to rerun for the gallery: largest errors, first cases without an error, and random cases."""
    rows = run.all_cases[population_mask(run.all_cases, "completed")]
    metric = primary_metric(run.frame, run.requirements)
    if "case" not in rows or metric is None:
        return []
    by_error, without_error = _sort_by_error(rows, metric)
    cases = rows["case"].to_numpy(dtype=np.int64)
    random_order = np.random.default_rng(_NOTABLE_SEED).permutation(cases.size)
    return _select_cases([], by_error, without_error, cases[random_order].tolist())


def _sort_by_error(rows: pd.DataFrame, metric: str) -> tuple[list[int], list[int]]:
    """List cases with an error, largest first, and cases without an error."""
    cases, magnitudes = rows["case"].to_numpy(dtype=np.int64), np.abs(numbers(rows, metric))
    finite = np.isfinite(magnitudes)
    return cases[finite][np.argsort(-magnitudes[finite], kind="stable")].tolist(), cases[~finite].tolist()


def _select_cases(first: list[int], *groups: list[int]) -> list[int]:
    """List the cases `first`, then up to `CASES_PER_GROUP` further cases of each group."""
    cases = list(first)
    for group in groups:
        cases += [case for case in dict.fromkeys(group) if case not in cases][:CASES_PER_GROUP]
    return cases


def create_case_view(products: Products, *, complete: bool) -> CaseView:
    """Create the view of a case, without figures if no system recognizes its products.

    complete: whether the view is for files, which contain all figures
    """
    kind, timeline = find_case_kind(products), Timeline.from_products(products)
    view = CaseView([]) if kind is None else kind.view(products, complete)
    space = [] if timeline is None else [CaseFigure("space", draw_timeline(timeline), _SPACE_CAPTION, wide=False)]
    legend = kind.legend if kind is not None and view.legend is None else view.legend
    return replace(view, figures=[*view.figures, *space], legend=legend)


def showcase_view(run: StoredRun, case: int) -> ShowcaseView | None:
    """Create the view of a stored case; None if it has no figure."""
    view = create_case_view(run.products(case), complete=False)
    if not view.figures:
        return None
    figures = [svg_figure(item.figure, f"case{case}{item.name}", item.caption, wide=item.wide) for item in view.figures]
    rows = run.all_cases
    outcomes = rows.loc[rows["case"] == case, "outcome"] if {"case", "outcome"} <= {*rows} else pd.Series(dtype=object)
    return ShowcaseView(case, str(outcomes.iloc[0]) if len(outcomes) else NOTHING, view, figures)


def write_case_figures(directory: Path, products: Products) -> list[Path]:
    """Write a case's figures as PNG on white into a folder; returns their paths.

    Raises OSError if they cannot be written.
    """
    view = create_case_view(products, complete=True)
    figures = {directory / f"{item.name}.png": item.figure for item in view.figures}
    for path, figure in figures.items():
        figure.savefig(path, dpi=_FILE_DPI, facecolor="#ffffff", metadata={"Software": None})
    return [*figures]
