"""Tests of invalid input files: the command reports the file and its fault, and exits with status 2.

The tests of the readers contain the other faults of each kind of file.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from marsyard.scenarios.conformance import inputs
from tests.command import run_command
from tests.scenarios.measured.folders import read_rows, write_text_rows, write_velocity_folder
from tests.scenarios.test_terrain_files import write_tif

#: Begin of a PDS3 label.
PDS3 = b"PDS_VERSION_ID = PDS3\r\n"

#: Function that writes a file to a path.
WriteFile = Callable[[Path], object]


def write_flight(path: Path) -> None:
    """Write a descent with a position that is not a number."""
    times = np.arange(-6.0, 22.0, 0.5)
    poses = np.column_stack([times, np.zeros((times.size, 6)), np.ones(times.size)])
    poses[9, 2] = np.nan
    np.savetxt(path, poses, delimiter=",", header="time_s,x_m,y_m,z_m,qx,qy,qz,qw", comments="")


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
        (TERRAIN, "no_crs.tif", lambda path: write_tif(path.parent, path.name, crs=None), "has no projection"),
        (FLIGHT, "nan.csv", write_flight, "pose 10: y_m is not finite"),
        (FLIGHT, "huge.csv", write_gigabyte, "larger than 512 MiB"),
        (CAMERA, "empty.yaml", write_empty, "is empty (0 bytes)"),
        (CAMERA, "huge.yaml", lambda path: write_gigabyte(path, b"image_width: 640\n"), "is larger than 8 MiB"),
        (CAMERA, "huge.IMG", lambda path: write_gigabyte(path, PDS3), "END: missing in the first"),
        (MESH, "empty.stl", write_empty, "contains no triangle"),
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


def test_image_of_a_gigabyte_is_rejected(tmp_path: Path) -> None:
    folder = write_velocity_folder(tmp_path / "in", {"drop": inputs.descent()}, {})
    write_gigabyte(folder / "drop-1.png", PDS3)
    run_and_expect_error(
        ["ingest", folder, "--out", tmp_path / "out"], folder / "drop-1.png", "END: missing in the first"
    )
    assert not (tmp_path / "out").exists()


def run_and_expect_error(arguments: list[object], path: Path, message: str) -> None:
    """Run a command; assert that it exits with status 2 and an error message that names the file."""
    status, output = run_command(*arguments)
    assert (status, output[:7], str(path) in output) == (2, "error: ", True), output
    assert message in output


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
