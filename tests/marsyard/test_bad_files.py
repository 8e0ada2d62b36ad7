"""Tests of invalid input files: the command reports the file and its fault, and exits with status 2."""

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.crs import CRS
from rasterio.transform import Affine

from marsyard.scenarios.conformance import inputs
from tests.command import run_command
from tests.scenarios.measured.folders import read_rows, write_text_rows, write_velocity_folder

MARS_METRES = CRS.from_string("+proj=eqc +lat_ts=0 +lon_0=0 +R=3396190 +units=m +no_defs")
MARS_DEGREES = CRS.from_string("+proj=longlat +R=3396190 +no_defs")
NO_DATA = -32767.0
#: Begin of a PDS3 label.
PDS3 = b"PDS_VERSION_ID = PDS3\r\n"

#: Function that writes a file to a path.
WriteFile = Callable[[Path], object]


def write_dtm(
    path: Path, *, crs: CRS = MARS_METRES, unit: str = "m", nodata: float | None = NO_DATA, side: int = 40
) -> None:
    """Write a DTM of 40 x 40 heights with one hole; another `side` gives a sparse file without heights."""
    heights = np.full((40, 40), -4450.0, dtype=np.float32)
    heights[7, 7] = NO_DATA
    profile = {"driver": "GTiff", "count": 1, "dtype": "float32", "nodata": nodata, "SPARSE_OK": "TRUE"}
    georeference = {"crs": crs, "transform": Affine(1.0, 0.0, 8e6, 0.0, -1.0, -3e5), "height": side, "width": side}
    with warnings.catch_warnings(), rasterio.open(path, "w", **profile, **georeference) as file:
        warnings.simplefilter("ignore")
        if side == 40:
            file.write(heights, 1)
        file.units = (unit,)


def write_flight(path: Path, row: int, column: int, value: float) -> None:
    """Write a vertical descent with one changed value; for column 4 (qx) the camera looks up in all poses."""
    times = np.arange(-6.0, 22.0, 0.5)
    poses = np.zeros((times.size, 8))
    poses[:, 0], poses[:, 3], poses[:, 7] = times, 1900.0 - 75.0 * times, 1.0
    poses[row, column] = value
    if column == 4:
        poses[:, 4:] = [1.0, 0.0, 0.0, 0.0]
    header = "time_s,x_m,y_m,z_m,qx,qy,qz,qw"
    np.savetxt(path, poses, delimiter=",", header=header, comments="")


def write_gigabyte(path: Path, header: bytes = b"") -> None:
    """Write a sparse file of 1 GiB that starts with `header`."""
    with path.open("wb") as file:
        file.write(header)
        file.truncate(1 << 30)


def write_empty(path: Path) -> None:
    path.write_bytes(b"")


#: TOML tables of a campaign that refer to a file.
CAMERA = '[parameters.camera]\nmodel = "{}"'
TERRAIN = '[parameters.terrain.source]\ndtm = "{}"'
FLIGHT = '[parameters.flight]\nfile = "{}"\naxes = "enu"\nattitude_of = "body"'
MESH = '[[parameters.meshes]]\nfile = "{}"\nkind = "rock"\neast_m = 1.0\nnorth_m = 1.0\nsize_m = 1.0'
DETECTOR = '[parameters.detector]\nfile = "{}"'


@pytest.mark.parametrize(
    ("table", "name", "write", "message"),
    [
        (TERRAIN, "degrees.tif", lambda path: write_dtm(path, crs=MARS_DEGREES), "is in degrees; project it to metres"),
        (TERRAIN, "nodata.tif", lambda path: write_dtm(path, nodata=None), "has no nodata value"),
        (TERRAIN, "units.tif", lambda path: write_dtm(path, unit="ft"), "its heights are in 'ft'; allowed: metres"),
        (TERRAIN, "huge.tif", lambda path: write_dtm(path, side=16384), "16384 x 16384 values; allowed: at most 5461"),
        (TERRAIN, "empty.tif", write_empty, "is empty (0 bytes)"),
        (FLIGHT, "nan.csv", lambda path: write_flight(path, 9, 2, np.nan), "pose 10: y_m is not finite"),
        (FLIGHT, "back.csv", lambda path: write_flight(path, 9, 0, -9.0), "10: time goes from -2.000000 to -9.000000"),
        (FLIGHT, "length.csv", lambda path: write_flight(path, 9, 7, 2.0), "10: the quaternion's length is 2; allowed"),
        (FLIGHT, "up.csv", lambda path: write_flight(path, 9, 4, 1.0), "at image 1 the camera looks up, 90.0 deg"),
        (FLIGHT, "huge.csv", write_gigabyte, "larger than 512 MiB"),
        (FLIGHT, "empty.csv", write_empty, "has 0 poses; allowed: at least 4"),
        (CAMERA, "empty.yaml", write_empty, "is empty (0 bytes)"),
        (CAMERA, "huge.yaml", lambda path: write_gigabyte(path, b"image_width: 640\n"), "is larger than 8 MiB"),
        (CAMERA, "huge.IMG", lambda path: write_gigabyte(path, PDS3), "END: missing in the first"),
        (MESH, "empty.stl", write_empty, "contains no triangle"),
        (MESH, "huge.stl", write_gigabyte, "is larger than 256 MiB"),
        (DETECTOR, "empty_sheet.toml", write_empty, "pixel_pitch_um: Field required"),
        (DETECTOR, "huge_sheet.toml", write_gigabyte, "larger than 1 MiB"),
    ],
    ids=lambda value: value if isinstance(value, str) and "." in value and "\n" not in value else "",
)
def test_campaign_with_invalid_file_is_rejected(
    tmp_path: Path, table: str, name: str, write: WriteFile, message: str
) -> None:
    write(tmp_path / name)
    campaign = tmp_path / "campaign.toml"
    campaign.write_text(f'name = "bad"\nscenario = "descent"\ncases = 1\n{table.format(tmp_path / name)}\n')
    run_and_expect_error(["run", campaign, "--out", tmp_path / "run"], tmp_path / name, message)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: write_gigabyte(path, b"P5 32768 32768 255\n"), "has too many pixels; allowed: at most 178956970"),
        (lambda path: write_gigabyte(path, PDS3), "END: missing in the first"),
        (write_empty, "is empty (0 bytes)"),
    ],
)
def test_invalid_image_is_rejected(tmp_path: Path, write: WriteFile, message: str) -> None:
    folder = write_velocity_folder(tmp_path / "in", {"drop": inputs.descent()}, {})
    write(folder / "drop-1.png")
    run_and_expect_error(["ingest", folder, "--out", tmp_path / "out"], folder / "drop-1.png", message)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ({"qx": "nan"}, "line 3: qx is 'nan'; allowed: a finite number"),
        ({"time_s": "0.0"}, "line 3: time goes from 100 to 0 s"),
        ({"qw": "2.0"}, "line 3: the quaternion qx to qw has the length"),
        ({"qx": "1", "qy": "0", "qz": "0", "qw": "0"}, "line 3: the camera looks up, 90.0 deg"),
    ],
)
def test_invalid_table_is_rejected(tmp_path: Path, cells: dict[str, str], message: str) -> None:
    folder = write_velocity_folder(tmp_path / "in", {"drop": inputs.descent()}, {})
    write_text_rows(folder, [row | cells if index == 1 else row for index, row in enumerate(read_rows(folder))])
    run_and_expect_error(["ingest", folder, "--out", tmp_path / "out"], folder / "images.csv", message)


def run_and_expect_error(arguments: list[object], path: Path, message: str) -> None:
    """Run a command; assert that it exits with status 2 and an error message that names the file."""
    status, output = run_command(*arguments)
    assert (status, output[:7], str(path) in output) == (2, "error: ", True), output
    assert message in output
