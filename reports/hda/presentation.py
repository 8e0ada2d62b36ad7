"""Presentation of hazard detection: report sections, and views of cases as the paper's figures.

The paper is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from marsyard.algorithms.interface import SiteOutcome
from marsyard.reports.hda import products as stages
from marsyard.reports.hda import sections
from marsyard.reports.hda.case_figures import FIGURES, available_figures, write_hda_figures
from marsyard.reports.hda.classes import create_class_blocks, limits_section
from marsyard.reports.presentation import CaseKind, CaseView, Presentation, TableRow
from marsyard.reports.section import draw_images, svg_figure
from marsyard.reports.section_kinds import CustomBlocks, Distribution, RateTable, SectionDeclaration
from marsyard.reports.wording import note_text, number

_CAPTIONS: Mapping[str, str] = {
    "fig2-motion": "Fig. 2: estimated motion and structure, three views.",
    "fig3-epipolar": "Fig. 3: structure pixels (red), epipolar segments (green), matches (blue).",
    "fig4-elevation": "Fig. 4: two views of the elevation map.",
    "fig5-maps": "Fig. 5: elevation, roughness, slope and safe landing map. Bottom row: ground truth.",
    "fig7-site": "Fig. 7: first image; safe landing map overlaid on the image and on the terrain.",
}
#: This figure is not on the page, since its images are those of Fig. 3; only `marsyard replay` draws it.
_OMITTED_FIGURE = "fig1-tracks"


def view(products: Mapping[str, Any], key: str) -> CaseView:
    """Create the view of a landing case; it contains only the images if no stage of the paper has results.

    `key` is the prefix of the identifiers of figures.
    """
    names = [name for name in available_figures(products) if name != _OMITTED_FIGURE]
    image_pair = stages.read_images(products)
    if not names and image_pair is not None:
        caption = "The two images that the algorithm received."
        figure = svg_figure(draw_images(image_pair), f"{key}images", caption, wide=True)
        return CaseView([], [figure], *_stage_rows(products), note_text("hda.plain_legend"))
    named_figures = [(name, FIGURES[name](products)) for name in names]
    svg_figures = [svg_figure(figure, f"{key}{name[:4]}", _CAPTIONS[name], wide=True) for name, figure in named_figures]
    facts = [("Figures", ", ".join(name.split("-")[0] for name in names) or "none")]
    return CaseView(facts, svg_figures, *_stage_rows(products))


def _stage_rows(products: Mapping[str, Any]) -> tuple[list[str], list[TableRow]]:
    """Create head and rows of the table of results by stage."""
    tracks, motion = stages.read_tracked_features(products), stages.read_motion(products)
    matches, maps = stages.read_matches(products), stages.read_landing_maps(products)
    results = dict.fromkeys(("Features and tracks", "Motion", "Structure", "Map", "Site"), "")
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
        results["Structure"] = f"{matches.accepted.sum():,} of {len(matches.grid):,} matched"
    if maps is not None:
        (rows, columns), (row, column) = maps.elevation_m.shape, maps.site
        results["Map"] = f"{rows} x {columns} cells of {number(maps.cell_m)} m"
        results["Site"] = f"row {row:.0f}, column {column:.0f}" if np.isfinite(maps.site).all() else "no safe site"
    return ["Stage", "Result"], [TableRow([name, text or "not reached"], bool(text)) for name, text in results.items()]


SITES = SectionDeclaration(
    "sites",
    "Sites",
    "Sites and hazards compared with the ground truth",
    rows=sections.landing_rows,
    parts=(
        RateTable(sections.site_fractions, cases="Flights", heading="Sites", data="fractions", shared=False),
        CustomBlocks(sections.create_outcome_blocks),
        Distribution(
            sections.hazard_distances,
            ("distance to the nearest unsafe position (m)", "fraction above this distance"),
            "Fraction of sites and touchdowns that are farther from unsafe positions than the value on the axis.",
            heading="Distance to true hazards",
            complementary=True,
            table=sections.distance_grid,
            note=note_text("hda.distances"),
        ),
        CustomBlocks(create_class_blocks),
    ),
)
_SECTIONS = (sections.THRESHOLD, sections.FAULTS, limits_section, sections.MAP_ERRORS, sections.TOUCHDOWN, SITES)
HDA = Presentation(
    cases=(CaseKind(stages.is_hda_case, view, write_hda_figures, note_text("hda.legend")),),
    sections=(*_SECTIONS, sections.run_times_section),
    outcomes=(SiteOutcome,),
)
