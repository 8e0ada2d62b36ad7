"""Presentation of images over a map: recorded next to rendered images, and the matched landmarks of a case."""

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure

from marsyard.reports import figure_style, section
from marsyard.reports.column_values import numbers
from marsyard.reports.images import Mark, Panel, draw_panels
from marsyard.reports.presentation import CaseFigure, CaseKind, CaseView
from marsyard.reports.products import Products, array_of_shape, to_matrix
from marsyard.reports.wording import label, note_text, number
from marsyard.scenarios.measured.map_matching import MATCHERS
from marsyard.scenarios.measured.over_map import RENDERED

#: Statistics of the table, in its order.
STATISTICS = (
    "registration_inliers",
    *(f"{name}_{kind}" for kind in ("yield", "rank", "inliers") for name in MATCHERS),
    "sift_inlier_fraction", "orb_inlier_fraction", "template_correlation", "template_strong_correlation",
    "lvs_found_fraction", "lvs_correlation", "lvs_residual_px",
)  # fmt: skip
_NAMES = {"template": "templates", "sift": "SIFT", "orb": "ORB", "lvs": "landmarks"}


def map_section(subject: section.Subject) -> section.Section | None:
    """Create the section that compares recorded with rendered images; None if the cases are of another kind."""
    frame = subject.frame
    if "registration_inliers" not in frame:
        return None
    is_posed = {prefix: np.isfinite(numbers(frame, f"{prefix}height_m")) for prefix in ("", RENDERED)}
    columns = {
        name: [numbers(frame, prefix + name)[posed] for prefix, posed in is_posed.items()] for name in STATISTICS
    }
    counts = {
        "images": len(frame),
        "recorded_with_pose": int(is_posed[""].sum()),
        "rendered": int(np.isfinite(numbers(frame, f"{RENDERED}registration_inliers")).sum()),
        "rendered_with_pose": int(is_posed[RENDERED].sum()),
    }
    rows = [
        ["images", str(counts["images"]), str(counts["rendered"])],
        ["images with a pose", str(counts["recorded_with_pose"]), str(counts["rendered_with_pose"])],
        *([label(name), *map(_summarize, values)] for name, values in columns.items()),
        [
            label(f"{RENDERED}pose_error_px"),
            _summarize(np.empty(0)),
            _summarize(numbers(frame, f"{RENDERED}pose_error_px")),
        ],
    ]
    figures = []
    if counts["recorded_with_pose"]:
        caption = "Yields over the height above the ground: recorded (filled) and rendered (open) images."
        figures.append(section.svg_figure(yield_figure(frame), "over-map", caption))
    data = {
        **counts,
        "medians": {name: [_median(values) for values in pair] for name, pair in columns.items()},
        "pose_error_px": _median(numbers(frame, f"{RENDERED}pose_error_px")),
    }
    grid = section.Grid(["Statistic", "Recorded", "Rendered"], rows)
    blocks = [
        section.Block(
            text=note_text("measured.over_map_text"), figures=figures, grid=grid, note=note_text("measured.over_map")
        )
    ]
    return section.Section("over-map", "Map", "Recorded and rendered images over maps", blocks, data)


def _median(values: Float[np.ndarray, " n"]) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else None


def _summarize(values: Float[np.ndarray, " n"]) -> str:
    """Format the median and the range of known values."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return number(float("nan"))
    return f"{number(float(np.median(finite)))} ({number(float(finite.min()))} to {number(float(finite.max()))})"


@figure_style.in_page_style
def yield_figure(frame: pd.DataFrame) -> Figure:
    """Draw the yield of each matcher over the height of recorded and rendered images."""
    figure = Figure(figsize=(9.0, 2.8), layout="constrained")
    for index, (axes, name) in enumerate(zip(figure.subplots(1, len(MATCHERS), sharey=True), MATCHERS, strict=True)):
        for prefix, filling in (("", figure_style.SERIES[index]), (RENDERED, "none")):
            height, fraction = numbers(frame, prefix + "height_m"), numbers(frame, f"{prefix}{name}_yield")
            style = {"color": figure_style.SERIES[index], "markerfacecolor": filling, "markersize": 5.0}
            axes.plot(height, fraction, figure_style.MARKERS[index], **style)
        axes.set(xlabel="height (m)", ylim=(0.0, 1.0))
        axes.set_title(_NAMES[name], fontsize=9)
    figure.axes[0].set_ylabel("yield")
    return figure


def view(products: Products, _complete: bool = False) -> CaseView:
    """Create the view of a case: image and map with the landmarks, recorded above and rendered below."""
    rows = [panels for kind in ("recorded", "rendered") if (panels := _panels(products, kind))]
    figure = draw_panels(rows, (9.0, 4.6 * len(rows)))
    return CaseView([CaseFigure("landmarks", figure, "Images and their maps, with the matched landmarks.")])


def _panels(products: Products, kind: str) -> list[Panel]:
    """Create the panels of a recorded or rendered image and of the map below it; empty without the image."""
    image, map_image = to_matrix(products.get(f"{kind}_image")), to_matrix(products.get(f"{kind}_map"))
    landmarks = array_of_shape(products.get(f"{kind}_landmarks"), None, 5)
    title = f"{kind.capitalize()} image"
    if image is None:
        return []
    if map_image is None or landmarks is None:
        return [Panel(image, title), Panel(text="no pose on the map")]
    style = {"marker": "o", "linestyle": "none", "markersize": 5.0, "fillstyle": "none"}
    style["color"] = figure_style.SERIES[1]
    # columns of the product: (u, v) in the image, (u, v) on the map, and score of the match
    image_pixels, map_pixels, _ = np.split(landmarks, (2, 4), axis=1)
    on_image, on_map = Mark(image_pixels, style), Mark(map_pixels, style)
    return [Panel(image, f"{title}, {len(landmarks)} landmarks", [on_image]), Panel(map_image, "Its map", [on_map])]


OVER_MAP = CaseKind(
    lambda products: "recorded_image" in products,
    view,
    "Circles are landmarks of the map that agree on the pose of the image.",
)
