"""Section on the domain of validity: cases outside of the conditions in which the simulation was checked."""

from __future__ import annotations

from marsyard.reports.section import Block, Grid, Section, Subject
from marsyard.reports.validation_rows import QUANTITIES, format_range
from marsyard.reports.validity import DOMAINS, assess_validity
from marsyard.reports.wording import NOTHING, note_text, percent


def validity_section(subject: Subject) -> Section | None:
    """Create the section with the domain of validity; None for the system of another package."""
    validity = assess_validity(subject.run)
    if not validity.domains:
        return None
    rows = [
        [
            f"{QUANTITIES[item.quantity]}, compared {DOMAINS[domain.kind][1]}",
            format_range(item.cases),
            NOTHING if item.checked is None else format_range(item.checked),
            f"{item.outside:,} ({percent(item.outside / validity.cases)})",
        ]
        for domain in validity.domains
        for item in domain.coverage
    ]
    grid = Grid(["Quantity", "Cases", "Checked", "Cases outside"], rows)
    missed = Grid(
        ["Missed check", "Kind", "Conditions"], [[item.text, item.kind, item.conditions] for item in validity.missed]
    )
    blocks = [Block(grid=grid, note=note_text("common.validity"))]
    blocks += [Block(heading="Checks that miss their limit", grid=missed)] if validity.missed else []
    return Section("validity", "Validity", "Conditions in which the simulation was checked", blocks)
