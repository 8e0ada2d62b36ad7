"""The campaign over ingested cases: `marsyard ingest`."""

from __future__ import annotations

from pathlib import Path

from marsyard.scenarios.descent.parameters import binned_size_for
from marsyard.scenarios.measured.ingest import ingest
from marsyard.scenarios.measured.layout import INGEST_FILE, VELOCITY, read_ingest_file
from marsyard.scenarios.measured.store import StoredCases
from marsyard.scenarios.system import Ingested
from marsyard.scenarios.template import toml_environment

_DESCRIPTIONS = {
    "velocity": "Real descents: horizontal velocity from three pictures.",
    "landing": "Real flights: landing sites from two pictures.",
    "matching": "Real pictures against their measured poses.",
}


def ingest_campaign(source: Path, target: Path, final: Path) -> Ingested:
    """Write the cases of a folder, and state the campaign over them.

    Parameters
    ----------
    source
        A folder with `ingest.toml`, `pictures.csv` and pictures (docs/real-pictures.md).
    target, final
        Where the cases are written, and the folder where they will lie.

    Raises
    ------
    ValueError
        Where the folder cannot be used; the message names the file, and the line or key.
    OSError
        Where the cases cannot be written.
    """
    path, stored = ingest(source, target)
    summed, note = stored.detector.rows_summed, ""
    if summed > 1 and read_ingest_file(source).detector.rows_summed is None:
        note = (
            f"rows_summed = {summed}: taken from the camera, whose pixels are longer than wide by "
            f"that factor; rows_summed under [detector] of {INGEST_FILE} says otherwise"
        )
    pictures = sum(len(case.pictures) for case in stored.cases)
    return Ingested(_campaign_text(stored, final / path.name), len(stored.cases), pictures, note)


def _campaign_text(stored: StoredCases, file: Path) -> str:
    """The campaign over ingested cases, whose `cases.json` will lie at a path."""
    is_velocity = stored.task == VELOCITY
    template = toml_environment(Path(__file__).parent).get_template("campaign.toml.j2")
    return template.render(
        folder=stored.folder,
        name=stored.name,
        task=stored.task,
        description=stored.description or _DESCRIPTIONS[stored.task],
        cases=len(stored.cases),
        file=str(file),
        binned_size=_binned_size(stored) if is_velocity else None,
        numbers=list(range(len(stored.cases))),
        velocity_is_known=is_velocity and any(case.truth.velocity_m_s is not None for case in stored.cases),
    )


def _binned_size(stored: StoredCases) -> tuple[int, int]:
    """The size (columns, rows) that DIMES bins delivered pictures to, whose rows are summed already."""
    delivered = stored.cases[0].pictures[0].size
    columns, rows = binned_size_for(delivered[0], delivered[1] * stored.detector.rows_summed)
    return (columns, rows) if delivered[1] % rows == 0 else delivered
