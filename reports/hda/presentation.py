"""Presentation of hazard detection: report sections, and views of cases as the paper's figures.

The paper is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from marsyard.algorithms.interface import SiteOutcome
from marsyard.reports.column_values import is_true, to_float
from marsyard.reports.hda.case_figures import FIGURES, available_figures, drawn_sites, is_unknown_everywhere
from marsyard.reports.hda.limits_section import limits_section
from marsyard.reports.hda.paper_sections import run_times_section, touchdown_section
from marsyard.reports.hda.products import (
    is_hda_case,
    read_images,
    read_landing_maps,
    read_matches,
    read_motion,
    read_tracked_features,
)
from marsyard.reports.hda.sections import faults_section, map_section, threshold_section
from marsyard.reports.hda.sites_section import sites_section
from marsyard.reports.images import draw_images
from marsyard.reports.presentation import CaseFigure, CaseKind, CaseView, Cause, Presentation, TableRow
from marsyard.reports.products import Products
from marsyard.reports.wording import note_text, number
from marsyard.scenarios.landing.parameters import LanderParameters

_CAPTIONS: Mapping[str, str] = {
    "fig1-tracks": "Fig. 1: features of the first image and their tracks in the second image.",
    "fig2-motion": "Fig. 2: estimated motion and structure. Rectangles are the fields of view on the ground; short "
    "lines are the axes of the cameras.",
    "fig3-epipolar": "Fig. 3: structure pixels (red), epipolar segments (green), matches (blue).",
    "fig4-elevation": "Fig. 4: elevation map.",
    "fig5-maps": "Fig. 5: maps of the algorithm (top row) and ground truth (bottom row).",
    "fig7-site": "Fig. 7: safe landing map.",
}
_MARKS: Mapping[str, str] = {"apriori": "Black X: a-priori site.", "site": "Purple plus: reported site."}
_UNKNOWN_TEXTS: Mapping[str, str] = {
    "fig5-maps": "The safe landing map is unknown everywhere: all its cells are close to a hole or to the border.",
    "fig7-site": "It is unknown everywhere.",
}
#: This figure is only in files, since its images are those of Fig. 3.
_OMITTED_FIGURE = "fig1-tracks"


def view(products: Products, complete: bool = False) -> CaseView:
    """Create the view of a landing case; it contains only the images if no stage of the paper has results."""
    names = [name for name in available_figures(products) if complete or name != _OMITTED_FIGURE]
    head, rows = _stage_rows(products)
    image_pair = read_images(products)
    if not names and image_pair is not None:
        figure = CaseFigure("images", draw_images(image_pair), "The two images that the algorithm received.")
        return CaseView([figure], head=head, rows=rows, legend=note_text("hda.plain_legend"))
    figures = [CaseFigure(name, FIGURES[name](products), _caption(name, products)) for name in names]
    return CaseView(figures, head=head, rows=rows)


def _caption(name: str, products: Products) -> str:
    """Create the caption of a figure, with the marks and the state of the map that it contains."""
    maps = read_landing_maps(products)
    sentences = [_CAPTIONS[name]]
    if maps is not None and name in _UNKNOWN_TEXTS and is_unknown_everywhere(maps):
        sentences.append(_UNKNOWN_TEXTS[name])
    if maps is not None and name in ("fig4-elevation", "fig7-site"):
        sentences += [_MARKS[site] for site in drawn_sites(maps)]
    return " ".join(sentences)


def _stage_rows(products: Products) -> tuple[list[str], list[TableRow]]:
    """Create head and rows of the table of results by stage."""
    tracks, motion = read_tracked_features(products), read_motion(products)
    matches, maps = read_matches(products), read_landing_maps(products)
    names = ("Features and tracks", "Motion", "Structure", "Elevation map", "Safe landing map", "Site")
    results = dict.fromkeys(names, "")
    if tracks is not None:
        results["Features and tracks"] = f"{tracks.accepted.sum()} of {len(tracks.first)} tracked"
    if motion is not None:
        # rotation by an angle has the trace 1 + 2 cos(angle)
        rotation_error = motion.rotation @ motion.true_rotation.T
        angle_deg = np.degrees(np.arccos(np.clip(0.5 * (np.trace(rotation_error) - 1.0), -1.0, 1.0)))
        error_m = float(np.linalg.norm(motion.translation - motion.true_translation))
        baseline = f"baseline {number(float(np.linalg.norm(motion.true_translation)))} m, error {number(error_m)} m"
        results["Motion"] = f"{baseline}; rotation error {number(float(angle_deg))} deg"
    if matches is not None:
        results["Structure"] = f"{matches.accepted.sum():,} of {len(matches.grid):,} structure pixels matched"
    if maps is not None:
        rows, columns = maps.elevation_m.shape
        results["Elevation map"] = f"{rows} x {columns} cells of {number(maps.cell_m)} m"
        safe, hazard = float(np.mean(maps.safety < 0.5)), float(np.mean(maps.safety > 1.5))
        classes = (("safe", safe), ("hazard", hazard), ("unknown", 1.0 - safe - hazard))
        results["Safe landing map"] = ", ".join(f"{name} {100.0 * fraction:.1f} %" for name, fraction in classes)
        x, y = maps.positions(maps.site)
        has_site = bool(np.isfinite(maps.site).all())
        results["Site"] = f"x {number(x)} m, y {number(y)} m (axes of Fig. 4)" if has_site else "no safe site"
    return ["Stage", "Result"], [TableRow([name, text or "not reached"], bool(text)) for name, text in results.items()]


def explain(row: Mapping[str, Any], metric: str) -> Cause | None:
    """Return the cause of an unsafe site or touchdown, or the number of tracks of a flight without a map.

    A site is unsafe beyond the lander's limits. Those of the algorithm (columns `max_slope_deg` and `max_roughness_m`)
    can differ from them.
    """
    place = metric.removesuffix("_safe")
    if place in ("site", "touchdown"):
        slope_deg, roughness_m = (to_float(row.get(f"{place}_{name}")) for name in ("slope_deg", "roughness_m"))
        if math.isnan(slope_deg + roughness_m):
            return None
        slope_ratio = slope_deg / _lander_limit(row, "max_slope_deg")
        roughness_ratio = roughness_m / _lander_limit(row, "max_roughness_m")
        detail = f"ground with a slope of {number(slope_deg)} deg and a roughness of {number(roughness_m)} m"
        if place == "touchdown" and not math.isnan(distance_m := to_float(row.get("touchdown_error_m"))):
            detail += f", {number(distance_m)} m from the site"
        return Cause("slope" if slope_ratio > roughness_ratio else "roughness", detail)
    if metric in ("converged", "site_reported") and not is_true(row.get("converged")):
        return Cause(
            "few tracks", f"{to_float(row.get('tracks')):.0f} of {to_float(row.get('features')):.0f} features tracked"
        )
    return None


def _lander_limit(row: Mapping[str, Any], name: str) -> float:
    """Return a limit of the lander: the sampled value or that of the campaign's file, otherwise the default."""
    limit = to_float(row.get(f"lander.{name}"))
    return float(getattr(LanderParameters(), name)) if math.isnan(limit) else limit


HDA = Presentation(
    cases=(CaseKind(is_hda_case, view, note_text("hda.legend")),),
    sections=(
        threshold_section, faults_section, limits_section, map_section, touchdown_section,
        sites_section, run_times_section,
    ),
    outcomes=(SiteOutcome,),
    explain=explain,
)  # fmt: skip
