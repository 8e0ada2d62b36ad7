"""Presentation of hazard detection: report sections, and views of cases as the paper's figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from marsyard.reports.hda import products as stages
from marsyard.reports.hda import sections
from marsyard.reports.hda.case_figures import FIGURES, figures_reached, write_hda_figures
from marsyard.reports.hda.classes import draw_classes, limits_section
from marsyard.reports.kinds import Distribution, MadeBy, RateTable, SectionDeclaration
from marsyard.reports.presentation import CaseKind, CaseView, Presentation, TableRow
from marsyard.reports.section import draw_pictures, plate
from marsyard.reports.wording import note_text, number

_CAPTIONS: Mapping[str, str] = {
    "fig2-motion": "Fig. 2: motion and structure from three sides.",
    "fig3-epipolar": "Fig. 3: structure pixels (red), epipolar segments (green), matches (blue).",
    "fig4-elevation": "Fig. 4: two views of the elevation map.",
    "fig5-maps": "Fig. 5: elevation, roughness, slope and safe landing map; below, the truth.",
    "fig7-site": "Fig. 7: first picture, and the safe landing map on it and on the terrain.",
}
#: Its pictures are those of Fig. 3: only `marsyard replay` draws it.
_LEFT_OUT = "fig1-tracks"


def view(products: Mapping[str, Any], key: str) -> CaseView:
    """A landing case; its pictures alone without results of the paper's stages."""
    names = [name for name in figures_reached(products) if name != _LEFT_OUT]
    picture_pair = stages.pictures(products)
    if not names and picture_pair is not None:
        caption = "The two pictures that the algorithm was given."
        shown = plate(draw_pictures(picture_pair), f"{key}pictures", caption, wide=True)
        return CaseView([], [shown], *_stages(products), note_text("hda.plain_legend"))
    plates = [plate(FIGURES[name](products), f"{key}{name[:4]}", _CAPTIONS[name], wide=True) for name in names]
    facts = [("Figures", ", ".join(name.split("-")[0] for name in names) or "none")]
    return CaseView(facts, plates, *_stages(products))


def _stages(products: Mapping[str, Any]) -> tuple[list[str], list[TableRow]]:
    tracks, motion = stages.tracked_features(products), stages.solved_motion(products)
    matches, maps = stages.epipolar_matches(products), stages.landing_maps(products)
    results = dict.fromkeys(("Features and tracks", "Motion", "Structure", "Map", "Site"), "")
    if tracks is not None:
        results["Features and tracks"] = f"{tracks.accepted.sum()} of {len(tracks.first)} tracked"
    if motion is not None:
        turned = motion.rotation @ motion.true_rotation.T
        angle = np.degrees(np.arccos(np.clip(0.5 * (np.trace(turned) - 1.0), -1.0, 1.0)))
        off = float(np.linalg.norm(motion.translation - motion.true_translation))
        baseline = f"baseline {number(float(np.linalg.norm(motion.true_translation)))} m, off by {number(off)} m"
        results["Motion"] = f"{baseline}; rotation off by {number(float(angle))} deg"
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
    "Sites and hazards against the truth",
    rows=sections.landing_rows,
    parts=(
        RateTable(sections.site_shares, cases="Flights", heading="Sites", data="shares", shared=False),
        MadeBy(sections.draw_outcomes),
        Distribution(
            sections.distances,
            ("distance to the nearest unsafe position (m)", "fraction beyond"),
            "Fraction of positions farther than each distance from the nearest unsafe position of the lander.",
            heading="Distance to true hazards",
            falling=True,
            table=sections.distance_grid,
        ),
        MadeBy(draw_classes),
    ),
)
_SECTIONS = (sections.THRESHOLD, sections.FAULTS, limits_section, sections.MAP_ERRORS, sections.TOUCHDOWN, SITES)
HDA = Presentation(
    cases=(CaseKind(stages.is_hda_case, view, write_hda_figures, note_text("hda.legend")),),
    sections=(*_SECTIONS, sections.run_times_section),
)
