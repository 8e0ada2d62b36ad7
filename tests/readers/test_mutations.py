"""Mutation tests of all readers of files: damaged contents are read, or raise the documented error of the reader.

A reader may accept a mutation, because a changed digit is not detectable. Any other exception would reach the user as a
traceback.
"""

import itertools
import json
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from marsyard.algorithms.exchange.files import read_case, write_case
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.definition.requirements import read_requirements
from marsyard.campaigns.errors import CampaignError, StoreError
from marsyard.campaigns.store import record
from marsyard.campaigns.store.products import load_products, pack_products, save_packed
from marsyard.campaigns.store.rows import RowStore, create_store
from marsyard.campaigns.store.table import read_rows, write_table
from marsyard.reports.stored import read_run
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.measured.image_files import read_counts, read_elevation, read_flat_field
from marsyard.scenarios.measured.layout import VELOCITY as TASK
from marsyard.scenarios.measured.layout import IngestError, read_ingest_file, read_table
from marsyard.scenarios.mesh_files import MeshFileError, read_mesh
from marsyard.scenarios.offline_algorithms import read_answers
from marsyard.scenarios.terrain_files import check_source, grid_north_deg
from marsyard.scenarios.velocity import VELOCITY_FORMAT
from marsyard.sim.camera import CameraFileError, read_cameras
from marsyard.sim.dynamics.pose_files import COLUMNS, TrajectoryFileError, read_poses
from marsyard.sim.sensor import read_datasheet
from marsyard.sim.terrain.rasters import RealTerrain, TerrainFileError, read_rasters
from tests.campaigns.fake_campaign import REQUIREMENT, TOP_LEVEL_KEYS
from tests.scenarios.measured.folders import write_velocity_folder
from tests.scenarios.test_terrain_files import write_tif
from tests.sim.camera.test_calibrations import KALIBR, OPENCV
from tests.sim.camera.test_files import CMOD_TEXT, LABEL
from tests.sim.camera.test_pds4 import LABEL as PDS4_LABEL
from tests.sim.sensor.test_datasheets import DATASHEET

ROWS: list[dict[str, Any]] = [
    {"case": case, "outcome": "VALID", "answered": True, "velocity_error_m_s": 0.1 * case, "site": "gusev",
     "wall_time_s": 1.0, "cpu_time_s": 1.0, "error": "", "traceback": ""}
    for case in range(40)
]  # fmt: skip
CAMPAIGN = f"""{TOP_LEVEL_KEYS}
[dispersions]
altitude_m = {{distribution = "normal", mean = 2000, sd = 100, truncate = [1700, 2200]}}
{REQUIREMENT}"""


@dataclass(frozen=True)
class Reader:
    """A reader: name of the file that is damaged, writer of a valid file into a folder, reader, documented error."""

    file: str
    write: Callable[[Path], object]
    read: Callable[[Path], object]
    error: type[Exception]


def _write_mesh(path: Path) -> None:
    trimesh.creation.box((1.0, 2.0, 0.5)).export(path)


def _read_terrain(path: Path) -> None:
    source = RealTerrain(dtm=path)
    check_source(source)
    read_rasters(source)
    grid_north_deg(path)


def _read_rasters(path: Path) -> None:
    read_rasters(RealTerrain(dtm=path))


def _write_npz(path: Path) -> None:
    rng = np.random.default_rng(1)
    ortho = rng.uniform(1.0, 2.0, (40, 30))
    np.savez_compressed(path, dem=rng.normal(0.0, 1.0, (40, 30)), dem_gsd=1.0, ortho=ortho, ortho_gsd=1.0)


def _write_relief(path: Path) -> None:
    values = np.random.default_rng(1).normal(0.0, 1.0, (50, 40)).astype(np.float32)
    write_tif(path.parent, path.name, values=values, compress="deflate")


def _poses() -> np.ndarray:
    poses = np.zeros((20, len(COLUMNS)))
    poses[:, 0], poses[:, 3], poses[:, 7] = np.arange(20.0), 100.0, 1.0
    return poses


def _write_poses(path: Path) -> None:
    import pandas as pd

    frame = pd.DataFrame(_poses(), columns=list(COLUMNS))
    if path.suffix == ".parquet":
        frame.to_parquet(path)
    elif path.suffix == ".csv":
        frame.to_csv(path, index=False)
    else:
        np.savetxt(path, _poses())


def _write_euroc(path: Path) -> None:
    lines = [f"{1403636580000000000 + 5_000_000 * n},0.1,0.2,{n},1,0,0,0" for n in range(20)]
    path.write_text("\n".join(["#timestamp, p_RS_R_x [m]", *lines]) + "\n")


def _write_image(path: Path) -> None:
    cv2.imwrite(str(path), np.random.default_rng(1).integers(0, 4096, (32, 48)).astype(np.uint16))


def _write_store(path: Path) -> None:
    create_store(path, {"identity": "of a test"})
    with RowStore(path) as store:
        store.add(ROWS[:20])
        store.add([{**row, "angle_deg": 3.0} for row in ROWS[20:]])


def _read_store(path: Path) -> None:
    with RowStore(path) as store:
        _ = store.about, store.kinds(), store.count(), store.count_unfinished(), store.find_first_finished_case()
        store.list_missing_cases(len(ROWS))
        store.row(3)
        list(store.chunks(7))
        write_table(path.with_name("cases.parquet"), store, ["velocity_error_m_s"])


def _write_parquet_rows(path: Path) -> None:
    store = path.with_name("rows.sqlite")
    _write_store(store)
    with RowStore(store) as rows:
        write_table(path, rows)


def _write_record(path: Path) -> None:
    campaign = path.with_name("fake.toml")
    campaign.write_text(CAMPAIGN)
    definition = load_campaign(str(campaign)).definition
    environment = {"machine": "x86_64"}
    contents = {
        "schema": record.SCHEMA, "name": "fake", "state": "finished", "cases": 12, "cases_finished": 12,
        "cases_crashed": 0, "requirements": [], "sessions": [{"environment": environment}], "changes": [],
        "definition": definition.model_dump(mode="json"), "environment": environment,
        "identity": {"definition": "1", "code": "2", "versions": {}, "inputs": {}},
    }  # fmt: skip
    path.write_text(json.dumps(contents, indent=1))


def _write_products(path: Path) -> None:
    products = {"image_1": np.arange(5000, dtype=np.uint16).reshape(50, 100), "names": ["a", "b"], "gain": 2.0}
    save_packed(path.parent, pack_products(products), ROWS[0])


def _write_ingest(path: Path) -> None:
    write_velocity_folder(path.parent, {"descent": inputs.descent()}, {})


def _load_products(path: Path) -> None:
    load_products(path.parent)


def _write_exchange(path: Path) -> None:
    write_case(path.parent, inputs.descent())


def _text(text: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(text)


READERS: Mapping[str, Reader] = {
    **{
        f"{kind} {name}": Reader(name, write, read, TerrainFileError)
        for kind, read in (("terrain", _read_terrain), ("rasters", _read_rasters))
        for name, write in (("dtm.tif", _write_relief), ("dtm.npz", _write_npz))
    },
    **{
        f"mesh {kind}": Reader(f"rock.{kind}", _write_mesh, lambda path: read_mesh(str(path)), MeshFileError)
        for kind in ("stl", "ply", "glb", "obj", "off")
    },
    **{
        f"poses {name}": Reader(name, write, read_poses, TrajectoryFileError)
        for name, write in (
            ("flight.csv", _write_poses), ("flight.parquet", _write_poses), ("flight.tum", _write_poses),
            ("euroc.csv", _write_euroc),
        )
    },
    **{
        f"camera {name}": Reader(
            name, _text(text), lambda path: read_cameras(path, subframe_folded_in=True), CameraFileError
        )
        for name, text in (
            ("camera.cahvor", CMOD_TEXT), ("camera.lbl", LABEL), ("camera.xml", PDS4_LABEL), ("opencv.yaml", OPENCV),
            ("kalibr.yaml", KALIBR),
        )
    },
    "datasheet": Reader("sensor.toml", _text(DATASHEET), read_datasheet, ValueError),
    **{
        f"image {kind}": Reader(f"image.{kind}", _write_image, lambda path: read_counts(path, (48, 32)), IngestError)
        for kind in ("png", "pgm", "tif")
    },
    "published image": Reader(
        "image.jpg", _write_image, lambda path: read_counts(path, (48, 32), is_published=True), IngestError
    ),
    "elevations": Reader(
        "elevation.npy",
        lambda path: np.save(path, np.ones((32, 48))),
        lambda path: read_elevation(path, (24, 16), 6.0),
        IngestError,
    ),
    "flat field npy": Reader("flat.npy", lambda path: np.save(path, np.ones((32, 48))), read_flat_field, IngestError),
    "flat field png": Reader("flat.png", _write_image, read_flat_field, IngestError),
    "ingest.toml": Reader("ingest.toml", _write_ingest, lambda path: read_ingest_file(path.parent), IngestError),
    "images.csv": Reader("images.csv", _write_ingest, lambda path: read_table(path, TASK), IngestError),
    "answers": Reader(
        "answers.csv", _text("case,outcome,velocity_east_m_s,velocity_north_m_s\n7,,1.5,-2\n 0 , NO_VALID_TRACK ,,\n"),
        lambda path: read_answers(path, VELOCITY_FORMAT), ValueError,
    ),
    **{
        f"exchange {name}": Reader(name, _write_exchange, lambda path: read_case(path.parent), ValueError)
        for name in ("case.json", "image_1.pgm", "camera_1.cahvor", "flat_field_1.f64")
    },
    "campaign": Reader("fake.toml", _text(CAMPAIGN), lambda path: load_campaign(str(path)), CampaignError),
    "requirements": Reader(
        "requirements.toml", _text(CAMPAIGN[CAMPAIGN.index("[[req"):]), read_requirements, CampaignError
    ),
    "record": Reader(
        "campaign.json", _write_record, lambda path: record.stored_definition(path.parent), StoreError
    ),
    "rows": Reader("cases.sqlite", _write_store, _read_store, StoreError),
    "table": Reader("cases.parquet", _write_parquet_rows, read_rows, StoreError),
    "run": Reader("cases.parquet", _write_parquet_rows, lambda path: read_run(path.parent), StoreError),
    **{
        f"products {name}": Reader(name, _write_products, _load_products, StoreError)
        for name in ("products.npz", "products.json")
    },
}  # fmt: skip


@st.composite
def mutations(draw: st.DrawFn) -> Callable[[bytes], bytes]:
    """Draw a change of a file: other bytes, a removed or inserted part, or a truncation; positions are fractions."""
    fractions = st.floats(0.0, 1.0, exclude_max=True)
    kind = draw(st.sampled_from(["replace", "insert", "remove", "truncate"]))
    changes = draw(st.lists(st.tuples(fractions, st.binary(min_size=1, max_size=8)), min_size=1, max_size=4))
    count = draw(st.integers(1, 200))

    def mutate(contents: bytes) -> bytes:
        for fraction, inserted in changes:
            start = int(fraction * len(contents))
            if kind == "truncate":
                return contents[:start]
            removed = {"replace": len(inserted), "insert": 0, "remove": count}[kind]
            contents = contents[:start] + (b"" if kind == "remove" else inserted) + contents[start + removed :]
        return contents

    return mutate


@cache
def _valid_folder(name: str) -> TemporaryDirectory[str]:
    """Create a folder with a valid file of a reader; it is removed at the end of the process."""
    folder = TemporaryDirectory()
    READERS[name].write(Path(folder.name, READERS[name].file))
    return folder


_NUMBERS = itertools.count()


def _read_mutated(name: str, mutate: Callable[[bytes], bytes], tmp_path: Path) -> None:
    """Read a mutated file in a folder of its own, because readers cache files by path and time."""
    reader, folder = READERS[name], tmp_path / str(next(_NUMBERS))
    shutil.copytree(_valid_folder(name).name, folder)
    path = folder / reader.file
    path.write_bytes(mutate(path.read_bytes()))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with suppress(reader.error):
            reader.read(path)
    shutil.rmtree(folder)


_SETTINGS = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], database=None)


@pytest.mark.parametrize("name", READERS)
@settings(_SETTINGS, max_examples=8, derandomize=True)
@given(mutate=mutations())
def test_damaged_files_raise_the_documented_error(name: str, mutate: Callable[[bytes], bytes], tmp_path: Path) -> None:
    _read_mutated(name, mutate, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
@settings(_SETTINGS, max_examples=400)
@given(mutate=mutations())
def test_many_damaged_files_raise_the_documented_error(
    name: str, mutate: Callable[[bytes], bytes], tmp_path: Path
) -> None:
    _read_mutated(name, mutate, tmp_path)


@pytest.mark.parametrize("name", READERS)
def test_valid_files_are_read(name: str) -> None:
    """The files before the mutations are valid; otherwise every mutation would raise for another reason."""
    READERS[name].read(Path(_valid_folder(name).name, READERS[name].file))


@pytest.mark.parametrize(("kind", "index"), [("ply", 8), ("ply", -1), ("glb", 8), ("obj", 8)])
def test_corners_outside_of_the_vertices_are_reported(tmp_path: Path, kind: str, index: int) -> None:
    """A negative index would select another vertex without a message."""
    box = trimesh.creation.box((1.0, 2.0, 0.5))
    path = tmp_path / f"rock.{kind}"
    box.export(path)
    corner = {"ply": "<i4", "glb": "<u4", "obj": None}[kind]
    contents = path.read_bytes()
    if corner is None:
        path.write_bytes(contents + f"\nf 1 2 {index + 1}\n".encode())
    else:
        stored = np.asarray(box.faces[0], dtype=corner).tobytes()
        changed = np.asarray([*box.faces[0][:2], index], dtype=corner).tobytes()
        assert contents.count(stored) == 1
        path.write_bytes(contents.replace(stored, changed))
    with pytest.raises(MeshFileError, match=rf"{path.name}: "):
        read_mesh(str(path))


def test_rows_that_are_not_utf8_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "cases.sqlite"
    _write_store(path)
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE cases SET row = CAST(x'ff22' AS TEXT) WHERE case_number = 3")
    connection.close()
    with RowStore(path) as store:
        for read in (lambda: store.row(3), lambda: list(store.chunks(10)), lambda: write_table(tmp_path / "t", store)):
            with pytest.raises(StoreError, match=r"cases.sqlite"):
                read()


def test_times_beyond_64_bits_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "euroc.csv"
    _write_euroc(path)
    path.write_text(path.read_text().replace("1403636580000000000", "1403636580000000000000000"))
    with pytest.raises(TrajectoryFileError, match=r"euroc.csv: cannot be read as a table"):
        read_poses(path)


@pytest.mark.parametrize("delay_s", [0.1, 0.6])
def test_interrupt_in_the_first_second_prints_no_traceback(delay_s: float) -> None:
    """Ctrl-C while modules are imported; before Python handles signals, the signal itself ends the process."""
    command = [sys.executable, "-m", "marsyard", "show", "dimes-smoke"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        time.sleep(delay_s)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=120)
    assert "Traceback" not in errors
    assert process.returncode in (0, 130, -signal.SIGINT)
