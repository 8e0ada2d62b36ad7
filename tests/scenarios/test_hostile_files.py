"""Tests of malicious files: oversized, compressed and blocking files are rejected with a message."""

import json
import os
import signal
import struct
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import trimesh

from marsyard.scenarios.measured.image_files import read_counts, read_flat_field
from marsyard.scenarios.measured.image_table import read_table
from marsyard.scenarios.measured.layout import VELOCITY, IngestError, read_ingest_file
from marsyard.scenarios.measured.store import CasesFile
from marsyard.scenarios.mesh_files import MAX_BYTES, MeshFileError, read_mesh
from marsyard.scenarios.offline_algorithms import read_answers
from marsyard.scenarios.terrain_files import check_source
from marsyard.scenarios.velocity import VELOCITY_FORMAT
from marsyard.sim.camera import read_cameras
from marsyard.sim.dynamics.pose_files import COLUMNS, MAX_ROWS, TrajectoryFileError, read_poses
from marsyard.sim.sensor import read_datasheet
from marsyard.sim.terrain.rasters import RealTerrain


def test_calibration_with_aliases_is_rejected(tmp_path: Path) -> None:
    """Each list contains nine aliases of the previous list, so 500 bytes would expand to 9**8 numbers."""
    lines = ["a0: &a0 [0,0,0,0,0,0,0,0,0]"]
    lines += [f"a{n}: &a{n} [{','.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 8)]
    path = tmp_path / "camera.yaml"
    path.write_text("\n".join([*lines, "camera_matrix: *a7", "image_width: 640", "image_height: 480"]))
    assert path.stat().st_size < 600
    with pytest.raises(ValueError, match=r"camera.yaml: file: is not valid YAML \(line 2 has an alias"):
        read_cameras(path)


@pytest.mark.parametrize("suffix", ["zip", "tar.gz", "bz2"])
def test_archives_are_rejected_as_meshes(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"rock.{suffix}"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("rock.stl", b"solid\n" + b" " * 10_000_000)
    with pytest.raises(MeshFileError, match="is not a supported mesh format; allowed: "):
        read_mesh(str(path))


def test_zipped_mesh_size_is_checked_before_expansion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An archive of 300 kB contains 300 MB of blanks. Trimesh reads 3MF files only with lxml and networkx."""
    monkeypatch.setattr(trimesh, "available_formats", lambda: {"3mf", "stl"})
    monkeypatch.setattr(trimesh, "load", lambda *_, **__: pytest.fail("the archive was expanded"))
    path = tmp_path / "rock.3mf"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("3D/3dmodel.model", "w") as member:
        for _ in range(30):
            member.write(b" " * 10_000_000)
    assert path.stat().st_size < 1_000_000
    with pytest.raises(MeshFileError, match=rf"rock.3mf: expands to 300000000 bytes; allowed: up to {MAX_BYTES >> 20}"):
        read_mesh(str(path))


def test_gltf_accessor_size_is_checked_before_expansion(tmp_path: Path) -> None:
    """A glTF accessor without a buffer expands to `count` zero vectors."""
    scene = {
        "asset": {"version": "2.0"},
        "accessors": [{"componentType": 5126, "count": 1_000_000_000, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    path = tmp_path / "rock.glb"
    path.write_bytes(struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text)
    with pytest.raises(MeshFileError, match=r"rock.glb: expands to 12000000000 bytes"):
        read_mesh(str(path))


def _write_parquet(path: Path, rows: int, **columns: pa.Array) -> Path:
    """Write a table of equal values, which Parquet stores in a few bytes."""
    zeros = pa.array(np.zeros(rows))
    pq.write_table(pa.table({**dict.fromkeys(COLUMNS, zeros), **columns}), path)
    return path


def test_pose_table_with_too_many_rows_is_rejected(tmp_path: Path) -> None:
    path = _write_parquet(tmp_path / "flight.parquet", MAX_ROWS + 1)
    assert path.stat().st_size < 3_000_000
    with pytest.raises(TrajectoryFileError, match=rf"has {MAX_ROWS + 1} rows; allowed: up to {MAX_ROWS}"):
        read_poses(path)


def test_pose_columns_must_be_numeric(tmp_path: Path) -> None:
    path = _write_parquet(tmp_path / "flight.parquet", 10, qw=pa.array(["a"] * 10))
    with pytest.raises(TrajectoryFileError, match="the column qw contains string; allowed: numbers"):
        read_poses(path)


def test_flat_field_size_is_checked_before_expansion(tmp_path: Path) -> None:
    path = tmp_path / "flat.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6)})
    with pytest.raises(IngestError, match=r"not a valid flat field \(contains an array of shape \(1000000, 1000000\)"):
        read_flat_field(path)


READERS: dict[str, Callable[[Path], object]] = {
    "image.png": lambda path: read_counts(path, (8, 8)),
    "camera.yaml": read_cameras,
    "sensor.toml": read_datasheet,
    "flight.csv": read_poses,
    "flight.spice.toml": read_poses,
    "rock.stl": lambda path: read_mesh(str(path)),
    "dtm.tif": lambda path: check_source(RealTerrain(dtm=path)),
    "dtm.npz": lambda path: check_source(RealTerrain(dtm=path)),
    "answers.csv": lambda path: read_answers(path, VELOCITY_FORMAT),
    "ingest.toml": lambda path: read_ingest_file(path.parent),
    "images.csv": lambda path: read_table(path, VELOCITY),
    "cases.json": lambda path: CasesFile.file_hash(str(path)),
}


@pytest.fixture
def time_limit() -> Iterator[None]:
    """Interrupt a blocked test after 60 s."""

    def raise_timeout(*_: object) -> None:
        raise TimeoutError("the test waited for a blocking file")

    previous_handler = signal.signal(signal.SIGALRM, raise_timeout)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous_handler)


@pytest.mark.usefixtures("time_limit")
@pytest.mark.parametrize("name", READERS)
def test_named_pipe_is_rejected_by_each_reader(tmp_path: Path, name: str) -> None:
    """A named pipe without a writer would block the reader."""
    path = tmp_path / name
    os.mkfifo(path)
    with pytest.raises(ValueError, match="is a named pipe; a regular file is needed") as error_info:
        READERS[name](path)
    assert name in str(error_info.value)


def test_device_file_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.symlink_to("/dev/zero")
    with pytest.raises(TrajectoryFileError, match="is a character device; a regular file is needed"):
        read_poses(path)
