"""How hazard detection is presented: its sections, and a case as the paper's figures and what became of the site."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from marsyard.reports.hda.case_figures import FIGURES, figures_reached, write_hda_figures
from marsyard.reports.hda.classes import draw_classes, limits_section
from marsyard.reports.hda.products import (
    LandingMaps,
    SolvedMotion,
    epipolar_matches,
    is_hda_case,
    landing_maps,
    pictures,
    solved_motion,
    tracked_features,
)
from marsyard.reports.hda.sections import (
    FAULTS,
    MAP_ERRORS,
    THRESHOLD,
    TOUCHDOWN,
    distance_grid,
    distances,
    draw_outcomes,
    landing_rows,
    run_times_section,
    site_shares,
)
from marsyard.reports.kinds import Distribution, MadeBy, RateTable, SectionDeclaration
from marsyard.reports.presentation import CaseKind, CaseView, Presentation, TableRow
from marsyard.reports.section import plate
from marsyard.reports.svg import draw_pictures
from marsyard.reports.wording import number

_CAPTIONS: Mapping[str, str] = {
    "fig2-motion": "Fig. 2: motion and structure from three sides.",
    "fig3-epipolar": "Fig. 3: structure pixels (red), epipolar segments (green), matches (blue).",
    "fig4-elevation": "Fig. 4: two views of the elevation map.",
    "fig5-maps": "Fig. 5: elevation, roughness, slope and safe landing map; below, the truth.",
    "fig7-site": "Fig. 7: first picture, and the safe landing map on it and on the terrain.",
}
#: Its pictures are those of Fig. 3: the page leaves them out, `marsyard replay` draws them.
_LEFT_OUT = "fig1-tracks"
_LEGEND = (
    "As the paper's Figs. 2 to 5 and 7; marsyard replay draws Fig. 1 as well. Elevation: dark is high, bright is low. "
    "Roughness and slope: green well below "
    "the limit, yellow towards it, red beyond; the scale ends at twice the limit, grey is not known. Safe landing map: "
    "green safe, red hazard (hatched), yellow unknown; a black X marks the a-priori site, a purple plus the safe site. "
    "The truth is of the footprint of a lander whose middle stands there, and is not grown by its diameter; yellow: "
    "not all of the footprint is seen by both pictures."
)

_PLAIN_LEGEND = (
    "Pictures as delivered. Stages are drawn of algorithms whose answers have the details of the paper's "
    "(docs/own-algorithms.md)."
)


def view(products: Mapping[str, Any], key: str) -> CaseView:
    """A landing's case; where no stage of the paper's left its results, its pictures alone."""
    names = [name for name in figures_reached(products) if name != _LEFT_OUT]
    seen = pictures(products)
    if not names and seen is not None:
        shown = plate(
            draw_pictures(seen), f"{key}pictures", "The two pictures that the algorithm was given.", wide=True
        )
        return CaseView([], [shown], *_stages(products), _PLAIN_LEGEND)
    plates = [plate(FIGURES[name](products), f"{key}{name[:4]}", _CAPTIONS[name], wide=True) for name in names]
    return CaseView(
        [("Figures", ", ".join(name.split("-")[0] for name in names) or "none")], plates, *_stages(products)
    )


def _stages(products: Mapping[str, Any]) -> tuple[list[str], list[TableRow]]:
    """The stages as a table: what each gave, and whether it was reached."""
    tracks, motion = tracked_features(products), solved_motion(products)
    matches, maps = epipolar_matches(products), landing_maps(products)
    told = [
        ("Features and tracks", None if tracks is None else f"{tracks.accepted.sum()} of {len(tracks.first)} tracked"),
        ("Motion", None if motion is None else _motion_text(motion)),
        ("Structure", None if matches is None else f"{matches.accepted.sum():,} of {len(matches.grid):,} matched"),
        ("Map", None if maps is None else _map_text(maps)),
        ("Site", None if maps is None else _site_text(maps)),
    ]
    return ["Stage", "Result"], [TableRow([name, text or "not reached"], text is not None) for name, text in told]


def _motion_text(motion: SolvedMotion) -> str:
    turned = motion.rotation @ motion.true_rotation.T
    angle = np.degrees(np.arccos(np.clip(0.5 * (np.trace(turned) - 1.0), -1.0, 1.0)))
    off = float(np.linalg.norm(motion.translation - motion.true_translation))
    baseline = float(np.linalg.norm(motion.true_translation))
    return f"baseline {number(baseline)} m, off by {number(off)} m; rotation off by {number(float(angle))} deg"


def _map_text(maps: LandingMaps) -> str:
    rows, columns = maps.elevation_m.shape
    return f"{rows} x {columns} cells of {number(maps.cell_m)} m"


def _site_text(maps: LandingMaps) -> str:
    if not np.isfinite(maps.site).all():
        return "no safe site"
    return f"row {maps.site[0]:.0f}, column {maps.site[1]:.0f}"


SITES = SectionDeclaration(
    "sites",
    "Sites",
    "Sites and hazards against the truth",
    rows=landing_rows,
    parts=(
        RateTable(site_shares, cases="Flights", heading="Sites", data="shares", shared=False),
        MadeBy(draw_outcomes),
        Distribution(
            distances,
            ("distance to the nearest unsafe place (m)", "share at least so far"),
            "Share of places at least so far from the nearest one where the lander would not stand safely.",
            heading="Distance to true hazards",
            falling=True,
            table=distance_grid,
        ),
        MadeBy(draw_classes),
    ),
)
HDA = Presentation(
    cases=(CaseKind(is_hda_case, view, write_hda_figures, _LEGEND),),
    sections=(THRESHOLD, FAULTS, limits_section, MAP_ERRORS, TOUCHDOWN, SITES, run_times_section),
)
