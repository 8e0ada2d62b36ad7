"""Tests of `ingest`, which reads folders of recorded images: formats, and messages with file and line on errors."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.measured.image_files import read_counts
from marsyard.scenarios.measured.ingest import ingest
from marsyard.scenarios.measured.layout import IngestError
from marsyard.scenarios.measured.matching import MatchingScenario
from marsyard.scenarios.measured.store import CasesFile, load_images
from marsyard.sim.camera import write_cahvor
from marsyard.sim.streams import Streams
from tests.scenarios.measured.folders import read_rows, write_landing_folder, write_text_rows, write_velocity_folder

Rows = list[dict[str, str]]


def ingest_and_expect_error(folder: Path, tmp_path: Path) -> str:
    """Ingest an invalid folder; return the error message."""
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(ValueError, match=str(tmp_path)) as error_info:
        ingest(folder, out)
    return str(error_info.value)


def change_cells(rows: Rows, row_number: int, **cells: str) -> Rows:
    """Replace cells of one row; row 0 is line 2 of the file."""
    return [row | cells if number == row_number else row for number, row in enumerate(rows)]


def drop_columns(rows: Rows, *names: str) -> Rows:
    return [{name: cell for name, cell in row.items() if name not in names} for row in rows]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: change_cells(rows, 1, file="lost.png"), "lost.png: No such file"),
        (lambda rows: change_cells(rows, 1, qx="nan"), "line 3: qx is 'nan'; allowed: a finite number"),
        (
            lambda rows: change_cells(rows, 1, qw="2.0"),
            "line 3: the quaternion qx to qw has the length 2.035; allowed: 1, within 0.005",
        ),
        (lambda rows: change_cells(rows, 1, qw=""), "line 3: qx is given, but qw is not"),
        (lambda rows: change_cells(rows, 2, time_s="100.0"), "line 4: time goes from 103.75 to 100 s"),
        (lambda rows: change_cells(rows, 0, altitude_m="-3"), "line 2: altitude_m is -3; allowed: above 0"),
        (lambda rows: change_cells(rows, 0, altitude_m=""), "line 2: altitude_m is empty"),
        (lambda rows: change_cells(rows, 0, qx="1", qy="0", qz="0", qw="0"), "line 2: the camera looks up, 90.0 deg"),
        (lambda rows: rows[:2], "line 2: case 'drop' has 2 images; allowed for velocity: 3"),
        (lambda rows: drop_columns(rows, "vx_m_s", "vy_m_s", "vz_m_s"), "vx_m_s to vz_m_s and the positions are empty"),
        (lambda rows: drop_columns(rows, "sun_azimuth_deg", "sun_elevation_deg"), "line 2: no sun"),
        (lambda rows: drop_columns(rows, "altitude_m"), "the column 'altitude_m' is missing"),
        (lambda rows: [{**row, "altitude_ft": "1"} for row in rows], "'altitude_ft' (did you mean 'altitude_m'?)"),
        (lambda rows: [{**row, "slant_range_m": "1"} for row in rows], "unknown column 'slant_range_m'"),
        (lambda rows: change_cells(rows, 0, camera="none.cahvor"), "none.cahvor: file: cannot be read"),
        (
            lambda rows: change_cells(rows, 2, vx_m_s="", vy_m_s="", vz_m_s=""),
            "line 3: case 'drop': vx_m_s to vz_m_s are given for one pair of images only",
        ),
        (
            lambda rows: [
                {**row, "true_vx_m_s": cell, "true_vy_m_s": cell} for row, cell in zip(rows, ("", "3", ""), strict=True)
            ],
            "line 3: a true velocity or position is given, but none for the last two images",
        ),
        (
            lambda rows: [{**row, "exposure_s": "0"} for row in rows],
            "line 2: exposure_s is 0 or empty; a frame transfer",
        ),
        (lambda rows: change_cells(rows, 2, file="drop-1.png"), "line 4: drop-1.png is also the image of line 3"),
    ],
)
def test_invalid_tables_are_rejected(tmp_path: Path, change: Callable[[Rows], Rows], message: str) -> None:
    folder = write_velocity_folder(tmp_path / "in", {"drop": inputs.descent()}, {})
    write_text_rows(folder, change(read_rows(folder)))
    assert message in ingest_and_expect_error(folder, tmp_path)


@pytest.mark.parametrize(
    ("change_image", "message"),
    [
        (lambda path: cv2.imwrite(str(path), np.zeros((480, 640), np.uint16)), "has 640 x 480 pixels; its camera has"),
        (lambda path: path.write_bytes(b""), "is empty (0 bytes)"),
        (lambda path: path.write_bytes(b"GIF89a" + bytes(100)), "is not a supported image; allowed: PNG"),
        (lambda path: cv2.imwrite(str(path), np.full((256, 1024), 5000, np.uint16)), "bits = 12 allows 4095"),
        (lambda path: cv2.imwrite(str(path), np.zeros((256, 1024, 3), np.uint8)), "has 3 bands"),
        (lambda path: path.write_bytes(path.read_bytes()[:900]), "cannot be decoded"),
        # The header specifies 6 gigapixels: the file is rejected before decoding.
        (lambda path: path.write_bytes(b"P5 80000 80000 65535\n"), "has too many pixels; allowed: at most"),
    ],
)
def test_invalid_images_are_rejected(tmp_path: Path, change_image: Callable[[Path], object], message: str) -> None:
    folder = write_velocity_folder(tmp_path / "in", {"drop": inputs.descent()}, {})
    change_image(folder / "drop-1.png")
    output = ingest_and_expect_error(folder, tmp_path)
    assert "drop-1.png" in output
    assert message in output


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("bits = 12", "bits = 20", "detector.bits: Input should be less than or equal to 16, got 20"),
        ("bits = 12", "", "detector.bits: required, but missing"),
        ("bits = 12", "bits = 12\nblack = 3", "detector.black: unknown key"),
        ('axes = "enu"', 'axes = "xyz"', "poses.axes: Input should be 'enu' or 'ned', got 'xyz'"),
        ('attitude_of = "body"', "", 'poses.attitude_of must be "body"'),
        ("[poses]", "[poses", "not valid TOML"),
        ("flat.npy", "camera.cahvor", "camera.cahvor: is not a supported image"),
    ],
)
def test_invalid_settings_are_rejected(tmp_path: Path, old: str, new: str, message: str) -> None:
    folder = write_velocity_folder(tmp_path / "in", {"drop": inputs.descent()}, {})
    path = folder / "ingest.toml"
    path.write_text(path.read_text().replace(old, new))
    assert message in ingest_and_expect_error(folder, tmp_path)


@pytest.mark.parametrize("suffix", [".tif", ".pgm"])
def test_image_formats_preserve_the_counts(tmp_path: Path, suffix: str) -> None:
    measurements = inputs.landing()
    folder = write_landing_folder(tmp_path / "in", measurements, "matching")
    rows = read_rows(folder)
    for row, image in zip(rows, measurements.images, strict=True):
        row["file"] = Path(row["file"]).stem + suffix
        cv2.imwrite(str(folder / row["file"]), image.counts)
    write_text_rows(folder, rows)
    (tmp_path / "out").mkdir()
    path, stored_cases = ingest(folder, tmp_path / "out")
    images = load_images(CasesFile(file=str(path)), stored_cases.cases[0])
    for image, original in zip(images, measurements.images, strict=True):
        assert np.array_equal(image.counts, original.counts)
        assert image.camera == original.camera


def _write_png_with_orientation(path: Path, counts: np.ndarray, orientation: int) -> None:
    """Write a PNG whose chunk eXIf contains one entry: tag 274, type SHORT, the orientation."""
    data = cv2.imencode(".png", counts)[1].tobytes()
    exif = b"MM\0*\0\0\0\x08" + struct.pack(">HHHIHHI", 1, 274, 3, 1, orientation, 0, 0)
    chunk = struct.pack(">I", len(exif)) + b"eXIf" + exif + struct.pack(">I", zlib.crc32(b"eXIf" + exif))
    end = data.index(b"IEND") - 4
    path.write_bytes(data[:end] + chunk + data[end:])


def _write_tiff_with_orientation(path: Path, counts: np.ndarray, orientation: int) -> None:
    """Write an uncompressed TIFF of 8 bits with one strip; entries: tag, type (3 SHORT, 4 LONG), count, value."""
    rows, columns = counts.shape
    tags = (256, 257, 258, 259, 262, 273, 274, 277, 278, 279)
    values = (columns, rows, 8, 1, 1, 200, orientation, 1, rows, counts.size)
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in zip(tags, values, strict=True))
    directory = struct.pack("<H", len(tags)) + entries + struct.pack("<I", 0)
    path.write_bytes(
        (b"II*\0" + struct.pack("<I", 8) + directory).ljust(200, b"\0") + counts.astype(np.uint8).tobytes()
    )


@pytest.mark.parametrize("write", [_write_png_with_orientation, _write_tiff_with_orientation])
def test_rotated_images_are_refused(tmp_path: Path, write: Callable[[Path, np.ndarray, int], None]) -> None:
    """OpenCV mirrors such TIFF files without a word, or cannot decode them; it ignores the orientation of PNG files."""
    counts = np.arange(48, dtype=np.uint8).reshape(6, 8)
    for orientation in range(1, 9):
        path = tmp_path / f"{orientation}.image"
        write(path, counts, orientation)
        if orientation == 1:
            assert np.array_equal(read_counts(path, (8, 6)), counts)
        else:
            with pytest.raises(
                IngestError, match=rf"{orientation}.image: has the orientation {orientation} .*allowed: 1"
            ):
                read_counts(path, (8, 6))


def test_negative_images_are_refused(tmp_path: Path) -> None:
    """A TIFF with PhotometricInterpretation 0 (white is zero): OpenCV inverts those of 8 bits, but not of 16."""
    path = tmp_path / "negative.tif"
    tags = {256: 8, 257: 6, 258: 16, 259: 1, 262: 0, 273: 200, 277: 1, 278: 6, 279: 96}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    head = b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + struct.pack("<I", 0)
    path.write_bytes(head.ljust(200, b"\0") + np.arange(48, dtype="<u2").tobytes())
    with pytest.raises(IngestError, match=r"negative.tif: its counts are 0 for white .*allowed: 0 for black"):
        read_counts(path, (8, 6))


@pytest.mark.parametrize("names", [("true_qx", "true_qy", "true_qz", "true_qw"), ("true_x_m", "true_y_m", "true_z_m")])
def test_incomplete_true_poses_are_rejected(tmp_path: Path, names: tuple[str, ...]) -> None:
    folder = write_landing_folder(tmp_path / "in", inputs.landing(), "landing", true_poses=True)
    write_text_rows(folder, drop_columns(read_rows(folder), *names))
    assert "line 2: the truth is incomplete; allowed: true_x_m to" in ingest_and_expect_error(folder, tmp_path)


def test_cameras_with_different_summed_rows_are_rejected(tmp_path: Path) -> None:
    measurements = inputs.descent()
    folder = write_velocity_folder(tmp_path / "in", {"one": measurements, "two": measurements}, {})
    write_cahvor(measurements.images[0].camera.bin(2, 1), folder / "half.cahvor")
    for number in range(3):
        counts = measurements.images[number].counts
        cv2.imwrite(str(folder / f"two-{number}.png"), counts.reshape(len(counts), -1, 2)[..., 0])
    text = (folder / "ingest.toml").read_text()
    kept = [line for line in text.splitlines() if not line.startswith(("rows_summed", "flat_field"))]
    (folder / "ingest.toml").write_text("\n".join(kept))
    write_text_rows(
        folder, [{**row, "camera": "half.cahvor" if "two" in row["case"] else ""} for row in read_rows(folder)]
    )
    assert "detector.rows_summed is 2 for one camera and 4 for another" in ingest_and_expect_error(folder, tmp_path)


def test_opportunity_images_agree_with_the_cameras_of_their_labels(tmp_path: Path, shared_data: Path) -> None:
    """Two frames with different mast angles at one position agree to a pixel with the cameras of their labels."""
    folder = tmp_path / "opportunity"
    folder.mkdir()
    frames = shared_data / "mer_opportunity"
    hazcam = "1F483288473EFFCMUFP1214L0M1.IMG"
    (folder / "ingest.toml").write_text('name = "opportunity"\ntask = "matching"\n[detector]\nbits = 12\n')
    lines = [f"navcam,{frames}/1N491020{time}ILFCNY9P0706L0M1.IMG\n" for time in (376, 519)]
    (folder / "images.csv").write_text("case,file\n" + "".join(lines))
    (tmp_path / "out").mkdir()
    path, _ = ingest(folder, tmp_path / "out")
    parameters = MatchingScenario.parameters_type.model_validate({"cases": {"file": str(path)}})
    row: dict[str, Any] = dict(MatchingScenario().run(parameters, Streams(0, "opportunity", 0)).row)
    assert row["matches"] >= 80
    assert 0.2 < row["residual_median_px"] < 1.0
    assert row["residual_90_percent_px"] < 2.0
    # Mast encoders of the labels: azimuth from -0.340 to 0.254 rad, elevation from -0.110 to -0.209 rad.
    assert 33.0 < row["max_rotation_deg"] < 36.0
    assert np.isclose(row["max_translation_m"], 0.0671, atol=1e-3)
    # The time tags of the labels differ by 143 s. A single fisheye frame is not a case.
    assert np.isclose(row["duration_s"], 143.258)
    (folder / "images.csv").write_text(f"case,file\nhazcam,{frames}/{hazcam}\n")
    with pytest.raises(IngestError, match="case 'hazcam' has 1 images; allowed for matching: 2 to 50"):
        ingest(folder, tmp_path / "out")


def test_hazcam_image_with_the_attitude_of_its_label_looks_down(tmp_path: Path, shared_data: Path) -> None:
    """The case contains the same fisheye frame twice: the residuals between the two images are zero."""
    folder = tmp_path / "hazcam"
    folder.mkdir()
    frame = shared_data / "mer_opportunity" / "1F483288473EFFCMUFP1214L0M1.IMG"
    (folder / "ingest.toml").write_text('name = "hazcam"\ntask = "matching"\n[detector]\nbits = 12\n')
    (folder / "images.csv").write_text(f"case,file,time_s\nhazcam,{frame},0\nhazcam,{frame},1\n")
    (tmp_path / "out").mkdir()
    path, stored_cases = ingest(folder, tmp_path / "out")
    stored_image = stored_cases.cases[0].images[0]
    cases = CasesFile(file=str(path))
    image = load_images(cases, stored_cases.cases[0])[0]
    assert stored_image.pose.rotation.apply(image.camera.boresight())[2] < -0.3
    parameters = MatchingScenario.parameters_type.model_validate({"cases": {"file": str(path)}})
    row: dict[str, Any] = dict(MatchingScenario().run(parameters, Streams(0, "hazcam", 0)).row)
    assert row["matches"] > 500
    assert row["residual_90_percent_px"] < 1e-3
