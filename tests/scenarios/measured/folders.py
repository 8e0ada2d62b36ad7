"""Writers of image folders in the format of `marsyard ingest`, from measurements with known truth, for tests."""

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

#: Rotation from OpenCV's camera axes to the axes of a body whose camera looks along -z.
CAMERA_IN_BODY = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
#: Bits of the detector.
BITS = 12


def write_velocity_folder(
    folder: Path, cases: Mapping[str, DescentMeasurements], truth: Mapping[str, np.ndarray], *, ned: bool = False
) -> Path:
    """Write a folder of descents; with `ned` in north-east-down and camera axes, otherwise in Marsyard's axes.

    `truth` contains true mean horizontal velocities (east, north), m/s, by case.
    """
    rows = []
    for name, measurements in cases.items():
        for number, image in enumerate(measurements.images):
            row = _write_image(folder, name, number, image, measurements.attitudes[number].world_from_body, ned=ned)
            altitude = measurements.altitudes[number]
            row |= {"altitude_m": altitude.altitude_m, "altitude_time_s": altitude.time_s}
            if number:
                velocity = measurements.interval_velocities_m_s[number - 1]
                row |= _axis_columns("v{}_m_s", _axes_from_world(ned).apply(velocity))
            sun = measurements.sun_direction
            row |= {
                "sun_azimuth_deg": np.degrees(np.arctan2(sun[0], sun[1])) % 360.0,
                "sun_elevation_deg": np.degrees(np.arcsin(sun[2])),
            }
            if number == 2 and name in truth:
                true_x, true_y, _ = _axes_from_world(ned).apply([*truth[name], 0.0])
                row |= {"true_vx_m_s": true_x, "true_vy_m_s": true_y}
            rows.append(row)
    first_image = next(iter(cases.values())).images[0]
    return _write_campaign(folder, "velocity", first_image, rows, ned=ned)


def write_landing_folder(
    folder: Path, measurements: LandingMeasurements, task: str, *, true_poses: bool = False
) -> Path:
    """Write a folder of one flight; `task` is landing or matching."""
    rows = []
    for number, (image, pose) in enumerate(zip(measurements.images, measurements.poses, strict=True)):
        rotation, position = pose.world_from_body.rotation, pose.world_from_body.translation
        row = _write_image(folder, "hover", number, image, rotation, ned=False) | _axis_columns("{}_m", position)
        if task == "landing" and number == 0:
            row["slant_range_m"] = measurements.slant_range_m
        if true_poses:
            row |= _axis_columns("true_{}_m", position) | _quaternion_columns("true_", rotation)
        rows.append(row)
    return _write_campaign(folder, task, measurements.images[0], rows, ned=False)


def _write_image(
    folder: Path, case: str, number: int, image: DetectorImage, attitude: Rotation, *, ned: bool
) -> dict[str, Any]:
    folder.mkdir(exist_ok=True)
    name = f"{case}-{number}.png"
    cv2.imwrite(str(folder / name), image.counts)
    file_attitude = _axes_from_world(ned) * attitude * CAMERA_IN_BODY if ned else attitude
    return {"case": case, "file": name, "time_s": image.time_s, **_quaternion_columns("", file_attitude)}


def _axes_from_world(ned: bool) -> Rotation:
    return SITE_FROM_WORLD if ned else Rotation.identity()


def _quaternion_columns(prefix: str, rotation: Rotation) -> dict[str, float]:
    return dict(zip((f"{prefix}q{axis}" for axis in "xyzw"), rotation.as_quat(), strict=True))


def _axis_columns(template: str, values: np.ndarray) -> dict[str, float]:
    return {template.format(axis): float(value) for axis, value in zip("xyz", values, strict=True)}


def _write_campaign(
    folder: Path, task: str, image: DetectorImage, rows: Sequence[Mapping[str, Any]], *, ned: bool
) -> Path:
    calibration = image.calibration
    write_cahvor(image.camera, folder / "camera.cahvor")
    np.save(folder / "flat.npy", calibration.flat_field)
    axes, attitude_frame, is_pose_in_file = ("ned", "camera", "false") if ned else ("enu", "body", "true")
    (folder / "ingest.toml").write_text(f"""name = "test-{task}"
task = "{task}"
[poses]
axes = "{axes}"
attitude_of = "{attitude_frame}"
[camera]
file = "camera.cahvor"
pose_in_file = {is_pose_in_file}
[detector]
bits = {BITS}
offset_dn = {calibration.offset_dn!r}
exposure_s = {calibration.exposure_s!r}
transfer_row_s = {calibration.transfer_row_s!r}
clear_row_s = {calibration.clear_row_s!r}
rows_summed = {calibration.rows_summed}
flat_field = "flat.npy"
""")
    write_rows(folder, rows)
    return folder


def write_rows(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write `images.csv` with numbers in full precision."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with (folder / "images.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(
            {name: cell if isinstance(cell, str) else repr(float(cell)) for name, cell in row.items()} for row in rows
        )


def read_rows(folder: Path) -> list[dict[str, str]]:
    """Read the rows of `images.csv` as text."""
    with (folder / "images.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def write_text_rows(folder: Path, rows: Sequence[Mapping[str, str]]) -> None:
    """Write `images.csv` from rows of text without changes."""
    with (folder / "images.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
