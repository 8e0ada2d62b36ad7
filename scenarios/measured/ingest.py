"""Convert a folder of recorded images into stored cases and their campaign: `marsyard ingest`."""

import math
from collections.abc import Iterable, Iterator
from pathlib import Path

from marsyard.algorithms.dimes.views import binned_size_for
from marsyard.scenarios.measured import store
from marsyard.scenarios.measured.folder_reader import FolderReader
from marsyard.scenarios.measured.layout import (
    INGEST_FILE,
    MAP,
    TABLE_FILE,
    VELOCITY,
    IngestError,
    read_ingest_file,
    read_table,
)
from marsyard.scenarios.measured.map_matching import TOLERANCE_PX
from marsyard.scenarios.measured.map_registration import add_map, describe_poses
from marsyard.scenarios.systems import Ingested
from marsyard.scenarios.template import toml_environment
from marsyard.scenarios.user_tables import format_problems
from marsyard.sim.camera import CameraModel

#: Maximum number of rows that a detector sums, and maximum relative deviation of the ratio of the focal lengths from a
#: whole number. Calibrated focal lengths are accurate to 1 %; the next whole number after 8 differs by 12 %.
_MAX_SUMMED_ROWS, _RATIO_TOLERANCE = 64, 0.05
#: Difference below which a true velocity is the same measurement as the velocity of an interval, m/s (assumed): three
#: decimals of both components round off at most 0.7 mm/s. Two measurements that differ by 0.1 m/s (RMS, each axis) are
#: this near with the probability 1 - exp(-(0.001 / 0.1)^2 / 2) = 5e-5.
_EQUAL_M_S = 1e-3
#: Default description of a campaign, by task.
_DESCRIPTIONS = {
    "velocity": "Real descents: horizontal velocity from three images.",
    "landing": "Real flights: landing sites from two images.",
    "matching": "Real images, compared with their measured poses.",
    "map": "Real images over a map, next to rendered images of the same camera, heights and attitudes.",
}


def ingest_campaign(source: Path, target: Path, final: Path) -> Ingested:
    """Write the cases of a folder, and return their campaign.

    - source: folder with `ingest.toml`, `images.csv` and images (docs/real-images.md)
    - target: folder for the new cases
    - final: folder to which `target` is moved afterwards

    Raises ValueError if the folder is invalid: the message contains the file, and the line or key. Raises OSError if
    the cases cannot be written.
    """
    path, stored_cases = ingest(source, target)
    file = read_ingest_file(source)
    rows_summed, note, binned_size = stored_cases.detector.rows_summed, "", None
    if rows_summed > 1 and file.detector.rows_summed is None:
        note = (
            f"rows_summed = {rows_summed}: computed from the camera, whose pixels are longer than wide by "
            f"that factor; rows_summed under [detector] of {INGEST_FILE} overrides it"
        )
    if stored_cases.task == VELOCITY:
        # DIMES bins delivered images, whose rows are already summed; without square bins, a bin is one pixel
        columns, rows = stored_cases.cases[0].images[0].size
        binned_size = binned_size_for(columns, rows * rows_summed)
        binned_size = binned_size if rows % binned_size[1] == 0 else (columns, rows)
    description = stored_cases.description or _DESCRIPTIONS[stored_cases.task]
    if stored_cases.task == MAP:
        note = describe_poses(stored_cases)
    warnings = "\n".join(_find_warnings(stored_cases))
    note, description = f"{note}\n{warnings}".strip(), " ".join([description, *warnings.splitlines()])
    template = toml_environment(Path(__file__).parent).get_template("campaign.toml.j2")
    text = template.render(
        **stored_cases.model_dump(include={"folder", "name", "task"}),
        description=description,
        cases=len(stored_cases.cases),
        file=str(final / path.name),
        binned_size=binned_size,
        numbers=list(range(len(stored_cases.cases))),
        is_level=file.map is not None and file.map.elevation is None,
        tolerance_px=TOLERANCE_PX,
        suns={"sun": file.sun, "map_sun": file.map and file.map.sun},
        velocity_is_known=any(case.truth.velocity_m_s is not None for case in stored_cases.cases),
    )
    return Ingested(text, len(stored_cases.cases), sum(len(case.images) for case in stored_cases.cases), note)


def _find_warnings(stored_cases: store.StoredCases) -> Iterator[str]:
    """Yield what limits the evidence of the cases, in one sentence each; it is also in the report."""
    cases = stored_cases.cases
    distinct = len({tuple(image.counts.sha256 for image in case.images) for case in cases})
    if distinct < len(cases):
        yield f"Only {distinct} of {len(cases)} cases have different images; rates count all cases."
    known = sum(
        math.dist(case.truth.velocity_m_s, case.interval_velocities_m_s[-1][:2]) < _EQUAL_M_S
        for case in cases
        if case.truth.velocity_m_s is not None and case.interval_velocities_m_s is not None
    )
    if known:
        yield (
            f"The true velocity of {known} of {len(cases)} cases is also an input of the algorithms: those that use "
            "this velocity, and not only its change as DIMES, have no error."
        )


def ingest(source: Path, target: Path) -> tuple[Path, store.StoredCases]:
    """Write the cases of a folder into an existing folder; return the path of `cases.json` and its contents.

    Raises IngestError if the folder is invalid: the message contains the file, and the line or key. Raises OSError if
    the cases cannot be written.
    """
    file, table = read_ingest_file(source), source / TABLE_FILE
    reader = FolderReader(source, file, target)
    cases: list[store.StoredCase] = []
    problems: list[str] = []
    for number, (name, rows) in enumerate(read_table(table, file.task).items()):
        try:
            cases.append(reader.store_case(number, name, rows))
        except ValueError as error:
            problems.append(str(error))
    if problems:
        raise IngestError(format_problems(table, problems))
    detector = file.detector
    stored_cases = store.StoredCases(
        schema_version=store.SCHEMA,
        name=file.name,
        description=file.description,
        task=file.task,
        folder=str(source.resolve()),
        detector=store.StoredDetector(
            **detector.model_dump(include={"offset_dn", "transfer_row_s", "clear_row_s"}),
            full_scale_dn=(1 << detector.bits) - 1,
            rows_summed=detector.rows_summed or _infer_common_rows(source, reader.cameras),
        ),
        cases=tuple(cases),
    )
    path = store.write_cases(target, stored_cases)
    if file.map is None:
        return path, stored_cases
    stored_cases = add_map(source, file.map, store.CasesFile(file=str(path)))
    return store.write_cases(target, stored_cases), stored_cases


def _infer_common_rows(source: Path, cameras: Iterable[CameraModel]) -> int:
    """Infer the number of summed rows, which is that of all cameras. Raises IngestError if they differ."""
    first, *others = sorted({infer_summed_rows(camera) for camera in cameras})
    if others:
        raise IngestError(
            f"{source / INGEST_FILE}: detector.rows_summed is {first} for one camera and {others[0]} for another, by "
            "their focal lengths; allowed: one number for all images: ingest the cameras separately"
        )
    return first


def infer_summed_rows(camera: CameraModel) -> int:
    """Infer the number of detector rows in a delivered row from the ratio of the focal lengths.

    Returns 1 if the ratio is not near a whole number: then the pixels are not sums of square pixels.
    """
    focal_columns, focal_rows = camera.focal_lengths
    ratio = focal_columns / focal_rows
    divisor = round(ratio)
    is_whole = 1 < divisor <= _MAX_SUMMED_ROWS and abs(ratio - divisor) <= _RATIO_TOLERANCE * divisor
    return divisor if is_whole else 1
