"""Image folders in the user format, made from measurements with known truth."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.sim.camera import write_cahvor
from marsyard.sim.frames import SITE_FROM_WORLD
from marsyard.sim.measurements import DescentMeasurements, DetectorImage, LandingMeasurements

#: OpenCV's camera axes in the axes of a body whose camera looks along -z.
CAMERA_IN_BODY = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
BITS = 12


def velocity_folder(
    folder: Path, cases: Mapping[str, DescentMeasurements], truth: Mapping[str, np.ndarray], *, ned: bool = False
) -> Path:
    """Write a folder of descents, in north-east-down and camera axes if requested, else in Marsyard's axes."""
    rows = []
    for name, one in cases.items():
        for number, image in enumerate(one.images):
            row = _row(folder, name, number, image, one.attitudes[number].world_from_body, ned=ned)
            row |= {"altitude_m": one.altitudes[number].altitude_m, "altitude_time_s": one.altitudes[number].time_s}
            if number:
                velocity = one.interval_velocities_m_s[number - 1]
                row |= _numbers("v{}_m_s", _world(ned).apply(velocity))
            sun = one.sun_direction
            row |= {
                "sun_azimuth_deg": np.degrees(np.arctan2(sun[0], sun[1])) % 360.0,
                "sun_elevation_deg": np.degrees(np.arcsin(sun[2])),
            }
            if number == 2 and name in truth:
                x, y, _ = _world(ned).apply([*truth[name], 0.0])
                row |= {"true_vx_m_s": x, "true_vy_m_s": y}
            rows.append(row)
    first = next(iter(cases.values())).images[0]
    return _write_campaign(folder, "velocity", first, rows, ned=ned)


def landing_folder(folder: Path, one: LandingMeasurements, task: str, *, true_poses: bool = False) -> Path:
    """Write a folder of one flight, for landing or matching."""
    rows = []
    for number, (image, pose) in enumerate(zip(one.images, one.poses, strict=True)):
        turn, position = pose.world_from_body.rotation, pose.world_from_body.translation
        row = _row(folder, "hover", number, image, turn, ned=False) | _numbers("{}_m", position)
        if task == "landing" and number == 0:
            row["slant_range_m"] = one.slant_range_m
        if true_poses:
            row |= _numbers("true_{}_m", position) | _quaternion("true_", turn)
        rows.append(row)
    return _write_campaign(folder, task, one.images[0], rows, ned=False)


def _row(
    folder: Path, case: str, number: int, image: DetectorImage, attitude: Rotation, *, ned: bool
) -> dict[str, Any]:
    folder.mkdir(exist_ok=True)
    name = f"{case}-{number}.png"
    cv2.imwrite(str(folder / name), image.counts)
    written = _world(ned) * attitude * CAMERA_IN_BODY if ned else attitude
    return {"case": case, "file": name, "time_s": image.time_s, **_quaternion("", written)}


def _world(ned: bool) -> Rotation:
    return SITE_FROM_WORLD if ned else Rotation.identity()


def _quaternion(prefix: str, rotation: Rotation) -> dict[str, float]:
    return dict(zip((f"{prefix}q{axis}" for axis in "xyzw"), rotation.as_quat(), strict=True))


def _numbers(form: str, values: np.ndarray) -> dict[str, float]:
    return {form.format(axis): float(value) for axis, value in zip("xyz", values, strict=True)}


def _write_campaign(
    folder: Path, task: str, image: DetectorImage, rows: Sequence[Mapping[str, Any]], *, ned: bool
) -> Path:
    known = image.calibration
    write_cahvor(image.camera, folder / "camera.cahvor")
    np.save(folder / "flat.npy", known.flat_field)
    axes, whose, placed = ("ned", "camera", "false") if ned else ("enu", "body", "true")
    (folder / "ingest.toml").write_text(f"""name = "test-{task}"
task = "{task}"
[poses]
axes = "{axes}"
attitude_of = "{whose}"
[camera]
file = "camera.cahvor"
placed = {placed}
[detector]
bits = {BITS}
offset_dn = {known.offset_dn!r}
exposure_s = {known.exposure_s!r}
transfer_row_s = {known.transfer_row_s!r}
clear_row_s = {known.clear_row_s!r}
rows_summed = {known.rows_summed}
flat_field = "flat.npy"
""")
    write_rows(folder, rows)
    return folder


def write_rows(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write `pictures.csv`."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with (folder / "pictures.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(
            {name: repr(float(v)) if not isinstance(v, str) else v for name, v in row.items()} for row in rows
        )


def read_rows(folder: Path) -> list[dict[str, str]]:
    """Read the rows of `pictures.csv` as text."""
    with (folder / "pictures.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def write_texts(folder: Path, rows: Sequence[Mapping[str, str]]) -> None:
    """Write rows of text without changes."""
    with (folder / "pictures.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
